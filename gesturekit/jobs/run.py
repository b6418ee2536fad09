"""Work on many tasks: plan, leases, journal, processes; a broken input does not stop the others."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from audio_features.atomic import remove_unfinished
from gesturekit.errors import ConfigError, GestureKitError, OutputError
from gesturekit.jobs.journal import ATTEMPTS, History, Journal, journal_files
from gesturekit.jobs.lease import Lease, live_leases, locked
from gesturekit.jobs.plan import PLAN, Plan, balanced, write_plan
from gesturekit.jobs.result import Processor, Result, digest_of
from gesturekit.jobs.state import state_folder
from gesturekit.jobs.task import Task
from gesturekit.jobs.workers import Failure, Pool

EXISTING = ("refuse", "skip", "replace")
"""Treatments of existing files that were made with other settings or another input."""
_SHOWN = 3
_SUSPICIOUS = 2  # times that a run was killed while it processed an item


@dataclass(frozen=True)
class Execution:
    """Settings of how the work is done; none of them changes a byte of the results.

    Attributes:
        workers: number of processes; 1 works in this process.
        shard: number of the shard to do, counted from 1, and the number of all shards, which
            have about the same total duration. Runs of different shards share a plan:
            the first one writes it, and the others use it even if files were added since.
        replan: list the inputs again, instead of using the plan of another shard's run.
        retry_failed: retry items that are skipped because they failed three times.
        deadline: seconds after which an item is abandoned; such items count as failed.
    """

    workers: int = 1
    shard: tuple[int, int] = (1, 1)
    replan: bool = False
    retry_failed: bool = False
    deadline: float | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.workers <= 1024:
            raise ConfigError(f"workers is {self.workers}: give at least 1")
        if not 1 <= self.shard[0] <= self.shard[1]:
            raise ConfigError(f"shard {self.shard[0]} of {self.shard[1]}: they count from 1")
        if self.deadline is not None and not self.deadline > 0:
            raise ConfigError(f"deadline is {self.deadline}: give a positive number of seconds")


class Batch:
    """The work of one process: the tasks of its shard, and what is to be done about each.

    Args:
        processor: the work on one task, with all settings.
        find: looks for the inputs, and returns the tasks in their order.
        request: the request, as JSON values; shards with equal requests share a plan.
        execution: how the work is done.

    Attributes:
        tasks: the tasks of the shard, in the order of the inputs.
        kept: existing files that are kept.

    Raises:
        ConfigError: the inputs cannot be used; two would write the same file; a file exists that
            was made with other settings, and `existing` is "refuse"; an unknown `existing`.
        FormatError: plan or journals cannot be read.
    """

    def __init__(
        self,
        processor: Processor,
        find: Callable[[], list[Task]],
        request: Any,
        execution: Execution,
    ) -> None:
        if processor.existing not in EXISTING:
            raise ConfigError(f"existing is {processor.existing!r}; expected {', '.join(EXISTING)}")
        self.processor, self.execution, self.out = processor, execution, processor.out
        self.state = state_folder(self.out)
        self._request = digest_of([request, execution.shard[1]])
        plan = self._shared_plan()
        self._found: list[Task] | None = None
        if plan is None:
            self._found = find()
            self.tasks = self._of_shard(self._found)
        else:
            self.tasks = list(plan.tasks(execution.shard[0]))
        self._settle()

    def run(self) -> Iterator[Result]:
        """Do the work, and yield the result of each task as soon as it is done.

        Raises:
            OutputError: the output folder cannot be written to any more.
            ConfigError: another run works in the folder, or took this shard over.
        """
        _make_folder(self.out)
        shard, shards = self.execution.shard
        try:
            with locked(self.state):
                lease = self._begin()
        except OSError as error:
            raise ConfigError(f"{self.state}: {error.strerror or error}") from None
        try:
            processor = self.processor
            about = {**processor.about, "written": processor.written}
            about |= {"shard": shard, "shards": shards}
            with _journaling(self.out):
                journal = Journal(
                    self.state,
                    shard,
                    shards,
                    run=processor.run,
                    settings=processor.settings,
                    about=about,
                    after=self.history.latest,
                )
            try:
                yield from self._results(_Shard(self, journal, lease))
            finally:
                with suppress(OSError):
                    journal.close()
        finally:
            lease.release()

    def _attempts(self, task: Task) -> tuple[int, str | None]:
        """Return how often a task failed with its present input, and the last reason."""
        if not any(result.status != "done" for result in self.history.results(task.id)):
            return 0, None
        try:
            key = self.processor.key(self._input_of(task))
        except (GestureKitError, OSError):
            return 0, None
        failures = self.history.failures(task.id, key)
        return len(failures), failures[-1].error if failures else None

    def _shared_plan(self) -> Plan | None:
        """Return the plan that a run of another shard made of the same request."""
        if self.execution.shard[1] == 1 or self.execution.replan:
            return None
        plan = Plan.open(self.state / PLAN)
        return plan if plan is not None and plan.request == self._request else None

    def _of_shard(self, tasks: list[Task]) -> list[Task]:
        number, count = self.execution.shard
        planned = [task for task in tasks if task.error is None]
        shards = iter(balanced([task.duration or 0.0 for task in planned], count))
        # What cannot be planned, such as a folder that cannot be opened, fails in the first shard.
        return [t for t in tasks if (next(shards) if t.error is None else 1) == number]

    def _settle(self) -> None:
        """Read the journals, and decide which existing files are kept.

        Raises:
            ConfigError: `existing` is "refuse", and a file was made with other settings; or a
                target lies outside the output folder.
        """
        targets = {task.id: self.processor.targets(task) for task in self.tasks}
        refuse_leaving([file for files in targets.values() for file in files], self.out)
        self._seen = _journal_sizes(self.state)
        self.history = History(self.state, targets)
        self.kept: set[Path] = set()
        refused: list[Path] = []
        another: set[str] = set()
        for task in self.tasks:
            refused += self._settle_task(task, targets[task.id], another)
        if refused:
            count = sum(map(len, targets.values()))
            named = (
                f"{'other' if name.endswith('s') else 'another'} {name}" for name in sorted(another)
            )
            reason = f", made with {', '.join(named)}" if another else ""
            reason += (
                f" ({len(refused)} refused, {len(self.kept)} kept, "
                f"{count - len(refused) - len(self.kept)} to make: nothing was done)"
            )
            refuse_existing(refused, reason)

    def _settle_task(self, task: Task, targets: Sequence[Path], another: set[str]) -> list[Path]:
        """Add to `kept` the files of a task that are kept, and return those that are refused."""
        there = [file for file in targets if os.path.lexists(file) and not file.is_dir()]
        existing = self.processor.existing
        if existing == "skip":
            self.kept.update(there)
            return []
        try:
            base = self.processor.settings | self._input_of(task) if there else {}
        except (GestureKitError, OSError):
            return []  # the item fails when its turn comes, and nothing is written
        refused = []
        for file in there:
            made_with = base | self.processor.written[file.suffix[1:]]
            state = self.history.compare(task.id, file, made_with)
            if state == "same":
                self.kept.add(file)
            elif state == "other" and existing == "refuse":
                refused.append(file)
                another.update(self.history.differences(task.id, file, made_with))
        return refused

    def _input_of(self, task: Task) -> dict[str, Any]:
        digest = self.history.input_digest(task.id, task.path) if task.path else None
        return self.processor.input_of(task, digest)

    def _begin(self) -> Lease:
        """Write the plan unless there is one, and take the lease of the shard."""
        number, count = self.execution.shard
        plan = self._shared_plan()
        planned = None
        if plan is not None:
            # Made by the run of another shard, perhaps since this one looked for the inputs.
            planned = list(plan.tasks(number))
        elif self._found is None:
            raise ConfigError(f"{self.state / PLAN} was replaced meanwhile; start this shard again")
        else:
            tasks = [task for task in self._found if task.error is None]
            leases = live_leases(self.state)
            new = self.state / (f"{PLAN}.new" if leases else PLAN)
            with _journaling(self.out):
                plan = write_plan(new, tasks, count, self._request)
            if leases:
                new.unlink()  # only its hash is wanted, to compare it with that of the live run
        run = {"plan": plan.sha256, "shards": count, "settings": self.processor.run}
        lease = Lease(self.state, number, count, run)
        changed = None if planned == self.tasks else planned
        if changed is not None or _journal_sizes(self.state) != self._seen:
            try:
                self.tasks = self.tasks if changed is None else changed
                self._settle()
            except BaseException:
                lease.release()
                raise
        return lease

    def _results(self, shard: _Shard) -> Iterator[Result]:
        workers, deadline = self.execution.workers, self.execution.deadline
        is_inside = workers == 1 and deadline is None
        waiting: list[Result] = []
        alone: list[Result] = []
        for task in self.tasks:
            result = self.known(task)
            if result.status != "left":
                yield result
            elif len(self.history.killed(task.id)) >= _SUSPICIOUS:
                alone.append(result)  # its process may die, and the others come first
            elif is_inside:
                yield shard.work(result)
            else:
                waiting.append(result)
        for results, count in ((waiting, workers), (alone, 1)):
            if results:
                yield from shard.map(Pool(self.processor, count, deadline), results)

    def known(self, task: Task) -> Result:
        """Return the result of a task before any work; its status is "left" if there is some."""
        targets = self.processor.targets(task)
        kept = tuple(file for file in targets if file in self.kept)
        if task.error is not None:
            return Result(task, "failed", kept=kept, error=task.error)
        if len(kept) == len(targets):
            return Result(task, "kept", kept=kept)
        count, reason = self._attempts(task)
        if count >= ATTEMPTS and not self.execution.retry_failed:
            error = f"{reason} (put aside after {count} failures; --retry-failed tries again)"
            return Result(task, "failed", kept=kept, error=error)
        return Result(task, kept=kept, attempt=count + 1)


class _Shard:
    """The shard being processed: its journal, its lease, and the tasks in progress."""

    def __init__(self, batch: Batch, journal: Journal, lease: Lease) -> None:
        self._processor, self._history, self._out = batch.processor, batch.history, batch.out
        self._journal, self._lease = journal, lease
        self._in_progress: dict[str, Result] = {}

    def work(self, result: Result) -> Result:
        """Work in this process."""
        self.begin(result)
        try:
            filled = self._processor(result)
        except BaseException:
            self._drop()
            raise
        return self._finish(filled)

    def map(self, pool: Pool, results: Sequence[Result]) -> Iterator[Result]:
        """Work in the processes of a pool, and yield results as they come."""
        try:
            for result, filled in pool.map(results, self.begin):
                lost = isinstance(filled, Failure)
                yield self._finish(self._lost(result, filled) if lost else filled)
        except BaseException:
            pool.close()  # before what it was writing is removed
            self._drop()
            raise

    def begin(self, result: Result) -> None:
        """Record that a task is in progress, and remove what a killed run left of it."""
        self._lease.check()
        if self._history.unfinished(result.id):
            self._remove_temporary(result.task)
        with _journaling(self._out):
            self._journal.start(result.id)
        self._in_progress[result.id] = result

    def _finish(self, result: Result) -> Result:
        """Record a result.

        Raises:
            OutputError: the output folder is full.
        """
        self._lease.check()
        with _journaling(self._out):
            self._journal.finish(result)
        del self._in_progress[result.id]
        if result.is_full:
            raise OutputError(
                f"{result.error}; stopped: finished results are kept, and the same command "
                "continues"
            )
        return result

    def _lost(self, result: Result, failure: Failure) -> Result:
        """Return the result of a task whose process was ended."""
        self._remove_temporary(result.task)
        result.status, result.error = "lost", f"{result.source}: {failure}"
        with suppress(GestureKitError, OSError):
            result.input = self._processor.input_of(result.task)
        result.key = self._processor.key(result.input)
        return result

    def _drop(self) -> None:
        """Record that the user stopped the tasks in progress, and remove their partial results."""
        for result in self._in_progress.values():
            self._remove_temporary(result.task)
            with suppress(OSError):
                self._journal.finish(Result(result.task, "dropped"))

    def _remove_temporary(self, task: Task) -> None:
        for file in self._processor.targets(task):
            remove_unfinished(file)


@contextmanager
def _journaling(out: Path) -> Iterator[None]:
    """Raise an OSError of writing plan or journal as an `OutputError`."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{out}: {error.strerror}; stopped: finished results are kept, and the same command "
            "continues"
        ) from None


def _journal_sizes(state: Path) -> dict[str, int]:
    return {path.name: path.stat().st_size for path in journal_files(state)}


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        writable = os.access(out, os.W_OK | os.X_OK)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be created ({error.strerror})") from None
    if not writable:
        raise ConfigError(f"{out}: cannot be written to; give another folder")


def refuse_leaving(targets: Iterable[Path], out: Path) -> None:
    """Refuse targets that leave a folder through a link inside it.

    Raises:
        ConfigError: a target whose folder is a link to outside `out`.
    """
    inside = Path(os.path.realpath(out))
    for target in targets:
        if not Path(os.path.realpath(target.parent)).is_relative_to(inside):
            raise ConfigError(f"{target} lies outside {out}: {target.parent} is a link")


def refuse_existing(there: Sequence[Path], reason: str = "") -> NoReturn:
    """Refuse to overwrite existing files.

    Args:
        there: the files, at least one.
        reason: additional text, such as ", made with another seed".

    Raises:
        ConfigError: always; it names the options that allow it.
    """
    more = f" and {len(there) - _SHOWN} more" if len(there) > _SHOWN else ""
    verb, object_ = ("exists", "it") if len(there) == 1 else ("exist", "them")
    raise ConfigError(
        f"{', '.join(map(str, there[:_SHOWN]))}{more} {verb} already{reason}; --existing replace "
        f"overwrites {object_}, --existing skip leaves {object_}"
    )
