"""gesturekit jobs, and the options of render for many files."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import socket
import time
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import soundfile

from gesturekit import Motion
from gesturekit.jobs.journal import Journal
from gesturekit.jobs.lease import Lease
from gesturekit.jobs.plan import write_plan
from gesturekit.jobs.result import Result
from gesturekit.jobs.state import STATE
from gesturekit.jobs.task import Task
from gesturekit.rendering import batch, summary


@pytest.fixture
def sounds(tmp_path, write_speech):
    for number in range(20):  # as many as have a summary page
        write_speech(tmp_path / "in" / f"d{number % 2}" / f"{number:02d}.wav", 0.3)
    for number in (3, 5, 7, 9):
        (tmp_path / "in" / "d1" / f"{number:02d}.wav").write_text(f"Dear diary {number},\n")
    return tmp_path / "in"


def test_the_state_of_a_run_is_shown_at_any_time(gesturekit, model, sounds, tmp_path):
    out = tmp_path / "out"
    gesturekit("jobs", tmp_path).fails(2, "no plan in it")
    common = ("render", sounds, "--model", model, "--out", out)
    assert gesturekit(*common, "--shard", "2/3").status in (0, 1)
    shown = gesturekit("jobs", out)
    assert shown.status == 0 and re.search(r"^done \d+, failed \d, left 1\d$", shown.out, re.M)
    assert "shards: 1 of 3 finished" in shown.out
    for shard in ("1/3", "3/3"):
        gesturekit(*common, "--shard", shard)
    shown = gesturekit("jobs", out, "--failed", "--left")
    assert "20 items" in shown.out and "done 16, failed 4, left 0" in shown.out
    assert re.search(r"^ +4x cannot be read as sound", shown.out, re.M), "reasons are grouped"
    assert shown.out.count("\nfailed 1x  d1/0") == 4 and "left  " not in shown.out
    values = json.loads(gesturekit("jobs", out, "--json").out)
    assert (values["done"], len(values["failed"]), values["left"]) == (16, 4, [])
    page = tmp_path / "page.html"
    assert gesturekit("jobs", out, "--page", page).status == 0
    text = page.read_text()
    assert text.count("<img") == 6 and "cannot be read as sound" in text


def test_a_clock_that_was_set_back_does_not_reorder_results(gesturekit, gesture, tmp_path):
    """A file fails, the clock is set back by a day, the file is mended: it is done."""
    source, out = tmp_path / "in.bvh", tmp_path / "out"
    source.write_text("HIERARCHY\n")
    arguments = ["convert", source, out, "--format", "npz"]
    assert gesturekit(*arguments).status == 1
    (journal,) = (out / STATE / "journal").iterdir()
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    later = [{**line, "time": line["time"] + 86_400} for line in lines]
    journal.write_text("".join(f"{json.dumps(line)}\n" for line in later))
    gesture(1.0).save(source)
    assert gesturekit(*arguments).status == 0
    assert "done 1, failed 0, left 0" in gesturekit("jobs", out).out


def test_differing_numbers_in_a_reason_are_shown_as_n(gesturekit, model, tmp_path):
    for name, samples in (("a", 100), ("b", 200)):
        (tmp_path / "in").mkdir(exist_ok=True)
        soundfile.write(tmp_path / "in" / f"{name}.wav", np.zeros(samples), 16000)
    gesturekit("render", tmp_path / "in", "--model", model, "--out", tmp_path / "out")
    shown = gesturekit("jobs", tmp_path / "out").out
    assert "2x N samples at 16000 Hz are N ms: give at least 25 ms (first: a)" in shown


def test_a_dry_run_writes_nothing(gesturekit, model, sounds, tmp_path):
    out = tmp_path / "out"
    common = ("render", sounds, "--model", model, "--out", out, "--dry-run")
    done = gesturekit(*common)
    assert done.status == 0 and not out.exists()
    actions = [line.split()[0] for line in done.out.splitlines()]
    assert (actions.count("make"), actions.count("fail")) == (16, 4)
    assert re.search(r"^16 to make, 0 to keep, 4 to fail; .* of sound, about \d", done.err, re.M)
    assert gesturekit(*common[:-1]).status == 1
    done = gesturekit(*common)
    assert "0 to make, 16 to keep, 4 to fail" in done.err
    assert (out / STATE / "summary.html").is_file()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--shard", "0/3"], "shard '0/3': expected"),
        (["--shard", "3"], "shard '3': expected"),
        (["--workers", "0"], "--workers"),
        (["--deadline", "0"], "--deadline"),
    ],
)
def test_wrong_options(gesturekit, model, sounds, tmp_path, arguments, says):
    done = gesturekit("render", sounds, "--model", model, "--out", tmp_path / "out", *arguments)
    assert done.status == 2 and says in done.err and not (tmp_path / "out").exists()


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
        assert shown.status == 0 and "\x1b" not in shown.out and "a?[2J?" in shown.out
    assert "in progress when a run was killed: b?" in shown.out


def test_the_state_of_a_run_in_its_lines(gesturekit, tmp_path):
    """Two items of four take a minute each and last 90 s of sound: half of 360 s is left."""
    state = tmp_path / STATE
    (state / "journal").mkdir(parents=True)
    write_plan(state / "plan.jsonl", [Task(name, duration=90.0) for name in "abcd"], 2, "r")
    lines = [
        {"status": "done", "id": name, "time": at, "seconds": 60.0, "sound": 90.0, "key": ""}
        for name, at in (("a", 1060.0), ("c", 1120.0), ("earlier", 100.0))
    ]
    lines += [{"started": name, "time": 2000.0, "run": "r"} for name in "bdefghi"]
    text = "".join(f"{json.dumps(line)}\n" for line in lines)
    (state / "journal" / "00001-of-00002.jsonl").write_text(text)
    shown = [
        f"{tmp_path}: 4 items, 6 min 0 s of sound",
        "done 2, failed 0, left 2",
        "done earlier, not in the current plan: 1",
        "shards: 1 of 2 finished",
    ]
    speed = "speed: 1.0 items a minute, 1.5x real time"
    killed = "in progress when a run was killed: b, d, e, f, g"
    assert gesturekit("jobs", tmp_path).ok().out.splitlines() == [*shown, killed, speed]
    lease = Lease(state, 2, 2, {})
    beat = time.time() - 30
    os.utime(lease.path, (beat, beat))
    running = f"running: process {os.getpid()} on {socket.gethostname()}, 00002-of-00002, last "
    found = gesturekit("jobs", tmp_path).ok().out.splitlines()
    assert found[:4] == shown and found[5:] == [f"{speed}; 2 min 0 s left"]
    assert re.fullmatch(rf"{running}heartbeat (29|3\d) s ago", found[4])
    (values,) = (json.loads(gesturekit("jobs", tmp_path, "--json").ok().out),)
    assert values["seconds_left"] == 120 and values["shards"] == [[2, 2], [2, 0]]
    lease.release()


def test_the_reasons_of_failures_are_the_most_frequent_first(gesturekit, tmp_path):
    names = [f"i{number:02d}" for number in range(18)]
    journal = begun(tmp_path, *names)
    for number, name in enumerate(names[:16]):
        reason = "damaged" if number < 3 else f"reason {'abcdefghijklm'[number - 3]}"
        for _ in range(3 if name == "i05" else 1):
            journal.finish(Result(Task(name), "failed", error=reason))
    journal.close()
    lines = gesturekit("jobs", tmp_path, "--left").out.splitlines()
    assert lines[0].startswith(f"{tmp_path}: 18 items, ")
    assert "done 0, failed 16 (1 put aside after three failures), left 2" in lines
    assert "     3x damaged (first: i00)" in lines
    assert sum("x reason " in line for line in lines) == 11
    assert "        and 2 more reasons; --failed lists all" in lines
    assert lines[-2:] == ["left  i16", "left  i17"]
    assert "failed 3x  i05: reason c" in gesturekit("jobs", tmp_path, "--failed").out
    gesturekit("jobs", tmp_path, "--page", tmp_path / "page.txt").fails(2, "name it .html")
    (tmp_path / "page.htm").write_text("mine")
    kept = gesturekit("jobs", tmp_path, "--page", tmp_path / "page.htm", "--existing", "skip")
    assert kept.ok() and (tmp_path / "page.htm").read_text() == "mine"


def test_a_dry_run_lists_each_sound_with_its_length(
    gesturekit, write_speech, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    write_speech(tmp_path / "in" / "a.wav", 1.5)
    write_speech(tmp_path / "in" / "b.wav", 12.25)
    (tmp_path / "in" / "c.wav").write_text("Dear diary,")
    options = ("--model", "demo", "--out", "out", "--format", "bvh,npz", "--workers", 2)
    done = gesturekit("render", "in", *options, "--dry-run").ok()
    made, longer, failed = done.out.splitlines()
    assert made == "make      1.5 s  in/a.wav -> out/a.bvh, out/a.npz"
    assert longer == "make     12.2 s  in/b.wav -> out/b.bvh, out/b.npz"
    assert failed.startswith("fail        ? s  in/c.wav -> ") and "cannot be read" in failed
    sums = r"2 to make, 0 to keep, 1 to fail; 14 s of sound, about \d+\.\d MB and .* with 2 of"
    assert re.search(sums, done.err)
    # Two sounds of 13.75 s take 2 x 2 s + 13.75 x 0.5 s of one worker and 2 x 1 MB + 13.75 x 2 MB.
    cost = batch.Cost((2.0, 1e6), (0.5, 2e6))
    monkeypatch.setattr(batch, "measured_cost", lambda _: cost)
    done = gesturekit("render", "in", *options, "--dry-run").ok()
    assert "14 s of sound, about 29.5 MB and 5.4 s with 2 of --workers" in done.err
    assert not (tmp_path / "out").exists()


def test_large_numbers_of_the_page_are_written_out():
    text = "".join(summary._histogram("Speed", [6.25, *[128.0] * 9, 14_400.0]))
    assert "<p>6.2 to 14,000 (logarithmic); 10 % below 130, half below 130" in text


def test_a_full_disk_ends_a_run_with_its_counts(gesturekit, model, sounds, tmp_path, monkeypatch):
    save, saved = Motion.save, []

    def full(self, path, **options):
        saved.append(path)
        if len(saved) > 4:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        save(self, path, **options)

    def no_page(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    common = ("render", sounds, "--model", model, "--out", tmp_path / "out")
    with monkeypatch.context() as patch:
        patch.setattr(Motion, "save", full)
        patch.setattr(summary, "write_summary", no_page)
        done = gesturekit(*common)
    assert done.status == 1 and "the same command continues" in done.err
    assert "summary.html: not written" in done.err
    assert re.match(r"4 rendered, 1 failed in ", done.err.splitlines()[-1])
    again = gesturekit(*common)
    assert re.match(r"12 rendered, 4 kept, 4 failed in ", again.err.splitlines()[-1])


class Tags(HTMLParser):
    """Names of the elements of a page, and the text between them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.attributes: list[str] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.names.append(tag)
        self.attributes += [name for name, _ in attributes]

    def handle_data(self, data):
        self.text += data


def test_names_with_html_are_text_on_the_page(gesturekit, model, write_speech, tmp_path):
    """Names of results, of failures and of the folder itself."""
    good, bad = 'x"onload="alert(1)"><script>alert(2)<', "<b onclick=alert(3)>bad"
    folder = tmp_path / "<i>in"
    write_speech(folder / f"{good}.wav", 0.4)
    (folder / f"{bad}.wav").write_text("<script>alert(4)</script>")  # quoted in the reason
    out = tmp_path / "<u>out"
    assert gesturekit("render", folder, "--model", model, "--out", out).status == 1
    page = tmp_path / "page.html"
    assert gesturekit("jobs", out, "--page", page).status == 0
    read = Tags(page.read_text())
    assert read.names.count("img") == 1 and not {"script", "b", "i", "u"} & {*read.names}
    assert not [name for name in read.attributes if name.startswith("on")]
    assert all(name in read.text for name in (good, bad, "<u>out"))


def test_the_page_of_a_folder_is_html_whatever_its_journal_says(gesturekit, tmp_path):
    journal = begun(tmp_path, *"abcd")
    for name, sound in zip("abcd", (0.0, 1.0, 2.0, math.inf)):
        journal.finish(Result(Task(name), "done", sound=sound, seconds=1.0))
    journal.close()
    for name in ("3", "page.bvh"):
        gesturekit("jobs", tmp_path, "--page", tmp_path / name).fails(2, "name it .html")
        assert not (tmp_path / name).exists()
    page = tmp_path / "page.html"
    done = gesturekit("jobs", tmp_path, "--page", page)
    assert done.status == 0 and "<p>1 to 2 (logarithmic)" in page.read_text()
