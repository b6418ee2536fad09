"""Work on many tasks, in this process or several; a broken input does not stop the others."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from audio_features.atomic import remove_unfinished
from audio_features.errors import check_values
from gesturekit.errors import ConfigError, GestureKitError, OutputError
from gesturekit.jobs.records import (
    ANY_FILE,
    claimed,
    read_record,
    shard_of,
    state_folder,
    write_items,
    write_record,
)
from gesturekit.jobs.result import Processor, Result, Task, digest_of, file_facts, path_digest
from gesturekit.wording import listed
from gesturekit.workers import Failure, in_processes

EXISTING = ("refuse", "skip", "replace")
"""Treatments of existing files that were made with other settings or another input."""
_STOPPED = "stopped: finished results are kept, and the same command continues"
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
        number, count = self.shard
        has_time = self.deadline is None or self.deadline > 0
        values = (
            ("workers", self.workers, 1 <= self.workers <= 1024, "at least 1"),
            ("shard", f"{number}/{count}", 1 <= number <= count <= 99_999, "1/N to N/N"),
            ("deadline", self.deadline, has_time, "a positive number of seconds"),
        )
        check_values(ConfigError, "", values)


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
        self._names: list[str] = []
        self.tasks: list[Task] = []
        number, count = execution.shard
        for task in tasks:
            self._names += [task.id] if task.error is None else []
            # What cannot be made, such as a folder that cannot be opened, is in the first shard.
            if number == (shard_of(task.id, count) if task.error is None else 1):
                self.tasks.append(task)
        self._in_progress: dict[str, Result] = {}
        self._refuse()

    def run(self) -> Iterator[Result]:
        """Do the work, and yield the result of each task as soon as it is done.

        Raises:
            OutputError: the output folder cannot be written to any more.
            ConfigError: it could never be, or another run works in it.
        """
        if self.out.exists() and not os.access(self.out, os.W_OK | os.X_OK):
            raise ConfigError(f"{self.out}: cannot be written to; give another folder")
        processor, (number, count) = self.processor, self.execution.shard
        run = digest_of([processor.settings, processor.written, count])
        with claimed(self.state, f"shard-{number}-of-{count}", run):
            try:
                write_items(self.state, self._names, count, processor.about)
                yield from self._results()
            except OutputError:
                raise
            except OSError as error:
                raise OutputError(f"{self.out}: {error.strerror}; {_STOPPED}") from None

    def known(self, task: Task) -> Result:
        """Return the result of a task before any work; its status is "left" if there is some."""
        if task.error is not None:
            return Result(task, "failed", error=task.error)
        result = read_record(self.state, task)
        result.status = "left"
        targets = self.processor.targets(task)
        there = [file for file in targets if os.path.lexists(file) and not file.is_dir()]
        is_aside = False
        if self.processor.existing == "skip":
            result.kept, there = tuple(there), []
        if there or result.failures:
            try:
                is_aside = self._compare(result, there)
            except (GestureKitError, OSError):
                return result  # it fails when its turn comes, and nothing is written
        if len(result.kept) == len(targets):
            result.status = "kept"
        elif result.refused:
            result.status, result.error = "failed", f"{min(result.refused)}: exists already"
        elif is_aside:
            aside = f"put aside after {result.failures} failures; --retry-failed tries again"
            result.status, result.error = "failed", f"{result.error} ({aside})"
        return result

    def _compare(self, result: Result, there: Sequence[Path]) -> bool:
        """Find which existing files of a task are kept or refused.

        Returns:
            True if the task is put aside, as it failed too often with the present settings.
        """
        processor, path = self.processor, result.task.path
        is_same = path is not None and result.stamp and file_facts(path) == result.stamp
        about = processor.input_of(result.task, result.input.get("input") if is_same else None)
        for file in there:
            kind, name = file.suffix[1:], file.relative_to(self.out).as_posix()
            made, made_with = result.made.get(name, {}), processor.made_with(kind, about)
            was: Any = made.get("made_with")
            begun = result.begun.get(kind, result.begun.get(ANY_FILE))
            if was == made_with and _is_unchanged(file, made):
                result.kept += (file,)
            elif was != made_with and begun is not None and begun.items() <= made_with.items():
                continue  # an interrupted run was writing it with the same settings
            elif processor.existing == "refuse":
                names = {**was, **made_with} if isinstance(was, dict) else {}
                result.refused[file] = [n for n in names if was.get(n) != made_with.get(n)]
        is_aside = result.is_aside and result.key == processor.key(about)
        return is_aside and not self.execution.retry_failed

    def _refuse(self) -> None:
        """Refuse targets outside of the output folder, and existing files of other settings.

        Raises:
            ConfigError: there is such a target.
        """
        inside, n_targets, n_kept = Path(os.path.realpath(self.out)), 0, 0
        refused: dict[Path, list[str]] = {}
        for task in self.tasks:
            targets = self.processor.targets(task)
            for folder in {target.parent for target in targets}:
                if not Path(os.path.realpath(folder)).is_relative_to(inside):
                    raise ConfigError(f"{targets[0]} lies outside {self.out}: {folder} is a link")
            result = self.known(task)
            n_targets, n_kept = n_targets + len(targets), n_kept + len(result.kept)
            refused |= result.refused
        if refused:
            names = sorted({name for names in refused.values() for name in names})
            others = (f"{'other' if n.endswith('s') else 'another'} {n}" for n in names)
            reason = f", made with {', '.join(others)}" if names else ""
            refuse_existing(
                [*refused],
                f"{reason} ({len(refused)} refused, {n_kept} kept, "
                f"{n_targets - len(refused) - n_kept} to make: nothing was done)",
            )

    def _results(self) -> Iterator[Result]:
        left: list[Result] = []
        alone: list[Result] = []
        for task in self.tasks:
            result = self.known(task)
            if result.status != "left":
                yield result
            elif result.killed >= _SUSPICIOUS:
                alone.append(result)  # its process may die, and the others come first
            else:
                left.append(result)
        workers, deadline = self.execution.workers, self.execution.deadline
        is_here = workers == 1 and deadline is None
        for results, processes in ((left, 0 if is_here else workers), (alone, 1)):
            if results:
                yield from self._work(results, processes)

    def _work(self, results: Sequence[Result], processes: int) -> Iterator[Result]:
        """Work in so many processes, or with 0 in this one."""
        if processes:
            deadline, begin = self.execution.deadline, self._begin
            outcomes = in_processes(
                self.processor, results, processes, deadline=deadline, begin=begin
            )
        else:
            outcomes = ((result, self.processor(self._begin(result))) for result in results)
        try:
            for result, outcome in outcomes:
                if isinstance(outcome, Failure):
                    outcome = self._lost(result, outcome)
                write_record(self.state, outcome)
                del self._in_progress[outcome.id]
                if outcome.is_full:
                    raise OutputError(f"{outcome.error}; {_STOPPED}")
                yield outcome
        finally:
            outcomes.close()  # before what is being written is removed
            for result in self._in_progress.values():
                self._remove_temporary(result.task)
                self.processor.end(result, "dropped")
                with suppress(OSError):
                    write_record(self.state, result)

    def _begin(self, result: Result) -> Result:
        """Record that a task is in progress, and remove what a killed run left of it."""
        if result.begun:
            self._remove_temporary(result.task)
        processor = self.processor
        result.status, result.error, result.killed = "begun", None, result.killed + 1
        result.sound = result.seconds = 0.0
        result.begun = {kind: processor.made_with(kind, {}) for kind in processor.written}
        write_record(self.state, result)
        self._in_progress[result.id] = result
        return result

    def _lost(self, result: Result, failure: Failure) -> Result:
        """Fill the result of a task whose process was ended."""
        self._remove_temporary(result.task)
        result.error, result.input = f"{result.source}: {failure}", {}
        with suppress(GestureKitError, OSError):
            result.input = self.processor.input_of(result.task)
        self.processor.end(result, "lost")
        return result

    def _remove_temporary(self, task: Task) -> None:
        for file in self.processor.targets(task):
            remove_unfinished(file)


def _is_unchanged(file: Path, made: dict[str, Any]) -> bool:
    facts = file_facts(file)
    if facts is not None and all(facts[name] == made.get(name) for name in facts):
        return True
    return made.get("sha256") == path_digest(file)


def refuse_existing(there: Sequence[Path], reason: str = "") -> NoReturn:
    """Refuse to overwrite existing files.

    Args:
        there: the files, at least one.
        reason: additional text, such as ", made with another seed".

    Raises:
        ConfigError: always; it names the options that allow it.
    """
    verb, them = ("exists", "it") if len(there) == 1 else ("exist", "them")
    how = f"--existing replace overwrites {them}, --existing skip leaves {them}"
    raise ConfigError(f"{listed([*map(str, there)], 3)} {verb} already{reason}; {how}")
