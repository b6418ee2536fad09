"""Records of items, and claims: what is written survives, one run for each folder."""

import json
import os
import subprocess
import sys

import pytest

from audio_features import atomic
from gesturekit.errors import ConfigError, FormatError
from gesturekit.jobs import records
from gesturekit.jobs.records import (
    claimed,
    read_items,
    read_record,
    running,
    shard_of,
    write_items,
    write_record,
)
from gesturekit.jobs.result import Result, Task


def record_of(state, name):
    """Write the record of an item, and return its file."""
    before = set(state.glob("records/*/*"))
    write_record(state, Result(Task(name), "failed", error="why", key="k", failures=2))
    (path,) = set(state.glob("records/*/*")) - before
    return path


@pytest.mark.parametrize("name", ["a", "day 1/a", "a.json/b", "x" * 250, "odd\udcff\x1b"])
def test_what_is_known_of_an_item_is_read_again(tmp_path, name):
    made = {f"{name}.bvh": {"sha256": "x", "size": 3, "mtime_ns": 5, "made_with": {"seed": 1}}}
    written = Result(Task(name), "done", sound=2.5, key="k", made=made, begun={"bvh": {"seed": 2}})
    write_record(tmp_path, written)
    write_record(tmp_path, Result(Task("other"), "failed", error="why"))
    assert read_record(tmp_path, Task(name)) == written
    assert read_record(tmp_path, Task("none")) == Result(Task("none"))
    assert {result.id for result in records.all_records(tmp_path)} == {name, "other"}


def test_the_beginning_of_an_item_is_on_the_disk_at_once(tmp_path, monkeypatch):
    """Files of an item that a loss of power cut short are known by its start."""
    on_disk = []
    monkeypatch.setattr(atomic.os, "fsync", lambda file: on_disk.append(os.pread(file, 1 << 16, 0)))
    write_record(tmp_path, Result(Task("one"), "begun"))
    assert json.loads(on_disk[-1])["status"] == "begun"
    write_record(tmp_path, Result(Task("one"), "done"))
    assert len(on_disk) == 1, "what is done can be done again"


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[:-2],
        lambda text: text.replace('"failures": 2', '"failures": "many"'),
        lambda text: text.replace('"made": {}', '"made": {"a": 3}'),
        lambda text: text.replace('"begun": {}', '"begun": {"bvh": 3}'),
        lambda text: text.replace('"error": "why"', '"error": 3'),
        lambda text: "[" * 100_000,
        lambda text: "[1]",
        lambda text: "\x00",
    ],
)
def test_a_damaged_record_is_ignored(tmp_path, damage):
    path = record_of(tmp_path, "a")
    path.write_text(damage(path.read_text()))
    assert read_record(tmp_path, Task("a")) == Result(Task("a"), begun={records.ANY_FILE: {}})
    assert list(records.all_records(tmp_path)) == []


def test_what_a_newer_version_wrote_is_refused(tmp_path):
    path = record_of(tmp_path, "a")
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    with pytest.raises(FormatError, match=rf"(?=.*{path.name})(?=.*format 2)"):
        read_record(tmp_path, Task("a"))


def test_the_items_of_the_latest_run_with_the_facts_of_earlier_ones(tmp_path):
    assert read_items(tmp_path) is None
    write_items(tmp_path, ["a", "b"], 2, {"model_folder": "m"})
    write_items(tmp_path, ["c"], 1, {})
    known = read_items(tmp_path)
    assert (known["items"], known["shards"], known["model_folder"]) == (["c"], 1, "m")
    (path,) = tmp_path.glob("*.json")
    for text in ('{"items": "a", "shards": 1}', '{"items": [3], "shards": 1}', '{"items": []}', ""):
        path.write_text(text)
        with pytest.raises(FormatError, match=rf"(?=.*{path.name})(?=.*delete)"):
            read_items(tmp_path)


def test_an_item_is_in_the_same_shard_whatever_others_there_are():
    shards = [shard_of(f"day/{number}", 4) for number in range(1000)]
    assert {shards.count(number) > 200 for number in (1, 2, 3, 4)} == {True}
    assert [shard_of(name, 7) for name in "abc"] == [5, 3, 5]


HOLD = """
import sys, time
from pathlib import Path
from gesturekit.jobs.records import claimed
with claimed(Path(sys.argv[1]), "1 of 2", "p"):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def no_patience(monkeypatch):
    monkeypatch.setattr(records, "_PATIENCE", 0.0)


def test_a_part_is_claimed_once_and_another_part_of_the_run_beside_it(tmp_path, no_patience):
    with claimed(tmp_path, "1 of 2", "p"):
        with (
            pytest.raises(ConfigError, match=rf"(?=.*1 of 2)(?=.*\b{os.getpid()}\b)"),
            claimed(tmp_path, "1 of 2", "p"),
        ):
            pass
        with (
            pytest.raises(ConfigError, match=rf"(?=.*\b{os.getpid()}\b)(?=.*--out)"),
            claimed(tmp_path, "2 of 2", "q"),
        ):
            pass
        with claimed(tmp_path, "2 of 2", "p"):
            assert [about["pid"] for about in running(tmp_path)] == [os.getpid()] * 2
    assert running(tmp_path) == []


def test_the_claim_of_a_killed_process_is_free_at_once(tmp_path, no_patience):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(ConfigError, match=rf"\b{holder.pid}\b"), claimed(tmp_path, "1 of 2", "p"):
        pass
    holder.kill()
    holder.wait()
    with claimed(tmp_path, "1 of 2", "another"):
        assert [about["run"] for about in running(tmp_path)] == ["another"]


def test_a_lock_that_outlives_its_process_for_a_moment_is_waited_for(tmp_path):
    """A worker that was being started when its parent was killed inherits the lock."""
    holder = claimed(tmp_path)
    holder.__enter__()
    waits = iter([None])

    def sleep(seconds: float) -> None:
        if next(waits, "again") is None:
            holder.__exit__(None, None, None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(records.time, "sleep", sleep)
        with claimed(tmp_path):
            assert len(running(tmp_path)) == 1
