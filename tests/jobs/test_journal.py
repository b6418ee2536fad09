"""The journal: what is written survives, and damage is ignored."""

import errno
import hashlib
import json
import os

import pytest

from gesturekit.errors import FormatError
from gesturekit.jobs import History, Journal, Result, Task, last_run


@pytest.fixture
def open_journal(tmp_path):
    def make(run="a", shard=1, shards=1):
        return Journal(tmp_path, shard, shards, run=run, settings={"seed": 1}, about={})

    return make


def done(name, key="k", **fields):
    return Result(Task(name), "done", key=key, digests={f"{name}.bvh": {"sha256": "x"}}, **fields)


def test_the_next_run_reads_what_was_done(open_journal, tmp_path):
    for run in ("a", "b"):
        journal = open_journal(run)
        for name in ("one", "two"):
            journal.start(f"{name} {run}")
            journal.finish(done(f"{name} {run}", sound=2.5))
        journal.close()
    history = History(tmp_path)
    assert set(history.runs) == {"a", "b"} and last_run(tmp_path)["run"] == "b"
    (result,) = history.results("two b")
    assert (result.status, result.sound, result.run) == ("done", 2.5, "b")
    assert history.killed("two b") == history.unfinished("two b") == []
    assert History(tmp_path, {"one a"}).names() == ["one a"]


def test_what_begins_and_what_is_done_is_on_the_disk_at_once(open_journal, monkeypatch):
    """Files of an item that a loss of power cut short are known by its start."""
    on_disk = []
    monkeypatch.setattr(os, "fsync", lambda file: on_disk.append(os.pread(file, 1 << 16, 0)))
    journal = open_journal()
    journal.start("one")
    assert b'"started": "one"' in on_disk[-1]
    journal.finish(done("one", sound=1.23456789))
    journal.close()
    line = json.loads(on_disk[-1].splitlines()[-1])
    assert (line["status"], line["id"]) == ("done", "one")
    assert line["sound"] == pytest.approx(1.23456789, abs=0.01)


def begin(run: str, at: float, **settings) -> dict:
    return {"run": run, "settings": settings, "format": 1, "time": at}


def started(name: str, run: str, at: float) -> dict:
    return {"started": name, "run": run, "time": at}


def ended(status: str, name: str, run: str, at: float, **more) -> dict:
    return {"status": status, "id": name, "run": run, "time": at, **more}


def write(state, *lines: dict, name: str = "1") -> History:
    """Write a journal, and return what all journals hold."""
    (state / "journal").mkdir(parents=True, exist_ok=True)
    text = "".join(f"{json.dumps(line)}\n" for line in lines)
    (state / "journal" / f"{name}.jsonl").write_text(text)
    return History(state)


def test_starts_count_since_the_last_result_of_their_item(tmp_path):
    history = write(
        tmp_path,
        *(started("x", "a", 8), started("y", "a", 9), ended("lost", "x", "a", 12)),
        *(started("x", "b", 12), started("z", "b", 12), ended("dropped", "z", "b", 13)),
        started("y", "c", 14),
    )
    assert [history.killed(name) for name in "wxyz"] == [[], ["b"], ["a", "c"], []]
    assert [history.unfinished(name) for name in "wxyz"] == [[], ["b", "a"], ["a", "c"], ["b"]]
    # A journal of another shard has a later result.
    history = write(tmp_path, ended("failed", "y", "d", 20), ended("done", "y", "d", 11), name="2")
    assert history.killed("y") == [] and [r.time for r in history.results("y")] == [11, 20]


def test_the_latest_run_is_found_in_any_journal(tmp_path):
    assert last_run(tmp_path) is None
    write(tmp_path, begin("a", 1.0), begin("c", 30.0), {**begin("h", 90.0), "format": 0})
    lines = [{**begin("b", 20.0), "model": "m"}, ended("done", "x", "z", 99.0, model="n")]
    history = write(tmp_path, *lines, name="2")
    assert set(history.runs) == {"a", "b", "c"}
    assert last_run(tmp_path)["run"] == "c" and last_run(tmp_path, "model")["run"] == "b"


def test_an_existing_file_is_the_same_begun_or_another(tmp_path):
    """As it was when it was written, or by its content; with the same settings and input."""
    file, state = tmp_path / "x.bvh", tmp_path / "state"
    file.write_text("motion")
    stamp = file.stat().st_mtime_ns
    about = {"sha256": hashlib.sha256(b"motion").hexdigest(), "size": 6, "mtime_ns": stamp}
    run = {**begin("a", 1.0, seed=1), "written": {"bvh": {"unit": "cm"}, "npz": {"up": "z"}}}
    result = ended("done", "x", "a", 9.0, files={"x.bvh": about}, input={"input": "sound"})
    history = write(state, run, result, started("y", "a", 11.0))
    same = {"seed": 1, "input": "sound", "unit": "cm"}
    assert history.compare("x", file, same) == "same" and not history.differences("x", file, same)
    for name in same:
        other = {**same, name: 9}
        assert history.compare("x", file, other) == "other"
        assert history.differences("x", file, other) == [name]
    for text, time, found in (
        ("motion", 0, "same"),  # the content is
        ("motions", stamp, "other"),
        ("notion", 0, "other"),
        ("notion", stamp, "same"),  # it is not read again
    ):
        file.write_text(text)
        os.utime(file, ns=(0, time))
        assert history.compare("x", file, same) == found
    # Of an item that a killed run had begun, nothing is known but the settings of the run.
    mine = {"seed": 1, "unit": "cm", "input": "anything"}
    assert history.compare("y", tmp_path / "y.bvh", mine) == "begun"
    assert history.compare("y", tmp_path / "y.bvh", {**mine, "seed": 2}) == "other"
    assert history.compare("y", tmp_path / "y.npz", mine) == "other"


def test_the_digest_of_an_input_is_known_while_the_file_is_unchanged(tmp_path):
    sound = tmp_path / "x.wav"
    sound.write_text("sound")
    stamp = {"size": 5, "mtime_ns": sound.stat().st_mtime_ns}
    history = write(
        tmp_path,
        ended("done", "x", "a", 2.0, input={"input": "second"}, source=stamp),
        ended("done", "x", "a", 3.0, input={"input": "third"}, source={**stamp, "size": 6}),
    )
    assert history.input_digest("x", sound) == "second"
    assert history.input_digest("y", sound) is None


def test_failures_count_for_the_same_key_since_the_last_success(open_journal, tmp_path):
    journal = open_journal()
    for key, status in (("k", "failed"), ("k", "done"), ("k", "failed"), ("other", "failed")):
        journal.finish(Result(Task("x"), status, key=key, error="why"))
    journal.finish(Result(Task("x"), "lost", key="k", error="died"))
    journal.finish(Result(Task("x"), "dropped", key="k"))
    assert [entry.error for entry in History(tmp_path).failures("x", "k")] == ["why", "died"]


@pytest.mark.parametrize("cut", [2, 10, 60])
def test_a_line_cut_short_loses_only_itself(open_journal, tmp_path, cut):
    journal = open_journal()
    journal.finish(done("a"))
    journal.finish(done("b"))
    journal.close()
    (path,) = (tmp_path / "journal").iterdir()
    path.write_bytes(path.read_bytes()[:-cut])
    journal = open_journal()
    journal.finish(done("c"))
    journal.close()
    history = History(tmp_path)
    assert [bool(history.results(name)) for name in "abc"] == [True, False, True]


def test_lines_of_anything_are_ignored(open_journal, tmp_path):
    journal = open_journal()
    journal.finish(done("a"))
    (path,) = (tmp_path / "journal").iterdir()
    strange = [
        b"\xff\x00",
        b"{}",
        b'{"status": 1, "id": "a"}',
        b'{"status": "done", "id": "a", "files": {"a": 3}}',
        b'{"started": "a", "time": "now", "run": "a"}',
        b"[" * 100_000,
        b'{"started": "cut short',
    ]
    path.write_bytes(path.read_bytes() + b"\n".join(strange) + b"\n")
    journal.finish(done("b"))
    history = History(tmp_path)
    assert [len(history.results(name)) for name in "ab"] == [1, 1] and not history.killed("a")


def test_a_newer_journal_is_refused(tmp_path):
    (tmp_path / "journal").mkdir()
    line = {"run": "a", "settings": {}, "format": 2, "time": 0}
    (tmp_path / "journal" / "1.jsonl").write_text(json.dumps(line) + "\n")
    with pytest.raises(FormatError, match=r"(?=.*1\.jsonl)(?=.*format 2)"):
        History(tmp_path)


def test_after_a_full_disk_the_next_line_is_whole(open_journal, tmp_path, monkeypatch):
    journal = open_journal()
    write, calls = os.write, []

    def full(file, data):
        calls.append(data)
        if len(calls) == 1:
            return write(file, data[:7])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(OSError, match="No space"):
            journal.finish(done("a"))
        with pytest.raises(OSError, match="No space"):
            open_journal("b", shard=2)
    journal.finish(done("b"))
    history = History(tmp_path)
    assert not history.results("a") and history.results("b")
