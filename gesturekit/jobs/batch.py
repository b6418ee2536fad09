"""Work on many tasks, in this process or several; a broken input does not stop the others."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from audio_features.atomic import remove_unfinished
from gesturekit.errors import ConfigError, GestureKitError, OutputError
from gesturekit.jobs.records import (
    claimed,
    read_record,
    shard_of,
    state_folder,
    write_items,
    write_record,
)
from gesturekit.jobs.result import Processor, Result, Task, digest_of, file_facts, path_digest
from gesturekit.workers import ATTEMPTS, Failure, in_processes

EXISTING = ("refuse", "skip", "replace")
"""Treatments of existing files that were made with other settings or another input."""
_SHOWN = 3
_SUSPICIOUS = 2  # times that a run was killed while it processed an item


@dataclass(frozen=True)
class Execution:
    """Settings of how the work is done; none of them changes a byte of the results.

    Attributes:
        workers: number of processes; 1 works in this process.
        shard: number of the shard to do, counted from 1, and the number of all shards. An item
            belongs to the same shard whatever other items there are.
        retry_failed: retry items that are skipped because they failed three times.
        deadline: seconds after which an item is abandoned; such items count as failed.
    """

    workers: int = 1
    shard: tuple[int, int] = (1, 1)
    retry_failed: bool = False
    deadline: float | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.workers <= 1024:
            raise ConfigError(f"workers is {self.workers}: give at least 1")
        number, count = self.shard
        if not 1 <= number <= count <= 99_999:
            raise ConfigError(f"shard {number}/{count}: expected a number of 1 to N and N")
        if self.deadline is not None and not self.deadline > 0:
            raise ConfigError(f"deadline is {self.deadline}: give a positive number of seconds")


class Batch:
    """The work of one process: the tasks of its shard, and what is to be done about each.

    Args:
        processor: the work on one task, with all settings.
        tasks: the tasks of all shards.
        execution: how the work is done.

    Attributes:
        tasks: the tasks of the shard, in the order of the inputs.

    Raises:
        ConfigError: a target lies outside the output folder; a file exists that was made with other
            settings, and `existing` is "refuse"; an unknown `existing`.
        FormatError: a record was written by a newer version.
    """

    def __init__(self, processor: Processor, tasks: Iterable[Task], execution: Execution) -> None:
        if processor.existing not in EXISTING:
            raise ConfigError(f"existing is {processor.existing!r}; expected {', '.join(EXISTING)}")
        self.processor, self.execution, self.out = processor, execution, processor.out
        self.state = state_folder(self.out)
        everything = list(tasks)
        self._names = [task.id for task in everything if task.error is None]
        number, count = execution.shard
        # What cannot be made, such as a folder that cannot be opened, fails in the first shard.
        self.tasks = [
            task
            for task in everything
            if (shard_of(task.id, count) if task.error is None else 1) == number
        ]
        self._in_progress: dict[str, Result] = {}
        self._refuse()

    def run(self) -> Iterator[Result]:
        """Do the work, and yield the result of each task as soon as it is done.

        Raises:
            OutputError: the output folder cannot be written to any more.
            ConfigError: another run works in the folder.
        """
        _make_folder(self.out)
        number, count = self.execution.shard
        run = digest_of([self.processor.settings, self.processor.written, count])
        with claimed(self.state, f"shard {number} of {count}", run):
            with self._writing():
                write_items(self.state, self._names, count, dict(self.processor.about))
            yield from self._results()

    def known(self, task: Task) -> Result:
        """Return the result of a task before any work; its status is "left" if there is some."""
        if task.error is not None:
            return Result(task, "failed", error=task.error)
        result = read_record(self.state, task)
        result.status = "left"
        targets = self.processor.targets(task)
        there = [file for file in targets if os.path.lexists(file) and not file.is_dir()]
        if self.processor.existing == "skip":
            result.kept = tuple(there)
        if there or result.failures:
            try:
                self._compare(result, there)
            except (GestureKitError, OSError):
                return result  # it fails when its turn comes, and nothing is written
        if len(result.kept) == len(targets):
            result.status = "kept"
        elif result.refused:
            result.status, result.error = "failed", _existing([*result.refused], "")
        elif result.status == "failed":
            result.error = (
                f"{result.error} (put aside after {result.failures} failures; --retry-failed tries "
                "again)"
            )
        return result

    def _compare(self, result: Result, there: Sequence[Path]) -> None:
        """Compare the existing files of a task, and its failures, with the present settings."""
        processor, path = self.processor, result.task.path
        is_same = path is not None and result.stamp and file_facts(path) == result.stamp
        about = processor.input_of(result.task, result.input.get("input") if is_same else None)
        is_aside = result.failures >= ATTEMPTS and result.key == processor.key(about)
        if is_aside and not self.execution.retry_failed:
            result.status = "failed"
        if processor.existing == "skip":
            return
        for file in there:
            kind, name = file.suffix[1:], file.relative_to(self.out).as_posix()
            made, made_with = result.made.get(name, {}), processor.made_with(kind, about)
            was: Any = made.get("made_with")
            if was == made_with:
                if _is_unchanged(file, made):
                    result.kept += (file,)
                    continue
            elif kind in result.begun and result.begun[kind].items() <= made_with.items():
                continue  # an interrupted run was writing it with the same settings
            if processor.existing == "refuse":
                names = {**was, **made_with} if isinstance(was, dict) else {}
                result.refused[file] = [n for n in names if was.get(n) != made_with.get(n)]

    def _refuse(self) -> None:
        """Refuse targets outside of the output folder, and existing files of other settings.

        Raises:
            ConfigError: there is such a target.
        """
        inside, folders = Path(os.path.realpath(self.out)), set[Path]()
        count = n_kept = 0
        refused: dict[Path, list[str]] = {}
        for task in self.tasks:
            targets = self.processor.targets(task)
            count += len(targets)
            for folder in {target.parent for target in targets} - folders:
                if not Path(os.path.realpath(folder)).is_relative_to(inside):
                    raise ConfigError(f"{targets[0]} lies outside {self.out}: {folder} is a link")
                folders.add(folder)
            result = self.known(task)
            n_kept += len(result.kept)
            refused |= result.refused
        if refused:
            names = sorted({name for names in refused.values() for name in names})
            others = (f"{'other' if n.endswith('s') else 'another'} {n}" for n in names)
            reason = f", made with {', '.join(others)}" if names else ""
            refuse_existing(
                [*refused],
                f"{reason} ({len(refused)} refused, {n_kept} kept, "
                f"{count - len(refused) - n_kept} to make: nothing was done)",
            )

    def _results(self) -> Iterator[Result]:
        workers, deadline = self.execution.workers, self.execution.deadline
        waiting: list[Result] = []
        alone: list[Result] = []
        for task in self.tasks:
            result = self.known(task)
            if result.status != "left":
                yield result
            elif result.killed >= _SUSPICIOUS:
                alone.append(result)  # its process may die, and the others come first
            elif workers == 1 and deadline is None:
                yield from self._work(result)
            else:
                waiting.append(result)
        for results, count in ((waiting, workers), (alone, 1)):
            if results:
                yield from self._in_processes(results, count)

    def _work(self, result: Result) -> Iterator[Result]:
        """Work in this process."""
        try:
            self._begin(result)
            yield self._finish(self.processor(result))
        finally:
            self._drop()

    def _in_processes(self, results: Sequence[Result], workers: int) -> Iterator[Result]:
        deadline = self.execution.deadline
        pool = in_processes(self.processor, results, workers, deadline=deadline, begin=self._begin)
        try:
            for result, filled in pool:
                if isinstance(filled, Failure):
                    filled = self._lost(result, filled)
                yield self._finish(filled)
        finally:
            pool.close()  # before what it was writing is removed
            self._drop()

    def _begin(self, result: Result) -> None:
        """Record that a task is in progress, and remove what a killed run left of it."""
        if result.begun:
            self._remove_temporary(result.task)
        processor = self.processor
        result.status, result.error, result.killed = "begun", None, result.killed + 1
        result.sound = result.seconds = 0.0
        result.begun = {kind: processor.made_with(kind, {}) for kind in processor.written}
        with self._writing():
            write_record(self.state, result)
        self._in_progress[result.id] = result

    def _finish(self, result: Result) -> Result:
        """Record a result.

        Raises:
            OutputError: the output folder is full.
        """
        with self._writing():
            write_record(self.state, result)
        del self._in_progress[result.id]
        if result.is_full:
            raise OutputError(f"{result.error}; {_STOPPED}")
        return result

    def _lost(self, result: Result, failure: Failure) -> Result:
        """Fill the result of a task whose process was ended."""
        self._remove_temporary(result.task)
        result.error, result.input = f"{result.source}: {failure}", {}
        with suppress(GestureKitError, OSError):
            result.input = self.processor.input_of(result.task)
        self.processor.end(result, "lost")
        return result

    def _drop(self) -> None:
        """Record that the tasks in progress were stopped, and remove their partial results."""
        for result in self._in_progress.values():
            self._remove_temporary(result.task)
            self.processor.end(result, "dropped")
            with suppress(OSError):
                write_record(self.state, result)
        self._in_progress.clear()

    def _remove_temporary(self, task: Task) -> None:
        for file in self.processor.targets(task):
            remove_unfinished(file)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Raise an OSError of writing state as an `OutputError`."""
        try:
            yield
        except OSError as error:
            raise OutputError(f"{self.out}: {error.strerror}; {_STOPPED}") from None


_STOPPED = "stopped: finished results are kept, and the same command continues"


def _is_unchanged(file: Path, made: dict[str, Any]) -> bool:
    facts = file_facts(file)
    if facts is not None and all(facts[name] == made.get(name) for name in facts):
        return True
    return made.get("sha256") == path_digest(file)


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        writable = os.access(out, os.W_OK | os.X_OK)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be created ({error.strerror})") from None
    if not writable:
        raise ConfigError(f"{out}: cannot be written to; give another folder")


def _existing(there: Sequence[Path], reason: str) -> str:
    more = f" and {len(there) - _SHOWN} more" if len(there) > _SHOWN else ""
    verb, object_ = ("exists", "it") if len(there) == 1 else ("exist", "them")
    return (
        f"{', '.join(map(str, there[:_SHOWN]))}{more} {verb} already{reason}; --existing replace "
        f"overwrites {object_}, --existing skip leaves {object_}"
    )


def refuse_existing(there: Sequence[Path], reason: str = "") -> NoReturn:
    """Refuse to overwrite existing files.

    Args:
        there: the files, at least one.
        reason: additional text, such as ", made with another seed".

    Raises:
        ConfigError: always; it names the options that allow it.
    """
    raise ConfigError(_existing(there, reason))
