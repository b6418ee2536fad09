"""Work on many inputs: shards, processes, faults; every way gives the same bytes."""

from __future__ import annotations

import errno
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from outputs import results

from gesturekit.errors import ConfigError, OutputError
from gesturekit.jobs import run as execution
from gesturekit.jobs.journal import History, Journal
from gesturekit.jobs.plan import PLAN, Plan
from gesturekit.jobs.run import Execution
from gesturekit.jobs.state import STATE
from gesturekit.jobs.status import status_of
from gesturekit.jobs.workers import Failure
from gesturekit.motion.motion import Motion
from gesturekit.rendering.batch import iter_render
from gesturekit.rendering.renderer import Output, Renderer


@pytest.fixture
def sounds(tmp_path, write_speech):
    lengths = {"a": 0.5, "b": 1.2, "day/c": 0.3, "day/d": 0.8, "e": 0.4}
    for name, seconds in lengths.items():
        write_speech(tmp_path / "in" / f"{name}.wav", seconds)
    return tmp_path / "in"


def run(model, sources, out, **settings):
    options = {"output": Output(("bvh", "npz")), "execution": Execution(**settings)}
    return list(iter_render(model, sources, out, **options))


@pytest.fixture
def whole(model, sounds, tmp_path):
    run(model, sounds, tmp_path / "whole")
    return results(tmp_path / "whole")


def test_shards_in_any_order_and_processes_give_the_same_bytes(model, sounds, tmp_path, whole):
    for number in (3, 1, 2):
        outcomes = run(model, sounds, tmp_path / "sharded", shard=(number, 3))
        assert all(outcome.error is None for outcome in outcomes)
    assert results(tmp_path / "sharded") == whole
    outcomes = run(model, sounds, tmp_path / "workers", workers=2)
    assert len(outcomes) == 5 and results(tmp_path / "workers") == whole
    run(model, [sounds / "b.wav"], tmp_path / "alone")
    one = {name: data for name, data in whole.items() if name.startswith("b.")}
    assert results(tmp_path / "alone") == one
    # What shards made is kept by a run of all.
    assert [len(o.kept) for o in run(model, sounds, tmp_path / "sharded")] == [2] * 5


def test_shards_share_the_first_ones_plan(model, sounds, tmp_path, write_speech):
    out = tmp_path / "out"
    run(model, sounds, out, shard=(1, 2))
    first = (out / STATE / PLAN).read_bytes()
    write_speech(sounds / "later.wav", 0.4)
    run(model, sounds, out, shard=(2, 2))
    assert (out / STATE / PLAN).read_bytes() == first and not (out / "later.bvh").exists()
    for number in (1, 2):
        run(model, sounds, out, shard=(number, 2), replan=number == 1)
    assert (out / "later.bvh").exists() and status_of(out).done == 6


def test_a_live_run_is_never_mixed_with_another(model, sounds, tmp_path):
    out = tmp_path / "out"
    going = iter_render(model, sounds, out)
    next(going)
    before = results(out)
    with pytest.raises(ConfigError, match="it is in use, by process"):
        list(iter_render(model, sounds, out))
    with pytest.raises(ConfigError, match="another run, with other inputs or settings"):
        run(model, sounds / "day", out)
    with pytest.raises(ConfigError, match="another run"):
        list(iter_render(model, sounds, out, execution=Execution(shard=(1, 2)), seed=1))
    assert results(out) == before
    assert len(list(going)) == 4
    assert status_of(out).done == 5 and not status_of(out).running


def test_other_shards_of_the_same_run_may_work_at_once(model, sounds, tmp_path):
    out = tmp_path / "out"
    going = [iter_render(model, sounds, out, execution=Execution(shard=(n, 2))) for n in (1, 2)]
    for one in going:
        next(one)
    assert len(status_of(out).running) == 2
    with pytest.raises(ConfigError, match="another run"):
        replace_all = {"output": Output(existing="replace"), "seed": 1}
        list(iter_render(model, sounds, out, execution=Execution(shard=(2, 2)), **replace_all))
    assert sum(len(list(one)) for one in going) == 3


def test_three_failures_put_an_item_aside_until_it_changes(model, sounds, tmp_path, write_speech):
    out = tmp_path / "out"
    (sounds / "b.wav").write_text("Dear diary,\n")
    for attempt in (1, 2, 3):
        outcomes = run(model, sounds, out)
        (failed,) = [outcome for outcome in outcomes if outcome.error]
        assert "put aside" not in failed.error
        assert sum(bool(outcome.files) for outcome in outcomes) == (4 if attempt == 1 else 0)
    lines = (out / STATE / "journal" / "00001-of-00001.jsonl").read_text()
    tried = [json.loads(line) for line in lines.splitlines() if '"failed"' in line]
    assert [line["attempt"] for line in tried] == [1, 2, 3]
    (aside,) = [outcome.error for outcome in run(model, sounds, out) if outcome.error]
    assert "cannot be read as sound" in aside and "put aside after 3 failures" in aside
    again = (out / STATE / "journal" / "00001-of-00001.jsonl").read_text()
    assert again.count('"started"') == lines.count('"started"'), "it was not tried"
    assert status_of(out).failed[0].is_aside
    (failed,) = [o.error for o in run(model, sounds, out, retry_failed=True) if o.error]
    assert "put aside" not in failed
    write_speech(sounds / "b.wav", 0.6)
    assert not [outcome for outcome in run(model, sounds, out) if outcome.error]
    assert status_of(out).done == 5 and not status_of(out).failed


def test_a_full_disk_stops_the_work_and_loses_nothing(model, sounds, tmp_path, monkeypatch, whole):
    out, save = tmp_path / "out", Motion.save

    def full(self, path, **options):
        if Path(path).name == "b.npz":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        save(self, path, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Motion, "save", full)
        with pytest.raises(OutputError, match="No space left on device.*same command continues"):
            run(model, sounds, out)
    assert results(out).keys() == {"a.bvh", "a.npz", "b.bvh"}
    assert not status_of(out).failed and len(status_of(out).left) == 4
    outcomes = run(model, sounds, out)
    assert [len(outcome.files) for outcome in outcomes] == [0, 1, 2, 2, 2]
    assert results(out) == whole


def test_a_journal_on_a_full_disk_stops_the_work(model, sounds, tmp_path, monkeypatch, whole):
    def full(self, entry):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "finish", full)
        with pytest.raises(OutputError, match="No space left"):
            run(model, sounds, tmp_path / "out")
    run(model, sounds, tmp_path / "out")
    assert results(tmp_path / "out") == whole


class OneDies:
    """A pool whose first task is lost."""

    def __init__(self, function, workers, deadline):
        self.function = function

    def map(self, tasks, begin):
        for number, task in enumerate(tasks):
            begin(task)
            yield task, Failure("its worker died") if number == 0 else self.function(task)

    def close(self):
        pass


def test_a_worker_that_dies_costs_one_item(model, sounds, tmp_path, whole, monkeypatch):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(execution, "Pool", OneDies)
        outcomes = run(model, sounds, out, workers=2)
    (error,) = [outcome.error for outcome in outcomes if outcome.error]
    assert error == f"{sounds / 'a.wav'}: its worker died"
    # A file that it may have written without a line in the journal is written again.
    (out / "a.bvh").write_text("of the dead worker")
    assert [len(outcome.files) for outcome in run(model, sounds, out)] == [2, 0, 0, 0, 0]
    assert results(out) == whole


@pytest.mark.stress
def test_a_slow_item_fails_at_the_deadline_until_it_changes(model, sounds, tmp_path, write_speech):
    write_speech(sounds / "b.wav", 1200.0)
    outcomes = run(model, sounds, tmp_path / "out", deadline=1.0)
    (late,) = [outcome for outcome in outcomes if outcome.error]
    assert late.source.endswith("b.wav") and "stopped after 1 s, the deadline" in late.error
    assert len(results(tmp_path / "out")) == 8
    write_speech(sounds / "b.wav", 0.5)
    assert not [outcome for outcome in run(model, sounds, tmp_path / "out") if outcome.error]


def test_an_item_in_progress_in_two_killed_runs_is_rendered_last(model, sounds, tmp_path):
    out = tmp_path / "out"
    run(model, sounds / "day", out)
    (out / "d.bvh").unlink()
    renderer = Renderer(model, out, Output(("bvh", "npz")), None, None, {})
    run_of = {"run": renderer.run, "settings": renderer.settings}
    for _ in range(2):
        journal = Journal(out / STATE, 1, 1, about={"written": renderer.written}, **run_of)
        journal.start("d")
        journal.close()
    (out / ".d-abcd1234.bvh").write_text("half")
    assert History(out / STATE).killed("d") == [renderer.run] * 2
    _, outcome = run(model, sounds / "day", out)
    assert outcome.files == (out / "d.bvh",)
    assert len(results(out)) == 4


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
    with pytest.raises(ConfigError, match="another seed .2 refused, 4 kept"):
        run(model, sounds / "night.jsonl", tmp_path / "out")


@pytest.fixture
def read_only(tmp_path) -> Iterator[Path]:
    """A folder that this user cannot write to; for root, a read-only file system."""
    path = tmp_path / "out"
    path.mkdir(mode=0o555)
    if not os.access(path, os.W_OK):
        yield path
        return
    try:
        mount = ["mount", "-t", "tmpfs", "-o", "ro", "tmpfs", str(path)]
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this user may write everywhere, and not mount a read-only file system")
    yield path
    subprocess.run(["umount", str(path)], check=True)


def test_a_read_only_folder_is_refused(model, sounds, read_only):
    with pytest.raises(ConfigError, match=f"{read_only}: cannot be written to; give another"):
        run(model, sounds, read_only)
    assert list(read_only.iterdir()) == []


def test_files_outside_the_output_folder_in_a_journal_are_not_read(model, sounds, tmp_path):
    from gesturekit.rendering.summary import write_summary

    out = tmp_path / "out"
    run(model, sounds / "day", out)
    model.generate(seconds=0.5).save(tmp_path / "secret.bvh")
    path = out / STATE / "journal" / "00001-of-00001.jsonl"
    path.write_text(path.read_text().replace('"d.bvh"', '"../secret.bvh"'))
    write_summary(out, status_of(out), tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text().count("<img") == 1


def test_the_page_has_quantiles_of_length_and_speed(model, sounds, tmp_path):
    """0.3, 0.4, 0.5, 0.8 and 1.2 s of sound in 0.01 s each: 30 to 120 times real time."""
    from gesturekit.rendering.summary import write_summary

    out = tmp_path / "out"
    run(model, sounds, out)
    path = out / STATE / "journal" / "00001-of-00001.jsonl"
    path.write_text(
        re.sub(r'"seconds": [\d.e-]+, "sound"', '"seconds": 0.01, "sound"', path.read_text())
    )
    for file in (*out.rglob("*.bvh"), *out.rglob("*.npz")):
        file.unlink()  # no time for their pictures
    write_summary(out, status_of(out), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    lengths, speeds = page.split("Speed, times real time")
    said = "<p>{} to {} (logarithmic); 10 % below {}, half below {}, 90 % below {}</p>"
    # One tenth lies 0.4 of the way from the least to the second, nine 0.6 from the fourth on.
    assert said.format("0.3", "1.2", "0.34", "0.5", "1") in lengths
    assert said.format("30", "120", "34", "50", "100") in speeds


def command(model, sounds, out, workers: int) -> list[str]:
    render = [sys.executable, "-m", "gesturekit", "render", sounds, "--model", model.folder]
    return [*render, "--out", out, "--format", "bvh,npz", "--workers", str(workers)]


def killed_at_random(model, sounds, out, kills: int, workers: int, seed: int) -> int:
    """Run and kill `kills` times, then run to the end; return how often it was still running."""
    rng, hits = random.Random(seed), 0
    render, nowhere = command(model, sounds, out, workers), subprocess.DEVNULL
    for _ in range(kills):
        process = subprocess.Popen(render, stdout=nowhere, stderr=nowhere, start_new_session=True)
        begin = time.monotonic()
        while not list((out / STATE).glob("leases/*.json")) and process.poll() is None:
            assert time.monotonic() - begin < 60
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.6 * workers))
        hits += process.poll() is None
        if rng.random() < 0.5:
            process.kill()  # its workers notice, and end themselves
        else:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    done = subprocess.run(render, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return hits


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.stress)])
def test_a_run_that_is_killed_continues(model, tmp_path, write_speech, workers):
    sounds, out = tmp_path / "in", tmp_path / "out"
    for number in range(12):
        write_speech(sounds / f"{number}.wav", 0.5)
    run(model, sounds, tmp_path / "whole")
    render = command(model, sounds, out, workers)
    process = subprocess.Popen(render, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout.readline()  # the first result
    os.killpg(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    process.stdout.close()
    assert 1 <= status_of(out).done < 12, "it was not killed in the middle"
    done = subprocess.run(render, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert results(out) == results(tmp_path / "whole") and status_of(out).done == 12


@pytest.mark.stress
def test_runs_killed_at_many_random_moments_continue(model, tmp_path, write_speech):
    sounds = tmp_path / "in"
    for number in range(60):
        write_speech(sounds / f"d{number % 3}" / f"{number}.wav", 0.3 + number % 9 / 5)
    run(model, sounds, tmp_path / "whole")
    whole, hits = results(tmp_path / "whole"), 0
    for trial in range(10):
        out = tmp_path / f"out{trial}"
        hits += killed_at_random(model, sounds, out, 20, 1 + trial % 2, seed=trial)
        assert results(out) == whole
    assert hits > 50, "most kills came too late to interrupt anything"


@pytest.mark.stress
def test_a_hundred_shards_over_a_few_processes(model, tmp_path, write_speech):
    sounds, out = tmp_path / "in", tmp_path / "out"
    for number in range(300):
        write_speech(sounds / f"{number}.wav", 0.2 + number % 7 / 10)
    run(model, sounds, tmp_path / "whole")
    script = (
        "import sys, gesturekit as gk\n"
        "model = gk.load(sys.argv[1])\n"
        "for number in map(int, sys.argv[4].split(',')):\n"
        "    for outcome in gk.render(model, sys.argv[2], sys.argv[3], formats='bvh,npz',\n"
        "                             shard=(number, 100)):\n"
        "        assert outcome.error is None, outcome.error\n"
    )
    order = random.Random(0).sample(range(1, 101), 100)
    parts = [",".join(map(str, order[start::4])) for start in range(4)]
    command = [sys.executable, "-c", script, model.folder, sounds, out]
    processes = [subprocess.Popen([*command, part]) for part in parts]
    assert [process.wait() for process in processes] == [0] * 4
    assert results(out) == results(tmp_path / "whole")
    assert len(Plan.open(out / STATE / PLAN).shards) == 100 and status_of(out).done == 300
