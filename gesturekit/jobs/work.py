"""Work on one task: what a command has to define, so that its tasks can be done as a batch."""

from __future__ import annotations

import hashlib
import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from gesturekit.errors import AudioFeaturesError, GestureKitError, is_full
from gesturekit.jobs.journal import Entry
from gesturekit.jobs.plan import PlanItem
from gesturekit.jobs.record import file_facts, path_digest

# torch raises RuntimeError when memory runs out.
_FAILURES = (GestureKitError, AudioFeaturesError, OSError, MemoryError, RuntimeError)


class Task(Protocol):
    """One input of a batch.

    Attributes:
        source: name of the input in messages.
        name: path of the results below the output folder, without suffix; unique in a batch.
        path: the input file, or None.
        duration: seconds of sound or motion, by which shards are balanced; None if unknown.
        error: reason why nothing can be made of it, or None.
    """

    source: str
    name: str
    path: Path | None
    duration: float | None
    error: str | None

    def to_plan(self) -> PlanItem:
        """Return the task as an item of a plan."""


@dataclass(frozen=True)
class Inputs:
    """Inputs of a batch.

    Attributes:
        request: the request, as JSON values; shards with equal requests share a plan.
        find: looks for the inputs, and returns the tasks in their order.
        from_plan: returns the task of an item of a plan.
    """

    request: Any
    find: Callable[[], list[Task]]
    from_plan: Callable[[PlanItem], Task]


@dataclass(frozen=True)
class Outcome:
    """The result of one input.

    Attributes:
        source: the input.
        files: files that were written.
        kept: existing files that were left unchanged.
        error: reason why some or all files are missing.
        sound: seconds of sound, or of motion without sound.
        facts: what is to be reported of the results; the keys are the command's own.
    """

    source: str
    files: tuple[Path, ...] = ()
    kept: tuple[Path, ...] = ()
    error: str | None = None
    sound: float = 0.0
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Work:
    """A task that is to be done, and the existing files of it that are kept."""

    task: Task
    kept: tuple[Path, ...] = ()
    attempt: int = 1


@dataclass(frozen=True)
class Done:
    """The result of a task, for the caller and for the journal.

    Attributes:
        outcome: for the caller.
        entry: for the journal.
        is_full: True if nothing more can be written to the output folder.
    """

    outcome: Outcome
    entry: Entry
    is_full: bool = False


@dataclass
class Made:
    """Results of a task so far; they stay when the rest fails.

    Attributes:
        at: what is being read or written, for the messages of the operating system's errors.
        files: files that are complete.
        sound: seconds of sound, or of motion without sound.
        facts: see `Outcome`.
    """

    at: str
    files: list[Path] = field(default_factory=list)
    sound: float = 0.0
    facts: dict[str, Any] = field(default_factory=dict)


class Processor(ABC):
    """The work of a command on one task, with all its settings; it can be pickled.

    Attributes:
        out: output folder.
        existing: one of `gesturekit.jobs.targets.EXISTING`.
        settings: what all results depend on, as JSON values.
        written: settings of the files of each format (suffix), as JSON values.
    """

    out: Path
    existing: str
    settings: dict[str, Any]
    written: dict[str, dict[str, Any]]

    @property
    def about(self) -> dict[str, Any]:
        """Further facts about a run, for its journal."""
        return {}

    @property
    def run(self) -> str:
        """Name of the settings, for journals."""
        return digest_of([self.settings, self.written])[:16]

    @abstractmethod
    def targets(self, task: Task) -> tuple[Path, ...]:
        """Return all output files of a task; none if the task has an error."""

    @abstractmethod
    def make(self, work: Work, made: Made) -> None:
        """Make the files of a task, except those that are kept, and note them in `made`."""

    def input_of(self, task: Task, digest: str | None = None) -> dict[str, Any]:
        """Return what the results of a task depend on beside `settings`, as JSON values.

        Args:
            task: the task.
            digest: SHA-256 of its input file, if it is known already.

        Raises:
            GestureKitError: the input cannot be read.
        """
        return {} if task.path is None else {"input": digest or path_digest(task.path)}

    def key(self, found: Mapping[str, Any]) -> str:
        """Return the key of an item: the SHA-256 of all settings and of `input_of` it."""
        return digest_of([self.settings, self.written, found])

    def __call__(self, work: Work) -> Done:
        """Do the work on a task; whatever fails becomes the reason in its outcome."""
        task, begun = work.task, time.perf_counter()
        made = Made(task.source)
        found: dict[str, Any] = {}
        source = (file_facts(task.path) if task.path is not None else None) or {}
        reason, full = None, False
        try:
            found = self.input_of(task)
            self.make(work, made)
        except Exception as error:  # one strange file must not end a night's work
            reason = _reason(error, task.source, made.at)
            full = is_full(error)
        entry = Entry(
            "done" if reason is None else "dropped" if full else "failed",
            task.name,
            key=self.key(found),
            attempt=work.attempt,
            seconds=round(time.perf_counter() - begun, 4),
            sound=round(made.sound, 4),
            files={
                file.relative_to(self.out).as_posix(): {
                    "sha256": path_digest(file),
                    **(file_facts(file) or {}),
                }
                for file in made.files
            },
            input=found,
            source=source,
            error=reason,
        )
        files = tuple(made.files)
        outcome = Outcome(task.source, files, work.kept, reason, made.sound, made.facts)
        return Done(outcome, entry, full)


def digest_of(values: Any) -> str:
    """Return the SHA-256 of JSON values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _reason(error: Exception, source: str, at: str) -> str:
    """Return the reason of a failure on one line that names the input or the file."""
    if isinstance(error, OSError) and error.strerror and not isinstance(error, GestureKitError):
        reason = f"{at}: {error.strerror}"  # the error may name a temporary file
    else:
        reason = str(error) or "not enough memory"
        if not isinstance(error, _FAILURES):
            reason = f"unexpected {type(error).__name__}, please report it: {error}"
        # Not every reason names the input, such as a model that gives NaN.
        reason = reason if source in reason else f"{source}: {reason}"
    # One line, and printable: a file name need not be text.
    return " ".join(reason.encode("utf-8", "replace").decode().splitlines())
