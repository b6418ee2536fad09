"""Work on tasks that only write who did them: what is kept, refused, tried again, and where."""

import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from gesturekit.errors import ConfigError
from gesturekit.jobs.batch import Batch, Execution
from gesturekit.jobs.records import read_record, shard_of, write_record
from gesturekit.jobs.result import Processor, Result, Task


@dataclass
class Notes(Processor):
    """Writes NAME.txt with the process that wrote it; a task may fail, or sleep first."""

    out: Path
    existing: str = "refuse"
    settings: dict[str, Any] = field(default_factory=dict)
    written: dict[str, dict[str, Any]] = field(default_factory=lambda: {"txt": {}})

    def make(self, result: Result) -> None:
        if "wrong" in result.task.more:
            raise ValueError(result.task.more["wrong"])
        time.sleep(result.task.more.get("sleep", 0.0))
        for file in self.missing(result, result.task.id):
            file.write_text(str(os.getpid()))


def batch(out: Path, tasks: list[Task], existing: str = "refuse", settings=None, **execution):
    return Batch(Notes(out, existing, settings or {}), tasks, Execution(**execution))


def done(*arguments, **options) -> dict[str, str]:
    return {result.id: result.status for result in batch(*arguments, **options).run()}


TASKS = [Task(name) for name in "abc"]


def test_one_worker_works_in_this_process_and_others_in_theirs(tmp_path):
    """A deadline needs a process that can be ended, even for one worker."""
    done(tmp_path / "one", TASKS)
    done(tmp_path / "two", TASKS, workers=2)
    slow = [Task("a", more={"sleep": 5.0})]
    (late,) = batch(tmp_path / "late", slow, deadline=0.5).run()
    assert late.status == "lost" and "after 0.5 s" in late.error
    wrote = {file: file.read_text() for file in tmp_path.glob("*/*.txt")}
    assert len(wrote) == 6
    assert all((pid == str(os.getpid())) == (f.parent.name == "one") for f, pid in wrote.items())


def test_a_rerun_keeps_what_was_made_with_the_same_settings(tmp_path):
    assert done(tmp_path, TASKS, settings={"seed": 1}) == dict.fromkeys("abc", "done")
    (tmp_path / "b.txt").unlink()
    again = {"a": "kept", "b": "done", "c": "kept"}
    assert done(tmp_path, TASKS, settings={"seed": 1}) == again
    (tmp_path / "c.txt").unlink()
    with pytest.raises(ConfigError, match=rf"(?=.*{tmp_path})(?=.*seed)(?=.*--existing)"):
        batch(tmp_path, TASKS, settings={"seed": 2})
    skipped = {"a": "kept", "b": "kept", "c": "done"}
    assert done(tmp_path, TASKS, "skip", {"seed": 2}) == skipped
    replaced = {"a": "done", "b": "done", "c": "kept"}
    assert done(tmp_path, TASKS, "replace", {"seed": 2}) == replaced
    with pytest.raises(ConfigError, match=r"(?=.*existing)(?=.*\bkeep\b)"):
        batch(tmp_path, TASKS, "keep")


def test_shards_share_the_tasks_and_those_that_cannot_be_made_are_in_the_first(tmp_path):
    tasks = [*map(Task, "abcde"), Task("", error="no such folder")]
    made = [done(tmp_path, tasks, shard=(number, 2)) for number in (1, 2)]
    assert made[0].pop("") == "failed"
    for number, names in enumerate(made, start=1):
        assert [*names] == [name for name in "abcde" if shard_of(name, 2) == number]
        assert set(names.values()) == {"done"}


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"workers": 0}, "workers & 0"),
        ({"workers": 1025}, "workers & 1025"),
        ({"shard": (0, 2)}, "shard & 0 & 2"),
        ({"shard": (3, 2)}, "shard & 3 & 2"),
        ({"shard": (1, 100_000)}, "shard & 100000"),
        ({"deadline": 0.0}, "deadline & 0"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, says):
    with pytest.raises(ConfigError) as caught:
        Execution(**settings)
    assert all(fact in str(caught.value) for fact in says.split(" & "))


def test_an_output_folder_that_cannot_be_is_one_clear_error(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigError, match="file/out"):
        done(tmp_path / "file" / "out", TASKS)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "sub").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="(?=.*sub/a.txt)(?=.*/sub)(?=.*link)"):
        batch(tmp_path / "out", [Task("sub/a")])


def test_a_damaged_record_is_that_of_an_interrupted_run(tmp_path):
    done(tmp_path, TASKS)
    for path in (tmp_path / ".gesturekit").glob("records/*/*"):
        path.write_text("")
    assert done(tmp_path, TASKS, settings={"seed": 1}) == dict.fromkeys("abc", "done")


@pytest.mark.parametrize(
    ("begun", "existing", "outcome"),
    [
        ({"seed": 1}, "refuse", "done"),  # by an interrupted run with the same settings
        ({"seed": 2}, "refuse", None),
        ({"seed": 2}, "skip", "kept"),
        ({"seed": 2}, "replace", "done"),
    ],
)
def test_a_file_of_an_interrupted_run_is_known_by_its_settings(tmp_path, begun, existing, outcome):
    (tmp_path / "a.txt").write_text("half")
    left = Result(Task("a"), "begun", begun={"txt": begun})
    write_record(tmp_path / ".gesturekit", left)
    if outcome is None:
        with pytest.raises(ConfigError, match=r"a\.txt"):
            done(tmp_path, [Task("a")], existing, {"seed": 1})
    else:
        assert done(tmp_path, [Task("a")], existing, {"seed": 1}) == {"a": outcome}
    is_made = (tmp_path / "a.txt").read_text() != "half"
    assert is_made == (outcome == "done")


def interrupt(seconds: float) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("workers", [1, 2])
def test_partial_files_of_a_stopped_run_are_removed(tmp_path, monkeypatch, workers):
    """Stopped in the middle: what was being written goes, and the next run makes it."""
    going = batch(tmp_path, [Task("a"), Task("b", more={"sleep": 30.0})], workers=workers).run()
    assert next(going).id == "a"
    (tmp_path / ".b-12345678.txt").write_text("half")
    if workers == 1:
        monkeypatch.setattr(time, "sleep", interrupt)
        with pytest.raises(KeyboardInterrupt):
            next(going)
        monkeypatch.undo()
    else:
        going.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".gesturekit", "a.txt"]
    assert read_record(tmp_path / ".gesturekit", Task("b")).status == "dropped"
    assert done(tmp_path, [Task("a"), Task("b")]) == {"a": "kept", "b": "done"}


def test_an_item_that_killed_its_run_twice_is_last_and_alone(tmp_path):
    write_record(tmp_path / ".gesturekit", Result(Task("a"), "begun", killed=2))
    found = list(batch(tmp_path, TASKS).run())
    assert [(result.id, result.status) for result in found] == [(name, "done") for name in "bca"]
    wrote = [(tmp_path / f"{name}.txt").read_text() == str(os.getpid()) for name in "bca"]
    assert wrote == [True, True, False]
    assert read_record(tmp_path / ".gesturekit", Task("a")).killed == 0
