"""Work on many inputs: shards, processes, faults; every way gives the same bytes."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from outputs import render, results

from gesturekit.errors import ConfigError
from gesturekit.jobs.batch import Execution
from gesturekit.jobs.records import STATE, read_record, status_of, write_record
from gesturekit.jobs.result import Task
from gesturekit.motion import Motion
from gesturekit.rendering import summary
from gesturekit.rendering.renderer import Output


@pytest.fixture
def sounds(tmp_path, write_speech):
    lengths = {"a": 0.5, "b": 1.2, "day/c": 0.3, "day/d": 0.8, "e": 0.4}
    for name, seconds in lengths.items():
        write_speech(tmp_path / "in" / f"{name}.wav", seconds)
    return tmp_path / "in"


def run(model, sources, out, **settings):
    options = {"output": Output(("bvh", "npz")), "execution": Execution(**settings)}
    return list(render(model, sources, out, **options))


@pytest.fixture
def whole(model, sounds, tmp_path):
    run(model, sounds, tmp_path / "whole")
    return results(tmp_path / "whole")


def test_shards_in_any_order_give_the_same_bytes(model, sounds, tmp_path, whole):
    for number in (3, 1, 2):
        outcomes = run(model, sounds, tmp_path / "sharded", shard=(number, 3))
        assert all(outcome.error is None for outcome in outcomes)
    assert results(tmp_path / "sharded") == whole
    # What shards made is kept by a run of all.
    assert [len(o.kept) for o in run(model, sounds, tmp_path / "sharded")] == [2] * 5


def test_a_live_run_is_never_mixed_with_another(model, sounds, tmp_path):
    out = tmp_path / "out"
    going = render(model, sounds, out)
    next(going)
    before = results(out)
    with pytest.raises(ConfigError, match=re.escape(str(out))):
        list(render(model, sounds, out))
    with pytest.raises(ConfigError, match=re.escape(str(out))):
        run(model, sounds / "day", out)
    with pytest.raises(ConfigError, match=re.escape(str(out))):
        list(render(model, sounds, out, execution=Execution(shard=(1, 2)), seed=1))
    assert results(out) == before
    assert len(list(going)) == 4
    assert status_of(out).done == 5 and not status_of(out).running


@pytest.mark.stress
def test_a_slow_item_fails_at_the_deadline_until_it_changes(model, sounds, tmp_path, write_speech):
    write_speech(sounds / "b.wav", 1200.0)
    outcomes = run(model, sounds, tmp_path / "out", deadline=1.0)
    (late,) = [outcome for outcome in outcomes if outcome.error]
    assert late.source.endswith("b.wav") and "1 s" in late.error
    assert len(results(tmp_path / "out")) == 8
    write_speech(sounds / "b.wav", 0.5)
    assert not [outcome for outcome in run(model, sounds, tmp_path / "out") if outcome.error]


def test_options_of_each_line_of_a_list(model, sounds, tmp_path):
    lines = [
        {"audio": "a.wav", "id": "three", "seed": 3},
        {"audio": "b.wav", "id": "part", "start": 0.2, "seconds": 0.4},
        {"id": "idle", "seconds": 1.0, "seed": 3},
        {"audio": "a.wav", "id": "styled", "style": "angry"},
    ]
    (sounds / "night.jsonl").write_text("\n".join(map(json.dumps, lines)))
    *made, styled = run(model, sounds / "night.jsonl", tmp_path / "out")
    made = {Path(o.files[1]).stem: Motion.load(o.files[1]) for o in [*made, styled] if o.files}
    lengths = {name: motion.n_frames for name, motion in made.items()}
    assert lengths == {"three": 13, "part": 10, "idle": 25}
    wanted = model.generate(sounds / "a.wav", seed=3, item="three")
    assert (made["three"].rotations == wanted.rotations).all()
    (item,) = status_of(tmp_path / "out").failed
    assert item.id == "styled" and "style" in item.error
    # A line that changes is one item to do again.
    lines[0]["seed"] = 4
    (sounds / "night.jsonl").write_text("\n".join(map(json.dumps, lines[:3])))
    with pytest.raises(ConfigError, match=r"(?=.*seed)(?=.*\b2\b)(?=.*\b4\b)"):
        run(model, sounds / "night.jsonl", tmp_path / "out")


def test_files_outside_the_output_folder_in_a_record_are_not_read(model, sounds, tmp_path):
    out = tmp_path / "out"
    run(model, sounds / "day", out)
    model.generate(seconds=0.5).save(tmp_path / "secret.bvh")
    record = read_record(out / STATE, Task("d"))
    record.made = {"../secret.bvh": record.made["d.bvh"]}
    write_record(out / STATE, record)
    summary.write_summary(out, status_of(out), tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text().count("<img") == 1


def command(model, sounds, out, workers: int) -> list[str]:
    start = [sys.executable, "-m", "gesturekit", "render", sounds, "--model", model.folder]
    return [*start, "--out", out, "--format", "bvh,npz", "--workers", str(workers)]


@pytest.mark.stress  # of seconds: `test_a_killed_run_goes_on_whatever_it_left_of_its_record`
@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_that_is_killed_continues(model, tmp_path, write_speech, workers):
    sounds, out = tmp_path / "in", tmp_path / "out"
    for number in range(12):
        write_speech(sounds / f"{number}.wav", 0.5)
    run(model, sounds, tmp_path / "whole")
    start = command(model, sounds, out, workers)
    process = subprocess.Popen(start, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout.readline()  # the first result
    os.killpg(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    process.stdout.close()
    assert 1 <= status_of(out).done < 12, "it was not killed in the middle"
    done = subprocess.run(start, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert results(out) == results(tmp_path / "whole") and status_of(out).done == 12
