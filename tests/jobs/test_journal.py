"""The journal: what is written survives, and damage is ignored."""

from __future__ import annotations

import errno
import json
import os

import pytest

from gesturekit.errors import FormatError
from gesturekit.jobs.journal import History, Journal, last_run
from gesturekit.jobs.result import Result
from gesturekit.jobs.task import Task


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


def test_items_in_progress_when_a_run_was_killed(open_journal, tmp_path):
    journal = open_journal()
    for name in ("x", "y", "z"):
        journal.start(name)
    journal.finish(done("y"))
    assert [bool(History(tmp_path).killed(name)) for name in "xyz"] == [True, False, True]
    journal.finish(done("x"))
    journal.start("z")
    assert History(tmp_path).killed("z") == ["a", "a"]
    journal.finish(Result(Task("z"), "dropped"))
    assert History(tmp_path).killed("z") == [] and History(tmp_path).unfinished("z") == ["a"]


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
        b"[1]",
        b"{}",
        b'{"status": "done"}',
        b'{"status": 1, "id": "a"}',
        b'{"status": "done", "id": "a", "files": 3}',
        b'{"status": "done", "id": "a", "files": {"a": 3}}',
        b'{"started": 3}',
        b'{"started": "a", "time": "now", "run": "a"}',
        b"[" * 100_000,
        b"x" * (3 << 20),
    ]
    path.write_bytes(path.read_bytes() + b"\n".join(strange) + b"\n")
    journal.finish(done("b"))
    history = History(tmp_path)
    assert [len(history.results(name)) for name in "ab"] == [1, 1] and not history.killed("a")


def test_a_newer_journal_is_refused(tmp_path):
    (tmp_path / "journal").mkdir()
    line = {"run": "a", "settings": {}, "format": 2, "time": 0}
    (tmp_path / "journal" / "1.jsonl").write_text(json.dumps(line) + "\n")
    with pytest.raises(FormatError, match="format 2 is newer"):
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
    journal.finish(done("b"))
    history = History(tmp_path)
    assert not history.results("a") and history.results("b")
