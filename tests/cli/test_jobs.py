"""gesturekit jobs, and the options of render for many files."""

import json
import os
import re
import socket
from pathlib import Path

import pytest

from gesturekit.jobs import STATE, Journal, Lease, Result, Task, status_of, write_plan


@pytest.fixture
def sounds(tmp_path, write_speech):
    for number in range(6):
        write_speech(tmp_path / "in" / f"d{number % 2}" / f"{number:02d}.wav", 0.3)
    for number in (3, 5):
        (tmp_path / "in" / "d1" / f"{number:02d}.wav").write_text(f"Dear diary {number},\n")
    return tmp_path / "in"


def test_the_state_of_a_run_is_shown_at_any_time(gesturekit, model, sounds, tmp_path):
    out, page = tmp_path / "out", tmp_path / "page.html"
    gesturekit("jobs", tmp_path).fails(2, str(tmp_path))
    common = ("render", sounds, "--model", model, "--out", out)
    assert gesturekit(*common, "--shard", "2/3").status in (0, 1)
    shown = gesturekit("jobs", out).ok()
    assert "1 of 3" in shown.out and len(status_of(out).left) == 4
    for shard in ("1/3", "3/3"):
        gesturekit(*common, "--shard", shard)
    shown = gesturekit("jobs", out, "--failed", "--left")
    assert "6 items" in shown.out and "failed" in shown.out
    assert re.search(r"(?=.*\b2x?\b)(?=.*Dear dia)", shown.out), "reasons are grouped"
    assert "d1/03" in shown.out and "d1/05" in shown.out and "d0/" not in shown.out
    values = json.loads(gesturekit("jobs", out, "--json").out)
    assert (values["done"], len(values["failed"]), values["left"]) == (4, 2, [])
    gesturekit("jobs", out, "--page", page).ok()
    assert page.read_text().count("<img") == 4 and "d1/03" in page.read_text()


def begun(folder: Path, *names: str) -> Journal:
    """The journal of a run over items of these names."""
    (folder / STATE / "journal").mkdir(parents=True)
    write_plan(folder / STATE / "plan.jsonl", [Task(name) for name in names], 1, "r")
    return Journal(folder / STATE, 1, 1, run="a", settings={}, about={})


def test_names_from_a_journal_cannot_write_to_the_terminal(gesturekit, tmp_path):
    odd = "a\x1b[2J\udcff"
    journal = begun(tmp_path, odd, "b\x1b")
    journal.finish(Result(Task(odd), "failed", error=f"{odd}: broken\x1b[31m"))
    journal.start("b\x1b")
    journal.close()
    for arguments in (["--failed", "--left"], ["--page", tmp_path / "page.html"]):
        shown = gesturekit("jobs", tmp_path, *arguments)
        assert shown.status == 0 and "\x1b" not in shown.out and "[2J" in shown.out


def test_the_state_of_a_run_in_its_lines(gesturekit, tmp_path):
    """Two items of four take a minute each and last 90 s of sound: half of 360 s is left."""
    state = tmp_path / STATE
    (state / "journal").mkdir(parents=True)
    write_plan(state / "plan.jsonl", [Task(name, duration=90.0) for name in "abcd"], 2, "r")
    lines = [
        {"status": "done", "id": name, "time": at, "seconds": 60.0, "sound": 90.0, "key": ""}
        for name, at in (("a", 1060.0), ("c", 1120.0), ("earlier", 100.0))
    ]
    lines += [{"started": "b", "time": 2000.0, "run": "r"}]
    text = "".join(f"{json.dumps(line)}\n" for line in lines)
    (state / "journal" / "00001-of-00002.jsonl").write_text(text)
    shown = gesturekit("jobs", tmp_path).ok().out
    for fact in ("4 items", "6 min", "1 of 2", "1.5"):
        assert fact in shown
    assert re.search(r"(?=.*killed)(?=.*\bb\b)", shown)
    lease = Lease(state, 2, 2, {})
    shown = gesturekit("jobs", tmp_path).ok().out
    assert str(os.getpid()) in shown and socket.gethostname() in shown and "2 min" in shown
    values = json.loads(gesturekit("jobs", tmp_path, "--json").ok().out)
    assert (values["seconds_left"], values["done"], len(values["left"])) == (120, 2, 2)
    assert (values["items_per_minute"], values["real_time_factor"]) == (1.0, 1.5)
    assert values["shards"] == [[2, 2], [2, 0]]
    lease.release()


def test_a_dry_run_lists_each_sound_with_its_length_and_writes_nothing(
    gesturekit, write_speech, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    write_speech(tmp_path / "in" / "a.wav", 1.5)
    (tmp_path / "in" / "c.wav").write_text("Dear diary,")
    command = ("render", "in", "--model", "demo", "--out", "out", "--format", "bvh,npz")
    done = gesturekit(*command, "--dry-run").ok()
    assert re.search(r"(?=.*\b1\.5 s)(?=.*in/a.wav)(?=.*out/a.bvh)(?=.*out/a.npz)", done.out)
    assert re.search(r"(?=.*fail)(?=.*in/c\.wav)", done.out)
    assert "1 to make" in done.err and "1 to fail" in done.err and not (tmp_path / "out").exists()
    assert gesturekit(*command).status == 1
    assert "0 to make" in gesturekit(*command, "--dry-run").err
