"""Conversion of motion files between formats; a broken file does not stop the others."""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gesturekit.conversion.changes import Changes
from gesturekit.conversion.inputs import find_tasks, is_file_name
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
from gesturekit.jobs.batch import EXISTING, Batch, Execution, refuse_existing
from gesturekit.jobs.result import Processor, Result, Task, json_of
from gesturekit.motion.motion import Motion


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
    existing: str
    dry_run: bool
    settings: dict[str, Any] = field(init=False)
    written: dict[str, dict[str, Any]] = field(init=False)

    def __post_init__(self) -> None:
        changes = {f.name: getattr(self.changes, f.name) for f in dataclasses.fields(Changes)}
        read = {f"in-{name}": value for name, value in self.options.read.items()}
        self.settings = json_of({**changes, **read, "parts": dict(self.options.parts)})
        self.written = {
            kind: json_of(applicable_write_options(Path(f"x.{kind}"), self.options.write))
            for kind in self.formats
        }

    def make(self, result: Result) -> None:
        """Read, change and write a motion.

        The facts of the result are `found`, a summary of the motion as it was read: unit, axes,
        rate, frames, joints; `done`, the changes, one phrase each; and `warnings` of data that a
        format cannot hold, and of problems that other programs will have.
        """
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            try:
                self._convert(result)
            finally:
                lines = dict.fromkeys(str(warning.message) for warning in caught)
                result.facts["warnings"] = tuple(lines)

    def _convert(self, result: Result) -> None:
        task = result.task
        motion = load(task.file, self.options.read, self.options.parts)
        for reason in plausibility_warnings(motion, self.options.read):
            warnings.warn(f"{task.source}: {reason}", stacklevel=2)
        result.facts["found"] = describe(motion)
        motion, done = self.changes(motion)
        result.facts["done"] = tuple(done)
        result.sound = motion.duration
        for target in self.missing(result, task.id):
            self._write(motion, target)

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
        out: a file for a single motion, otherwise a folder; see `conversion.inputs.find_tasks`.
        formats: formats to write into a folder: bvh, npz, glb, vrma, fbx, html, mp4,
            png, svg, pdf, obj.
        changes: changes to make to each motion.
        options: options of readers and writers.
        existing: "refuse", "skip" or "replace" files that were made with other settings.
        dry_run: read and change, but write nothing.
        execution: how the work is done.

    Attributes:
        tasks: the motions to convert.

    Raises:
        ConfigError: the conversion cannot start; see `conversion.inputs.find_tasks`.

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
    tasks: list[Task] = field(init=False)

    def __post_init__(self) -> None:
        sources = self.sources
        paths = [sources] if isinstance(sources, str | os.PathLike) else sources
        self._sources = [Path(path) for path in paths]
        self._out = Path(self.out)
        if self.options.body_model is None:
            self.formats = without_mesh(self.formats, self._out)
        self._is_one = is_file_name(self._out, self._sources, self.formats)
        if self._is_one:
            if self.execution.shard[1] > 1:
                raise ConfigError(
                    f"{self.out} is a file, which cannot be split into shards; give a folder"
                )
            self.tasks = self._find()
            self._converter = self._converter_into(self._out.parent, [self._out.suffix[1:]])
            self._kept = _kept(self._out, self.existing)
            return
        self._converter = self._converter_into(self._out, self.formats)
        self._batch = Batch(self._converter, self._find(), self.execution)
        self.tasks = self._batch.tasks

    def _converter_into(self, out: Path, formats: Sequence[str]) -> Converter:
        options = with_body_model(self.options)
        return Converter(out, formats, self.changes, options, self.existing, self.dry_run)

    def run(self) -> Iterator[Result]:
        """Convert, and yield the result of each motion as soon as it is done.

        A warning that several motions cause is among the facts of the first alone.

        Raises:
            OutputError: the output folder cannot be written to any more.
        """
        shown: set[str] = set()
        for result in self._results():
            lines = result.facts.get("warnings", ())
            result.facts["warnings"] = tuple(line for line in lines if line not in shown)
            shown.update(lines)
            yield result

    def _results(self) -> Iterator[Result]:
        if self._is_one:
            status = "kept" if self._kept else "left"
            yield self._tried(Result(self.tasks[0], status, kept=self._kept))
        elif self.dry_run:
            yield from (self._tried(self._batch.known(task)) for task in self.tasks)
        else:
            yield from self._batch.run()

    def _tried(self, result: Result) -> Result:
        """Do the work that is left, without a record."""
        return self._converter(result) if result.status == "left" else result

    def _find(self) -> list[Task]:
        tasks = find_tasks(self._sources, self._out, self.formats)
        paths = [task.file for task in tasks if task.error is None]
        names = [self._out] if self._is_one else [Path(f"x.{kind}") for kind in self.formats]
        options, targets = self.options, names if paths else []
        refuse_unused_options(options.read, options.write, options.body_model, paths, targets)
        return tasks


def convert(
    sources: Sequence[str | os.PathLike[str]] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    **settings: Any,
) -> Iterator[Result]:
    """Read each motion, change it, and write it in other formats.

    Args:
        sources: motion files, and folders to search for motions.
        out: a file for a single motion, otherwise a folder.
        settings: the other fields of `Conversion`.

    Yields:
        The result of each motion, as soon as it is done.

    Raises:
        ConfigError: the conversion cannot start.
        OutputError: the disk became full; what is done is kept.
    """
    yield from Conversion(sources, out, **settings).run()


def _kept(target: Path, existing: str) -> tuple[Path, ...]:
    """Return the single target if it exists and is kept, or nothing.

    Raises:
        ConfigError: it exists, and `existing` is "refuse"; or an unknown `existing`.
    """
    if existing not in EXISTING:
        raise ConfigError(f"existing is {existing!r}; expected {', '.join(EXISTING)}")
    if existing == "replace" or not os.path.lexists(target):
        return ()
    if existing == "refuse":
        refuse_existing([target])
    return (target,)
