"""Work on many tasks: plan, leases, journal, processes; a broken input does not stop the others."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from audio_features.atomic import remove_unfinished
from gesturekit.errors import ConfigError, GestureKitError, OutputError
from gesturekit.jobs.journal import ATTEMPTS, Entry, History, Journal, journal_files
from gesturekit.jobs.lease import Lease, live_leases, locked
from gesturekit.jobs.plan import PLAN, Plan, PlanItem, balanced, write_plan
from gesturekit.jobs.pool import Failure, Pool
from gesturekit.jobs.record import Record
from gesturekit.jobs.state import state_folder
from gesturekit.jobs.targets import EXISTING, refuse_existing, refuse_leaving
from gesturekit.jobs.work import Done, Inputs, Outcome, Processor, Task, Work, digest_of

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
        inputs: the inputs.
        execution: how the work is done.

    Attributes:
        tasks: the tasks of the shard, in the order of the inputs.
        kept: existing files that are kept.

    Raises:
        ConfigError: the inputs cannot be used; two would write the same file; a file exists that
            was made with other settings, and `existing` is "refuse"; an unknown `existing`.
        FormatError: plan or journals cannot be read.
    """

    def __init__(self, processor: Processor, inputs: Inputs, execution: Execution) -> None:
        if processor.existing not in EXISTING:
            raise ConfigError(f"existing is {processor.existing!r}; expected {', '.join(EXISTING)}")
        self.processor, self.execution, self.out = processor, execution, processor.out
        self.state = state_folder(self.out)
        self._inputs = inputs
        self._request = digest_of([inputs.request, execution.shard[1]])
        plan = self._shared_plan()
        self._found: list[Task] | None = None
        if plan is None:
            self._found = inputs.find()
            self.tasks = self._of_shard(self._found)
        else:
            self.tasks = self._planned(plan)
        self._settle()

    def run(self) -> Iterator[Outcome]:
        """Do the work, and yield the outcome of each task as soon as it is done.

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
            settings, run = processor.settings, processor.run
            with _journaling(self.out):
                journal = Journal(
                    self.state, shard, shards, run=run, settings=settings, about=about
                )
            try:
                yield from self._outcomes(_Shard(self, journal, lease))
            finally:
                with suppress(OSError):
                    journal.close()
        finally:
            lease.release()

    def _attempts(self, task: Task) -> tuple[int, str | None]:
        """Return how often a task failed with its present input, and the last reason."""
        if not any(entry.status != "done" for entry in self.history.entries(task.name)):
            return 0, None
        try:
            key = self.processor.key(self._input_of(task))
        except (GestureKitError, OSError):
            return 0, None
        failures = self.history.failures(task.name, key)
        return len(failures), failures[-1].error if failures else None

    def _planned(self, plan: Plan) -> list[Task]:
        return [self._inputs.from_plan(item) for item in plan.items(self.execution.shard[0])]

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
        targets = {task.name: self.processor.targets(task) for task in self.tasks}
        refuse_leaving([file for files in targets.values() for file in files], self.out)
        self._seen = _journal_sizes(self.state)
        self.history = History(self.state, targets)
        self._record = Record(self.out, self.history)
        self.kept: set[Path] = set()
        refused: list[Path] = []
        another: set[str] = set()
        for task in self.tasks:
            refused += self._settle_task(task, targets[task.name], another)
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
            state = self._record.state(task.name, file, made_with)
            if state == "same":
                self.kept.add(file)
            elif state == "other" and existing == "refuse":
                refused.append(file)
                another.update(self._record.differences(task.name, file, made_with))
        return refused

    def _input_of(self, task: Task) -> dict[str, Any]:
        digest = self._record.input_digest(task.name, task.path) if task.path else None
        return self.processor.input_of(task, digest)

    def _begin(self) -> Lease:
        """Write the plan unless there is one, and take the lease of the shard."""
        number, count = self.execution.shard
        plan = self._shared_plan()
        planned = None
        if plan is not None:
            # Made by the run of another shard, perhaps since this one looked for the inputs.
            planned = self._planned(plan)
        elif self._found is None:
            raise ConfigError(f"{self.state / PLAN} was replaced meanwhile; start this shard again")
        else:
            items: dict[str, PlanItem] = {}
            for task in self._found:
                if task.error is None:
                    items[task.name] = task.to_plan()
            leases = live_leases(self.state)
            new = self.state / (f"{PLAN}.new" if leases else PLAN)
            with _journaling(self.out):
                plan = write_plan(new, list(items.values()), count, self._request)
            if leases:
                new.unlink()  # only its hash is wanted, to compare it with that of the live run
        run = {"plan": plan.sha256, "shards": count, "settings": self.processor.run}
        lease = Lease(self.state, number, count, run)
        is_new = planned is not None and planned != self.tasks
        if is_new or _journal_sizes(self.state) != self._seen:
            try:
                self.tasks = planned if is_new else self.tasks
                self._settle()
            except BaseException:
                lease.release()
                raise
        return lease

    def _outcomes(self, shard: _Shard) -> Iterator[Outcome]:
        workers, deadline = self.execution.workers, self.execution.deadline
        is_inside = workers == 1 and deadline is None
        waiting: list[Work] = []
        alone: list[Work] = []
        for task in self.tasks:
            work = self.work_on(task)
            if isinstance(work, Outcome):
                yield work
            elif len(self.history.killed(task.name)) >= _SUSPICIOUS:
                alone.append(work)  # its process may die, and the others come first
            elif is_inside:
                shard.begin(work)
                yield shard.finish(work, shard.call_inside(work))
            else:
                waiting.append(work)
        for works, count in ((waiting, workers), (alone, 1)):
            if works:
                yield from shard.map(Pool(self.processor, count, deadline), works)

    def work_on(self, task: Task) -> Outcome | Work:
        """Return what is to be done about a task, or its outcome if that is nothing."""
        targets = self.processor.targets(task)
        kept = tuple(file for file in targets if file in self.kept)
        if task.error is not None or len(kept) == len(targets):
            return Outcome(task.source, kept=kept, error=task.error)
        count, reason = self._attempts(task)
        if count >= ATTEMPTS and not self.execution.retry_failed:
            error = f"{reason} (put aside after {count} failures; --retry-failed tries again)"
            return Outcome(task.source, kept=kept, error=error)
        return Work(task, kept, count + 1)


class _Shard:
    """The shard being processed: its journal, its lease, and the tasks in progress."""

    def __init__(self, batch: Batch, journal: Journal, lease: Lease) -> None:
        self._batch, self._journal, self._lease = batch, journal, lease
        self._out, self._in_progress = batch.out, dict[str, Work]()

    def begin(self, work: Work) -> None:
        """Record that a task is in progress, and remove what a killed run left of it."""
        self._lease.check()
        name = work.task.name
        if self._batch.history.unfinished(name):
            self._remove_temporary(work)
        with _journaling(self._out):
            self._journal.start(name)
        self._in_progress[name] = work

    def call_inside(self, work: Work) -> Done:
        """Work in this process."""
        try:
            return self._batch.processor(work)
        except BaseException:
            self._drop()
            raise

    def map(self, pool: Pool, works: Sequence[Work]) -> Iterator[Outcome]:
        """Work in the processes of a pool, and yield outcomes as they come."""
        try:
            for work, result in pool.map(works, self.begin):
                yield self.finish(work, result)
        except BaseException:
            pool.close()  # before what it was writing is removed
            self._drop()
            raise

    def finish(self, work: Work, result: Done | Failure) -> Outcome:
        """Record the result of a task.

        Raises:
            OutputError: the output folder is full.
        """
        self._lease.check()
        done = self._lost(work, result) if isinstance(result, Failure) else result
        with _journaling(self._out):
            self._journal.finish(done.entry)
        del self._in_progress[work.task.name]
        if done.is_full:
            raise OutputError(
                f"{done.outcome.error}; stopped: finished results are kept, and the same "
                "command continues"
            )
        return done.outcome

    def _lost(self, work: Work, failure: Failure) -> Done:
        """Return the result of a task whose process was ended."""
        self._remove_temporary(work)
        task, processor = work.task, self._batch.processor
        error = f"{task.source}: {failure}"
        found: dict[str, Any] = {}
        with suppress(GestureKitError, OSError):
            found = processor.input_of(task)
        key = processor.key(found)
        entry = Entry("lost", task.name, key, processor.run, work.attempt, input=found, error=error)
        return Done(Outcome(task.source, kept=work.kept, error=error), entry)

    def _drop(self) -> None:
        """Record that the user stopped the tasks in progress, and remove their partial results."""
        for work in self._in_progress.values():
            self._remove_temporary(work)
            with suppress(OSError):
                self._journal.finish(Entry("dropped", work.task.name))
        self._in_progress.clear()

    def _remove_temporary(self, work: Work) -> None:
        for file in self._batch.processor.targets(work.task):
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
