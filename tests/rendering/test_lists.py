"""Globs and lists as inputs: names of results, options of each, and what is refused."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from outputs import bury

from audio_features.wave import SAMPLE_RATES
from gesturekit.corpus.item import Item
from gesturekit.errors import ConfigError, CorpusError
from gesturekit.jobs.plan import write_plan
from gesturekit.jobs.task import Task
from gesturekit.rendering.inputs import find_tasks, item_of, measured, task_wave


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
    with pytest.raises(ConfigError, match="no audio file matches this pattern"):
        find_tasks("in/*.flac", tmp_path)


def test_a_list_of_paths(folder, tmp_path):
    lines = ("# day 1", f"#{300 * '-'}", "a.wav\r\n", "./day/b.wav", f"{folder}/day/night/c.wav")
    (folder / "night.txt").write_text("\n".join(lines))
    names = {"a": "in/a.wav", "day/b": "in/day/b.wav", "c": "in/day/night/c.wav"}
    assert found("in/night.txt", tmp_path) == names
    # Where there is no such file beside the list, paths are those of the working folder.
    (folder / "more.lst").write_text("in/a.wav\n../in/day/b.wav\n")
    assert found("in/more.lst", tmp_path) == {"in/a": "in/a.wav", "b": "in/day/b.wav"}


def test_limits_of_a_list_are_within_them(folder, tmp_path):
    """A line of 64 KiB, a mark at the start, and the least and greatest numbers."""
    lines = [{"audio": "in/a.wav", "seed": 0, "start": 0, "channel": 1, "seconds": 0.1}]
    lines.append({"id": "long", "seconds": 14_400})
    text = "\ufeff" + "\n\n".join(json.dumps(line) for line in lines)
    (tmp_path / "l.jsonl").write_text(f"{text}{' ' * (65_536 - len(json.dumps(lines[1])))}")
    tasks = find_tasks("l.jsonl", tmp_path / "out")
    assert [(task.id, dict(task.more)) for task in tasks] == [
        ("in/a", {"seed": 0, "start": 0, "channel": 1, "seconds": 0.1}),
        ("long", {"seconds": 14_400}),
    ]
    assert tasks[0].path.exists() and tasks[1].path is None


def test_the_part_and_the_channel_of_a_sound_are_read(tmp_path):
    """Left is 0.1 of a noise, right 0.3, but for the first half second, which is 0.8 on both."""
    noise = np.random.default_rng(0).uniform(0.5, 1, 16_000) * np.resize([1, -1], 16_000)
    shares = np.where(np.arange(16_000)[:, None] < 8000, 0.8, [0.1, 0.3])
    path = tmp_path / "a.wav"
    soundfile.write(path, noise[:, None] * shares, 16_000, "FLOAT")

    def read(usual: int | None = None, **more) -> tuple[float, float, float]:
        """Return seconds, and the shares of the noise in the first and in the last sample."""
        wave, start = task_wave(Task("a", path, more=more), usual), more.get("start", 0)
        first = round(16_000 * start)
        ends = (wave.samples[[0, -1]] / noise[[first, first + len(wave.samples) - 1]]).tolist()
        return wave.duration, *(round(end, 4) for end in ends)

    assert read() == (1.0, 0.8, 0.2) and read(1) == (1.0, 0.8, 0.1)
    assert read(1, channel=2) == (1.0, 0.8, 0.3)
    assert read(start=0.5) == (0.5, 0.2, 0.2)
    assert read(start=0.25, seconds=0.5) == (0.5, 0.8, 0.2)
    assert task_wave(Task("a"), None) is None


def test_an_item_of_a_damaged_plan_is_named(tmp_path):
    item = Item(id="a", audio=tmp_path / "a.wav", motion=None, duration=1.0, audible=[(0, 1)],
                conditions={"events": tmp_path / "e.tsv"})  # fmt: skip
    (task,) = find_tasks(item, tmp_path / "out")
    assert item_of(task) == replace(item, audible=((0, 1),)) and item_of(Task("a")) is None
    assert (task.id, task.path, task.source) == ("a", tmp_path / "a.wav", "a")
    for damaged in ({"id": "a"}, [], task.more["item"] | {"duration": "x"}):
        with pytest.raises(CorpusError, match="plan: item 'a' is damaged .*delete the plan"):
            item_of(Task("a", more={"item": damaged}))


def test_videos_in_a_folder_are_named_and_an_empty_folder_is_refused(folder, tmp_path, caplog):
    for k in range(5):
        (folder / f"{k}.mp4").write_text("x")
    (folder / "notes.pdf").write_text("x")
    assert len(find_tasks(folder, tmp_path / "out")) == 3
    (said,) = (record.getMessage() for record in caplog.records)
    assert said.startswith(f"{folder}/0.mp4, {folder}/1.mp4, {folder}/2.mp4 and 2 more: left out: ")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="holds no audio files that can be read"):
        find_tasks(tmp_path / "empty", tmp_path / "out")
    for k in (3, 4):
        (folder / f"{k}.mp4").unlink()
    caplog.clear()
    find_tasks(folder, tmp_path / "out")
    assert "2.mp4: left out" in caplog.text


def test_a_folder_that_cannot_be_opened_is_an_input_that_failed(folder, tmp_path):
    bury(folder)
    tasks = {task.id: task for task in find_tasks(folder, tmp_path / "out")}
    assert set(tasks) == {"", "a", "day/b", "day/night/c"}
    failed = tasks[""]
    assert str(failed.source).startswith(f"{folder}/xxx") and failed.path is None
    assert failed.error == f"{failed.source}: File name too long"


def test_kaldis_wav_scp(folder, tmp_path):
    (tmp_path / "wav.scp").write_text("spk1-utt1 in/a.wav\nspk1-utt2\tin/day/b.wav\n")
    assert found("wav.scp", tmp_path) == {"spk1-utt1": "in/a.wav", "spk1-utt2": "in/day/b.wav"}


def test_jsonl_has_options_for_each_input(folder, tmp_path):
    given = [{"seed": 3, "style": "old"}, {"start": 0.1, "seconds": 0.2}, {"seconds": 2}]
    about = [{"audio": "in/a.wav"}, {"audio": "in/a.wav", "id": "again/a"}, {"id": "idle"}]
    lines = [json.dumps(one | options) for one, options in zip(about, given, strict=True)]
    (tmp_path / "night.jsonl").write_text("\n".join(lines))
    tasks = [measured(task) for task in find_tasks("night.jsonl", tmp_path / "out")]
    assert [task.id for task in tasks] == ["in/a", "again/a", "idle"]
    assert [dict(task.more) for task in tasks] == given
    assert [task.duration for task in tasks] == [0.5, 0.2, 2]
    plan = write_plan(tmp_path / "plan.jsonl", tasks, 1, "r")
    assert [task.more for task in plan.tasks()] == [task.more for task in tasks]


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("l.scp", "x touch hacked |\n", "l.scp:1: .*is a command, and commands .* never run"),
        ("l.scp", "../../x in/a.wav\n", r"l.scp:1: id '\.\./\.\./x' cannot be used"),
        ("l.scp", "/etc/x in/a.wav\n", "cannot be used"),
        ("l.scp", "alone\n", "expected an id and a path"),
        ("l.scp", ".gesturekit/plan in/a.wav\n", "holds the journal"),
        ("l.txt", "\n\n", "the list is empty"),
        ("l.txt", "a\0b\n", "l.txt:1: this is not a list"),
        ("l.txt", "x" * 70_000, "not a list"),
        ("l.txt", "in/a.wav\nother/../in/a.wav\nout/day/a.wav\nin/a.flac", "both be written as"),
        ("l.jsonl", '{"audio": "a.wav"}\n{"audio": 3}', "l.jsonl:2: audio is 3"),
        ("l.jsonl", '{"audio": "a.wav", "colour": 3}', "unknown field 'colour'; known: audio"),
        ("l.jsonl", '{"audio": "a.wav", "id": "../a"}', "cannot be used"),
        ("l.jsonl", '{"id": "a", "seconds": 1e99}', "seconds is 1e"),
        ("l.jsonl", '{"id": "a", "seconds": NaN}', "seconds is NaN"),
        ("l.jsonl", '{"audio": "a.wav", "seed": true}', "seed is true"),
        ("l.jsonl", '{"audio": "a.wav", "seed": -1}', "l.jsonl:1: seed is -1"),
        ("l.jsonl", '{"seed": 3}', "give audio, or id and seconds"),
        ("l.jsonl", '{"schema": 1}', "--corpus"),
        ("l.jsonl", "[" * 20_000, "not a JSON object"),
        ("l.jsonl", '\n\n"a.wav"\n', "l.jsonl:3: not a JSON object"),
        ("l.jsonl", '{"id": "a", "seconds": 0}', "seconds is 0"),
        ("l.jsonl", '{"id": "a", "seconds": 14401}', "seconds is 14401"),
        ("l.jsonl", '{"audio": "a.wav", "start": -0.1}', "start is -0.1"),
        ("l.jsonl", '{"audio": "a.wav", "channel": 0}', "channel is 0"),
        ("l.jsonl", '{"audio": "a.wav", "channel": 1.5}', "channel is 1.5"),
        ("l.jsonl", '{"seconds": 3}', "give audio, or id and seconds"),
        ("l.jsonl", '{"id": "a"}', "give audio, or id and seconds"),
        ("l.scp", "x | touch hacked\n", "l.scp:1: .*is a command"),
        ("l.txt", "x" * 65_537, "not a list"),
        ("none.txt", None, "no such list"),
    ],
)
def test_lists_that_are_refused_name_the_line(folder, tmp_path, name, text, says):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=says):
        find_tasks(name, tmp_path / "out")
    assert not (tmp_path / "hacked").exists()


@pytest.mark.parametrize(
    ("options", "seconds"),
    [
        ({}, 0.5),
        ({"start": 0.2}, 0.3),
        ({"seconds": 0.4}, 0.4),
        ({"start": 0.2, "seconds": 0.4}, 0.3),
        ({"start": 0.7}, 0.0),
        ({"item": {"duration": 0.1}}, 0.1),
    ],
)
def test_a_task_is_as_long_as_the_part_of_the_sound_that_it_uses(folder, options, seconds):
    """The sound has half a second."""
    found = measured(Task("a", folder / "a.wav", more=options)).duration
    assert found == pytest.approx(seconds, abs=1e-9)
    if set(options) == {"seconds"}:
        assert measured(Task("a", more=options)).duration == seconds, "without a sound"


def test_a_file_that_is_named_twice_is_made_once_and_two_of_a_name_are_refused(
    folder, tmp_path, write_speech
):
    twice = ["in/a.wav", folder / "a.wav", "in/day/../a.wav"]
    assert [task.id for task in find_tasks(twice, tmp_path / "out")] == ["a"]
    assert [task.id for task in find_tasks("in/a.wav", tmp_path / "out")] == ["a"]
    for number in range(3):
        write_speech(tmp_path / str(number) / "a.wav", 0.5)
    others = [tmp_path / str(number) / "a.wav" for number in range(3)]
    with pytest.raises(ConfigError, match=r"0/a.wav and .*1/a.wav would both .*out/a; write them"):
        find_tasks(others[:2], tmp_path / "out")
    with pytest.raises(ConfigError, match=r"1/a.wav would both .*out/a \(and 1 more\); write"):
        find_tasks(others, tmp_path / "out")


def test_results_within_the_folder_of_sounds_and_hidden_files_are_no_inputs(
    folder, tmp_path, write_speech
):
    for name in ("day/out/x", "day/out/sub/x", ".hidden/y", "day/z"):
        write_speech(folder / f"{name}.wav", 0.5)
    names = {"a", "day/b", "day/night/c", "day/z"}
    assert {task.id for task in find_tasks(folder, folder / "day" / "out")} == names
    assert {task.id for task in find_tasks(folder, folder)} == names | {
        "day/out/x",
        "day/out/sub/x",
    }
    # A sound that cannot be decoded counts only if none of its name can.
    for name in ("a.wma", "b.wma"):
        (folder / name).write_text("x")
    assert {task.id for task in find_tasks(folder, folder / "day" / "out")} == names | {"b"}


def test_a_damaged_header_and_a_pipe_have_no_duration(tmp_path, folder):
    data = bytearray((folder / "a.wav").read_bytes())
    data[24:28] = (1).to_bytes(4, "little")  # a sample rate of 1 Hz
    (folder / "a.wav").write_bytes(data)
    assert measured(Task("a", folder / "a.wav")).duration is None
    for rate in SAMPLE_RATES:  # the slowest and the fastest that are read
        soundfile.write(folder / "a.wav", np.zeros(rate), rate)
        assert measured(Task("a", folder / "a.wav")).duration == 1.0
    os.mkfifo(folder / "pipe.wav")
    assert measured(Task("p", folder / "pipe.wav")).duration is None


@pytest.mark.parametrize("seconds", [14_400, 14_401])
def test_a_header_of_more_than_four_hours_has_no_duration(tmp_path, seconds):
    """The file is as long as its header says, of zeros that take no place on disk."""
    path, n = tmp_path / "a.wav", 4000 * seconds
    soundfile.write(path, np.zeros(4000), 4000, "PCM_U8")
    header = bytearray(path.read_bytes()[:44])
    header[4:8], header[40:44] = (36 + n).to_bytes(4, "little"), n.to_bytes(4, "little")
    path.write_bytes(header)
    os.truncate(path, 44 + n)
    assert measured(Task("a", path)).duration == (seconds if seconds == 14_400 else None)
