"""Tasks of a batch, the work of a verb on one task, and its result."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
import os
import stat
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from gesturekit.errors import AudioFeaturesError, GestureKitError, is_full
from gesturekit.workers import ATTEMPTS

# torch raises RuntimeError when memory runs out.
_FAILURES = (GestureKitError, AudioFeaturesError, OSError, MemoryError, RuntimeError)


@dataclass(frozen=True, slots=True)
class Task:
    """One input of a batch.

    Attributes:
        id: path of the results below the output folder, without suffix; unique in a batch.
        path: the input file, or the folder of a sequence; None for a task without input.
        more: what else the verb needs of this input, as JSON values.
        source: name of the input in messages; by default the path as it was given.
        error: reason why nothing can be made of it, or None.
    """

    id: str
    path: Path | None = None
    more: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""
    error: str | None = None

    def __post_init__(self) -> None:
        if not self.source:
            object.__setattr__(self, "source", str(self.path or self.id))

    @property
    def file(self) -> Path:
        """The `path` of a task that has one."""
        assert self.path is not None, self.id
        return self.path


@dataclass(slots=True)
class Result:
    """Outcome of the latest attempt at a task, and what is known of its files.

    Attributes:
        task: the task.
        status: "left" before the work; "begun" during it, or if a killed process did not end it;
            "kept" if all files existed; "done"; "failed"; "lost" if its process was ended;
            "dropped" if the user or a full disk stopped it.
        files: files that were written.
        kept: existing files that were left unchanged.
        refused: existing files that must not be overwritten, with the settings that differ.
        facts: what is to be reported of the files; the keys are the verb's own.
        at: what is being read or written, for the messages of the operating system's errors.
        is_full: True if nothing more can be written to the output folder.
        error: reason why some or all files are missing, or None.
        sound: seconds of sound, or of motion without sound.
        seconds: time that it took.
        time: time of its end, seconds since 1970.
        key: SHA-256 of settings and input of the latest failure or success.
        failures: failures with this key since the task was done.
        killed: times that a process was killed in the middle of it, since its latest result.
        input: what the result depends on beside the settings of the verb.
        stamp: size and time of change of the input file.
        made: {name below the output folder: size, mtime_ns, sha256 and `made_with`} of each file.
        begun: {suffix: settings} of an attempt that may have left files which `made` lacks.
    """

    task: Task
    status: str = "left"
    files: tuple[Path, ...] = ()
    kept: tuple[Path, ...] = ()
    refused: dict[Path, list[str]] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    at: str = ""
    is_full: bool = False
    error: str | None = None
    sound: float = 0.0
    seconds: float = 0.0
    time: float = 0.0
    key: str = ""
    failures: int = 0
    killed: int = 0
    input: dict[str, Any] = field(default_factory=dict)
    stamp: dict[str, Any] = field(default_factory=dict)
    made: dict[str, dict[str, Any]] = field(default_factory=dict)
    begun: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """The id of the task."""
        return self.task.id

    @property
    def source(self) -> str:
        """Name of the input in messages."""
        return self.task.source

    @property
    def is_aside(self) -> bool:
        """True if it failed too often to be tried again with the same settings and input."""
        return self.failures >= ATTEMPTS


class Processor(ABC):
    """The work of a verb on one task, with all its settings; it can be pickled.

    Attributes:
        out: output folder.
        samples: motions that are made of each task.
        existing: one of `gesturekit.jobs.batch.EXISTING`.
        settings: what all results depend on, as JSON values.
        written: settings of the files of each format (suffix), as JSON values.
        about: further facts about a run, to be stored beside its results.
    """

    out: Path
    samples = 1
    existing: str
    settings: dict[str, Any]
    written: dict[str, dict[str, Any]]
    about: Mapping[str, Any] = {}

    @abstractmethod
    def make(self, result: Result) -> None:
        """Make the files of a task, except those that are kept, and note them in its result."""

    def trial(self, out: Path) -> Self:
        """Return the same work on one sample of a task, into another folder."""
        other = copy.copy(self)
        other.out, other.samples = out, 1
        return other

    def stems(self, task: Task) -> list[str]:
        """Return the paths of a task's files below the output folder, without suffix."""
        return [task.id]

    def targets(self, task: Task) -> tuple[Path, ...]:
        """Return all output files of a task; none if the task has an error."""
        names = [] if task.error is not None else self.stems(task)
        return tuple(self.out / f"{name}.{kind}" for name in names for kind in self.written)

    def missing(self, result: Result, name: str) -> Iterator[Path]:
        """Yield the files of one of `stems` to write; each is noted in the result when written."""
        for kind in self.written:
            file = self.out / f"{name}.{kind}"
            if file not in result.kept:
                result.at = str(file)
                yield file
                result.files += (file,)

    def input_of(self, task: Task, digest: str | None = None) -> dict[str, Any]:
        """Return what the results of a task depend on beside `settings`, as JSON values.

        Args:
            task: the task.
            digest: SHA-256 of its input file, if it is known already.

        Raises:
            GestureKitError: the input cannot be read.
        """
        return {} if task.path is None else {"input": digest or path_digest(task.path)}

    def key(self, about_input: Mapping[str, Any]) -> str:
        """Return the key of a result: the SHA-256 of all settings and of `input_of` its task."""
        return digest_of([self.settings, self.written, about_input])

    def made_with(self, kind: str, about_input: Mapping[str, Any]) -> dict[str, Any]:
        """Return all that a file of a format depends on."""
        return {**self.settings, **about_input, **self.written[kind]}

    def __call__(self, result: Result) -> Result:
        """Do the work on a task, and fill its result; whatever fails becomes its error."""
        task, begun, status = result.task, time.perf_counter(), "done"
        result.at, result.input = task.source, {}
        result.stamp = (file_facts(task.path) if task.path is not None else None) or {}
        try:
            result.input = self.input_of(task)
            self.make(result)
        except Exception as error:  # one strange file must not end a night's work
            result.error = _reason(error, task.source, result.at)
            result.is_full = is_full(error)
            status = "dropped" if result.is_full else "failed"
        result.seconds = round(time.perf_counter() - begun, 4)
        for file in result.files:
            result.made[file.relative_to(self.out).as_posix()] = {
                "sha256": path_digest(file),
                "made_with": self.made_with(file.suffix[1:], result.input),
                **(file_facts(file) or {}),
            }
        if status != "dropped":
            result.begun = {}
        self.end(result, status)
        return result

    def end(self, result: Result, status: str) -> None:
        """Note how an attempt ended."""
        result.status, result.killed = status, 0
        result.sound, result.time = round(result.sound, 4), time.time()
        if status != "dropped":
            before = result.failures if result.key == self.key(result.input) else 0
            result.key = self.key(result.input)
            result.failures = 0 if status == "done" else before + 1


def file_facts(file: Path) -> dict[str, int] | None:
    """Return size and time of change of a file; None if there is none, and for a folder.

    A file with the same is taken to be unchanged, as `make` and `rsync` do.
    """
    try:
        status = file.stat()
    except OSError:
        return None
    if stat.S_ISDIR(status.st_mode):  # changes of the files in it do not show
        return None
    return {"size": status.st_size, "mtime_ns": status.st_mtime_ns}


def json_of(value: Any) -> Any:
    """Return a setting as JSON: plain values unchanged, files and arrays by their SHA-256.

    Equal descriptions mean equal results. The converse need not hold: a file and its copy, given as
    strings, have different descriptions.
    """
    if value is None or isinstance(value, bool | int | float):
        return value
    if isinstance(value, str):
        is_file = os.path.isfile(value)  # noqa: PTH113 (no error for a long text)
        return f"{value} sha256:{path_digest(value)}" if is_file else value
    if isinstance(value, os.PathLike):
        return f"sha256:{path_digest(value)}"
    if isinstance(value, np.ndarray):
        about = f"{value.dtype} {value.shape} ".encode()
        return f"sha256:{hashlib.sha256(about + value.tobytes()).hexdigest()}"
    if isinstance(value, Mapping):
        return {str(key): json_of(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_of(item) for item in value]
    if dataclasses.is_dataclass(value):
        fields = {f.name: json_of(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return f"sha256:{hashlib.sha256(json.dumps(fields).encode()).hexdigest()}"
    return str(value)


def path_digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file, or of all files in a folder; "" if it cannot be read."""
    path = Path(path)
    try:
        if path.is_dir():
            parts = [f"{part.name} {path_digest(part)}" for part in sorted(path.iterdir())]
            return hashlib.sha256("\n".join(parts).encode("utf-8", "surrogateescape")).hexdigest()
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


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
