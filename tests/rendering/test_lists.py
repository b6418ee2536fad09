"""Globs and lists as inputs: names of results, options of each, and what is refused."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import soundfile

from gesturekit.corpus import Item
from gesturekit.errors import ConfigError
from gesturekit.jobs.result import Task
from gesturekit.rendering.inputs import find_tasks, length_of, task_wave


@pytest.fixture
def folder(tmp_path, write_speech, monkeypatch):
    for name in ("a", "day/b", "day/night/c"):
        write_speech(tmp_path / "in" / f"{name}.wav", 0.5)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "in"


def found(source, tmp_path):
    tasks = find_tasks(source, tmp_path / "out")
    return {task.id: os.path.relpath(task.path, tmp_path) for task in tasks}


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("in/*.wav", {"a"}),
        ("in/**/*.wav", {"a", "day/b", "day/night/c"}),
        ("in/d*/*.wav", {"day/b"}),
        ("*/day/**/[bc].wav", {"in/day/b", "in/day/night/c"}),
    ],
)
def test_globs_keep_the_folders_below_their_fixed_part(folder, tmp_path, pattern, names):
    assert found(pattern, tmp_path).keys() == names


def test_a_file_with_the_name_of_a_pattern_is_that_file(folder, tmp_path, write_speech):
    write_speech(folder / "[b].wav", 0.5)
    assert found(str(folder / "[b].wav"), tmp_path) == {"[b]": "in/[b].wav"}
    with pytest.raises(ConfigError, match=r"in/\*\.flac"):
        find_tasks("in/*.flac", tmp_path)


def test_a_list_of_paths(folder, tmp_path):
    lines = ("a.wav\r", "# day 1", f"#{300 * '-'}", "./day/b.wav", f"{folder}/day/night/c.wav")
    (folder / "night.txt").write_text("\ufeff" + "\n".join(lines))  # as Notepad begins it
    names = {"a": "in/a.wav", "day/b": "in/day/b.wav", "c": "in/day/night/c.wav"}
    assert found("in/night.txt", tmp_path) == names
    # Where there is no such file beside the list, paths are those of the working folder.
    (folder / "more.lst").write_text("in/a.wav\n../in/day/b.wav\n")
    assert found("in/more.lst", tmp_path) == {"in/a": "in/a.wav", "b": "in/day/b.wav"}


def test_the_part_and_the_channel_of_a_sound_are_read(tmp_path):
    """Left is 0.1 of a noise, right 0.3, but for the first half second, which is 0.8 on both."""
    noise = np.random.default_rng(0).uniform(0.5, 1, 16_000) * np.resize([1, -1], 16_000)
    shares = np.where(np.arange(16_000)[:, None] < 8000, 0.8, [0.1, 0.3])
    path = tmp_path / "a.wav"
    soundfile.write(path, noise[:, None] * shares, 16_000, "FLOAT")

    def read(usual: int | None = None, **more) -> tuple[float, float, float]:
        wave, start = task_wave(Task("a", path, more=more), usual), more.get("start", 0)
        first = round(16_000 * start)
        ends = (wave.samples[[0, -1]] / noise[[first, first + len(wave.samples) - 1]]).tolist()
        return wave.duration, *(round(end, 4) for end in ends)

    assert read() == (1.0, 0.8, 0.2) and read(1) == (1.0, 0.8, 0.1)
    assert read(1, channel=2) == (1.0, 0.8, 0.3)
    assert read(start=0.5) == (0.5, 0.2, 0.2)
    assert read(start=0.25, seconds=0.5) == (0.5, 0.8, 0.2)
    assert task_wave(Task("a"), None) is None


def test_kaldis_wav_scp(folder, tmp_path):
    (tmp_path / "wav.scp").write_text("spk1-utt1 in/a.wav\nspk1-utt2\tin/day/b.wav\n")
    assert found("wav.scp", tmp_path) == {"spk1-utt1": "in/a.wav", "spk1-utt2": "in/day/b.wav"}


def test_jsonl_has_options_for_each_input(folder, tmp_path):
    given = [{"seed": 3, "style": "old"}, {"start": 0.1, "seconds": 0.2}, {"seconds": 14400}]
    given.append({"seed": 0, "start": 0, "channel": 1})
    about = [{"audio": "in/a.wav"}, {"audio": "in/a.wav", "id": "again/a"}, {"id": "idle"}]
    about.append({"audio": "in/day/b.wav"})
    lines = [json.dumps(one | options) for one, options in zip(about, given, strict=True)]
    (tmp_path / "night.jsonl").write_text("\n".join(lines))
    tasks = find_tasks("night.jsonl", tmp_path / "out")
    assert [task.id for task in tasks] == ["in/a", "again/a", "idle", "in/day/b"]
    assert [dict(task.more) for task in tasks] == given
    assert [length_of(task) for task in tasks[:3]] == [0.5, 0.2, 14400]


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("l.scp", "x touch hacked |\n", "l.scp:1"),
        ("l.scp", "../../x in/a.wav\n", r"l.scp:1 & id '\.\./\.\./x'"),
        ("l.scp", ".gesturekit/plan in/a.wav\n", r"\.gesturekit"),
        ("l.txt", "\n\n", "l.txt & empty"),
        ("l.txt", "a\0b\n", "l.txt:1"),
        ("l.txt", "x" * 70_000, "l.txt:1"),
        ("l.txt", "in/a.wav\nother/../in/a.wav\nout/day/a.wav\nin/a.flac", "in/a.wav & in/a.flac"),
        ("l.jsonl", '{"audio": "a.wav"}\n{"audio": 3}', "l.jsonl:2 & audio & 3"),
        ("l.jsonl", '{"audio": "a.wav", "colour": 3}', "'colour'"),
        ("l.jsonl", '{"audio": "a.wav", "id": "../a"}', r"'\.\./a'"),
        ("l.jsonl", '{"id": "a", "seconds": 1e99}', "seconds & 1e"),
        ("l.jsonl", '{"id": "a", "seconds": NaN}', "seconds & NaN"),
        ("l.jsonl", '{"audio": "a.wav", "seed": -1}', "l.jsonl:1 & seed & -1"),
        ("l.jsonl", '{"seed": 3}', "l.jsonl:1 & audio"),
        ("l.jsonl", '{"id": "a"}', "l.jsonl:1 & audio"),
        ("l.jsonl", '{"schema": 1}', "--corpus"),
        ("l.jsonl", "[" * 20_000, "l.jsonl:1"),
        ("l.jsonl", '{"id": "a", "seconds": 0}', "seconds & 0"),
        ("l.jsonl", '{"id": "a", "seconds": 14400.1}', "seconds & 14400.1"),
        ("l.jsonl", '{"audio": "a.wav", "seed": true}', "seed & true"),
        ("l.jsonl", '{"audio": "a.wav", "start": -0.1}', "start & -0.1"),
        ("l.jsonl", '{"audio": "a.wav", "channel": 0}', "channel & 0"),
        ("none.txt", None, "none.txt"),
    ],
)
def test_lists_that_are_refused_name_the_line(folder, tmp_path, name, text, says):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError) as caught:
        find_tasks(name, tmp_path / "out")
    assert all(re.search(fact, str(caught.value)) for fact in says.split(" & "))
    assert not (tmp_path / "hacked").exists()


@pytest.mark.parametrize(
    ("options", "seconds"),
    [
        ({}, 0.5),
        ({"start": 0.2}, 0.3),
        ({"seconds": 0.4}, 0.4),
        ({"start": 0.2, "seconds": 0.4}, 0.3),
        ({"start": 0.7}, 0.0),
        ({"item": Item(id="a", audio=Path("a"), motion=None, duration=0.1)}, 0.1),
    ],
)
def test_a_task_is_as_long_as_the_part_of_the_sound_that_it_uses(folder, options, seconds):
    """The sound has half a second."""
    found = length_of(Task("a", folder / "a.wav", more=options))
    assert found == pytest.approx(seconds, abs=1e-9)
    if set(options) == {"seconds"}:
        assert length_of(Task("a", more=options)) == seconds, "without a sound"


def test_a_file_that_is_named_twice_is_made_once_and_two_of_a_name_are_refused(
    folder, tmp_path, write_speech
):
    twice = ["in/a.wav", folder / "a.wav", "in/day/../a.wav"]
    assert [task.id for task in find_tasks(twice, tmp_path / "out")] == ["a"]
    assert [task.id for task in find_tasks("in/a.wav", tmp_path / "out")] == ["a"]
    for number in range(3):
        write_speech(tmp_path / str(number) / "a.wav", 0.5)
    others = [tmp_path / str(number) / "a.wav" for number in range(3)]
    with pytest.raises(ConfigError, match="(?=.*0/a.wav)(?=.*1/a.wav)(?=.*out/a)"):
        find_tasks(others[:2], tmp_path / "out")
    with pytest.raises(ConfigError, match=r"(?=.*1/a.wav)(?=.*out/a)(?=.*1 more)"):
        find_tasks(others, tmp_path / "out")


def test_results_within_the_folder_of_sounds_and_hidden_files_are_no_inputs(
    folder, tmp_path, write_speech
):
    for name in ("day/out/x", "day/out/sub/x", ".hidden/y", "day/z"):
        write_speech(folder / f"{name}.wav", 0.5)
    names = {"a", "day/b", "day/night/c", "day/z"}
    assert {task.id for task in find_tasks(folder, folder / "day" / "out")} == names
    more = names | {"day/out/x", "day/out/sub/x"}
    assert {task.id for task in find_tasks(folder, folder)} == more
    # A sound that cannot be decoded counts only if none of its name can.
    for name in ("a.wma", "b.wma"):
        (folder / name).write_text("x")
    assert {task.id for task in find_tasks(folder, folder / "day" / "out")} == names | {"b"}
