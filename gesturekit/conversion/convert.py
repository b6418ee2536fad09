"""Conversion of motion files between formats; a broken file does not stop the others."""

from __future__ import annotations

import dataclasses
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gesturekit.conversion.changes import Changes
from gesturekit.conversion.inputs import is_file_name, plan, without_existing
from gesturekit.conversion.options import (
    FormatOptions,
    describe,
    warn_of_losses,
    with_body_model,
    without_mesh,
)
from gesturekit.errors import ConfigError
from gesturekit.formats.conversion import applicable_write_options, load, refuse_unused_options
from gesturekit.formats.plausibility import plausibility_warnings
from gesturekit.jobs.batch import Batch, Execution
from gesturekit.jobs.plan import PlanItem
from gesturekit.jobs.record import described
from gesturekit.jobs.work import Inputs, Made, Outcome, Processor, Work
from gesturekit.motion.motion import Motion

_GLANCE = 1 << 18  # bytes in which the hierarchy of a BVH file ends
_LENGTH = re.compile(rb"Frames:\s*(\d{1,9})\s+Frame\s+Time:\s*([\d.]{1,20})", re.IGNORECASE)


@dataclass(frozen=True)
class Converted:
    """Outcome of one conversion.

    Attributes:
        source: the file, or the folder of a sequence.
        files: files written; empty if all of them exist and are kept.
        found: summary of the motion read: unit, axes, rate, frames, joints.
        done: changes made, one phrase each.
        warnings: data that a format cannot hold, and problems that other programs will have.
        error: reason why some or all files are missing.
    """

    source: Path
    files: tuple[Path, ...] = ()
    found: str = ""
    done: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    error: str | None = None


@dataclass(frozen=True)
class MotionTask:
    """One motion to convert.

    Attributes:
        source: the file, or the folder of a sequence, as it was named.
        name: path of the results below the output folder, without suffix.
        path: the same as `source`.
        duration: seconds, of BVH files by their header; None if unknown.
        error: reason why it cannot be converted, or None.
    """

    source: str
    name: str
    path: Path
    duration: float | None = None
    error: str | None = None

    def to_plan(self) -> PlanItem:
        """Return the task as an item of a plan."""
        path = os.path.abspath(self.path)  # noqa: PTH100
        return PlanItem(self.name, path, self.duration, {"source": self.source})

    @classmethod
    def from_plan(cls, planned: PlanItem) -> MotionTask:
        """Return the task of an item of a plan.

        Raises:
            ConfigError: the item has no path.
        """
        if planned.path is None:
            raise ConfigError(
                f"plan: item {planned.id!r} is damaged; delete the plan for a new one"
            )
        source = str(planned.more.get("source", planned.path))
        return cls(source, planned.id, Path(planned.path), planned.duration)


@dataclass
class Converter(Processor):
    """Conversion of one motion, with all settings.

    Args:
        out: output folder.
        formats: suffixes of the files to write, without the dot.
        changes: changes to make.
        options: options of readers and writers, see `with_body_model`.
        existing: "refuse", "skip" or "replace" files that were made with other settings.
        dry_run: read and change, but write nothing.
    """

    out: Path
    formats: Sequence[str]
    changes: Changes
    options: FormatOptions
    existing: str = "refuse"
    dry_run: bool = False
    settings: dict[str, Any] = field(init=False)
    written: dict[str, dict[str, Any]] = field(init=False)

    def __post_init__(self) -> None:
        changes = {f.name: getattr(self.changes, f.name) for f in dataclasses.fields(Changes)}
        read = {f"in-{name}": value for name, value in self.options.read.items()}
        self.settings = described({**changes, **read, "parts": dict(self.options.parts)})
        self.written = {
            kind: described(applicable_write_options(Path(f"x.{kind}"), self.options.write))
            for kind in self.formats
        }

    def targets(self, task: MotionTask) -> tuple[Path, ...]:
        """Return all output files of a task."""
        if task.error is not None:
            return ()
        return tuple(self.out / f"{task.name}.{kind}" for kind in self.formats)

    def make(self, work: Work, made: Made) -> None:
        """Read, change and write a motion."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            try:
                self._convert(work, made)
            finally:
                lines = dict.fromkeys(str(warning.message) for warning in caught)
                made.facts["warnings"] = tuple(lines)

    def _convert(self, work: Work, made: Made) -> None:
        task = work.task
        motion = load(Path(task.path), self.options.read, self.options.parts)
        for reason in plausibility_warnings(motion, self.options.read):
            warnings.warn(f"{task.source}: {reason}", stacklevel=2)
        made.facts["found"] = describe(motion)
        motion, done = self.changes(motion)
        made.facts["done"] = tuple(done)
        made.sound = motion.duration
        for target in self.targets(task):
            if target not in work.kept:
                made.at = str(target)
                self._write(motion, target)
                made.files.append(target)

    def _write(self, motion: Motion, target: Path) -> None:
        """Write one file, warning of data that its format cannot hold."""
        options = applicable_write_options(target, self.options.write)
        if self.changes.rig is not None:
            options |= self.changes.rig.options.get(target.suffix.lower(), {})
        warn_of_losses(motion, target)
        if not self.dry_run:
            motion.save(target, **options)


@dataclass
class Conversion:
    """Conversion of motions to a file or into a folder.

    Into a folder, the work is a batch: what was made with the same settings and input is kept.

    Args:
        sources: motion files, and folders to search for motions.
        out: a file for a single motion, otherwise a folder; see `conversion.inputs.plan`.
        formats: formats to write into a folder: bvh, npz, html, mp4, png, svg, pdf, obj.
        changes: changes to make to each motion.
        options: options of readers and writers.
        existing: "refuse", "skip" or "replace" files that were made with other settings.
        dry_run: read and change, but write nothing.
        execution: how the work is done.

    Attributes:
        count: number of motions.

    Raises:
        ConfigError: the conversion cannot start; see `conversion.inputs.plan`.

    Warns:
        UserWarning: meshes that cannot be written without a body model, beside other formats.
    """

    sources: Sequence[str | os.PathLike[str]] | str | os.PathLike[str]
    out: str | os.PathLike[str]
    formats: Sequence[str] = ()
    changes: Changes = field(default_factory=Changes)
    options: FormatOptions = field(default_factory=FormatOptions)
    existing: str = "refuse"
    dry_run: bool = False
    execution: Execution = field(default_factory=Execution)
    count: int = field(init=False)

    def __post_init__(self) -> None:
        is_one = isinstance(self.sources, str | os.PathLike)
        self._sources = [Path(self.sources)] if is_one else [Path(one) for one in self.sources]
        self._out = Path(self.out)
        if self.options.body_model is None:
            self.formats = without_mesh(self.formats, self._out)
        self._task: MotionTask | None = None
        if is_file_name(self._out, self._sources, self.formats):
            if self.execution.shard[1] > 1:
                raise ConfigError(
                    f"{self.out} is a file, which cannot be split into shards; give a folder"
                )
            (self._task,) = self._find()
            self._converter = self._converter_into(self._out.parent, [self._out.suffix[1:]])
            self._targets = without_existing([self._out], self.existing)
            self.count = 1
            return
        self._converter = self._converter_into(self._out, self.formats)
        named = [os.path.abspath(source) for source in self._sources]  # noqa: PTH100
        inputs = Inputs(["convert", named, list(self.formats)], self._find, MotionTask.from_plan)
        self._batch = Batch(self._converter, inputs, self.execution)
        self.count = len(self._batch.tasks)

    def _converter_into(self, out: Path, formats: Sequence[str]) -> Converter:
        options = with_body_model(self.options)
        return Converter(out, formats, self.changes, options, self.existing, self.dry_run)

    def run(self) -> Iterator[Converted]:
        """Convert, and yield the outcome of each motion as soon as it is done.

        Raises:
            OutputError: the output folder cannot be written to any more.
        """
        shown: set[str] = set()
        for outcome in self._outcomes():
            facts = dict(outcome.facts)
            lines = facts.pop("warnings", ())
            fresh = tuple(line for line in lines if line not in shown)
            shown.update(fresh)
            source = Path(outcome.source)
            yield Converted(source, outcome.files, **facts, warnings=fresh, error=outcome.error)

    def _outcomes(self) -> Iterator[Outcome]:
        if self._task is not None:
            work = Work(self._task) if self._targets else Outcome(self._task.source)
            yield self._tried(work)
        elif self.dry_run:
            yield from (self._tried(self._batch.work_on(task)) for task in self._batch.tasks)
        else:
            yield from self._batch.run()

    def _tried(self, work: Work | Outcome) -> Outcome:
        """Do work without recording it in a journal."""
        return work if isinstance(work, Outcome) else self._converter(work).outcome

    def _find(self) -> list[MotionTask]:
        jobs = plan(self._sources, self._out, self.formats)
        found = [job.source for job in jobs if job.error is None]
        targets = [target for job in jobs for target in job.targets]
        options = self.options
        refuse_unused_options(options.read, options.write, options.body_model, found, targets)
        return [
            MotionTask(str(job.source), job.name, job.source, _length(job.source), job.error)
            for job in jobs
        ]


def convert(
    sources: Sequence[str | os.PathLike[str]] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    **settings: Any,
) -> Iterator[Converted]:
    """Read each motion, change it, and write it in other formats.

    Args:
        sources: motion files, and folders to search for motions.
        out: a file for a single motion, otherwise a folder.
        settings: the other fields of `Conversion`.

    Yields:
        The outcome of each motion, as soon as it is done.

    Raises:
        ConfigError: the conversion cannot start.
        OutputError: the disk became full; what is done is kept.
    """
    yield from Conversion(sources, out, **settings).run()


def _length(source: Path) -> float | None:
    """Return the seconds of a BVH file by its header; None for others, and damaged ones."""
    if source.suffix.lower() != ".bvh" or not source.is_file():
        return None
    try:
        with source.open("rb") as file:
            match = _LENGTH.search(file.read(_GLANCE))
        return int(match[1]) * float(match[2]) if match else None
    except (OSError, ValueError):
        return None
