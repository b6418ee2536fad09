"""gesturekit jobs, and the options of render for many files."""

import json
import os
import re
import socket

import pytest

from gesturekit.jobs.records import STATE, claimed, shard_of, status_of, write_items, write_record
from gesturekit.jobs.result import Result, Task


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
    assert "1 of 3" in shown.out and len(status_of(out).left) == 3
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


def test_names_from_a_record_cannot_write_to_the_terminal(gesturekit, tmp_path):
    odd, state = "a\x1b[2J\udcff", tmp_path / STATE
    write_items(state, [odd, "b\x1b"], 1, {})
    write_record(state, Result(Task(odd), "failed", error=f"{odd}: broken\x1b[31m"))
    write_record(state, Result(Task("b\x1b"), "begun"))
    for arguments in (["--failed", "--left"], ["--page", tmp_path / "page.html"]):
        shown = gesturekit("jobs", tmp_path, *arguments)
        assert shown.status == 0 and "\x1b" not in shown.out and "[2J" in shown.out


def test_the_state_of_a_run_in_its_lines(gesturekit, tmp_path):
    """Two items of four take a minute each and last 90 s of sound: two more take two minutes."""
    state = tmp_path / STATE
    write_items(state, [*"abde"], 2, {})
    for name, at in (("a", 1060.0), ("d", 1120.0), ("earlier", 100.0)):
        write_record(state, Result(Task(name), "done", time=at, seconds=60.0, sound=90.0))
    write_record(state, Result(Task("b"), "begun"))
    shown = gesturekit("jobs", tmp_path).ok().out
    for fact in ("4 items", "4 min 30 s", "0 of 2", "1.5"):
        assert fact in shown
    assert re.search(r"(?=.*killed)(?=.*\bb\b)", shown)
    with claimed(state, "shard 2 of 2"):
        shown = gesturekit("jobs", tmp_path).ok().out
        values = json.loads(gesturekit("jobs", tmp_path, "--json").ok().out)
    assert str(os.getpid()) in shown and socket.gethostname() in shown and "2 min" in shown
    assert (values["seconds_left"], values["done"], len(values["left"])) == (120, 2, 2)
    assert (values["items_per_minute"], values["real_time_factor"]) == (1.0, 1.5)
    assert [shard_of(name, 2) for name in "abde"] == [1, 1, 1, 2]
    assert values["shards"] == [[3, 2], [1, 0]]


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
