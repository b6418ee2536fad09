"""Conversion of motion files between formats, rigs and frame rates, as a batch.

Sources and targets are determined and checked before the first file is read; a broken file does
not stop the others.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gesturekit.errors import ConfigError, MotionError
from gesturekit.formats.conventions import plausibility_warnings
from gesturekit.formats.live_link import read_live_link
from gesturekit.formats.registry import WRITABLE
from gesturekit.formats.smpl import Rig
from gesturekit.formats.sources import (
    NO_MOTION,
    OTHER_MOTION_SUFFIXES,
    applicable_write_options,
    describe_axes,
    is_sequence,
    load,
    motions_in,
    one_of_two_formats,
    refuse_unused_options,
    unreadable_media,
    visible_folders,
)
from gesturekit.jobs.batch import Batch, Execution, refuse_existing
from gesturekit.jobs.result import Processor, Result, Task, json_of, path_digest
from gesturekit.motion.face import is_smplx
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import body_joints
from gesturekit.wording import counted, listed

_SHOWN = 3
_KNOWN = ", ".join(WRITABLE)


def find_tasks(sources: Sequence[Path], out: Path, formats: Sequence[str] = ()) -> list[Task]:
    """Return the tasks of a conversion: each a file, or the folder of a sequence of frames.

    `out` is a file if there is a single motion and `out` has the suffix of a format. Otherwise it
    is a folder for files of all `formats`; motions found in a folder keep their relative paths. If
    a folder has a motion as both STEM.bvh and STEM.npz, only one is read.

    Warns:
        UserWarning: which of these two is read, and why; unsupported motion files in a folder.

    Raises:
        ConfigError: nothing to read, an unknown format, two sources for one target, a target that
            is a source, or a folder without write permission.
    """
    if not sources:
        raise ConfigError("nothing to convert; name a motion file or a folder of them")
    if unknown := [name for name in formats if name not in WRITABLE]:
        raise ConfigError(f"format {', '.join(unknown)}: known: {_KNOWN}")
    if is_file_name(out, sources, formats):
        kind = out.suffix.lower()[1:]
        if formats and list(formats) != [kind]:
            raise ConfigError(f"{out} is a {kind}, not {', '.join(formats)}; give a folder")
        tasks = every = [Task(out.stem, sources[0])]
        targets = [(out, tasks[0])]
    else:
        every = _into_folder(sources, out, formats)
        tasks = _without_copies(every)
        targets = [
            (out / f"{task.id}.{kind}", task)
            for task in tasks
            if task.error is None
            for kind in formats
        ]
    _refuse_clashes(targets, {os.path.realpath(task.file) for task in every})
    # The nearest existing folder must be writable, which hours of reading would show too late.
    folder = next(path for path in (out, *out.absolute().parents) if path.is_dir())
    if targets and not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"{out}: {folder} cannot be written to; give another place")
    return tasks


def is_file_name(out: Path, sources: Sequence[Path], formats: Sequence[str]) -> bool:
    """Return whether `out` is the file for a single motion, and not a folder.

    Raises:
        ConfigError: it can be neither.
    """
    suffix = out.suffix.lower()[1:]
    if out.is_dir():
        return False
    is_single = len(sources) == 1 and (not sources[0].is_dir() or is_sequence(sources[0]))
    if is_single and suffix in WRITABLE:
        return True
    problem = ""
    if suffix in WRITABLE:
        what = "a folder" if len(sources) == 1 else f"{len(sources)} inputs"
        problem = f" is a file name, but {what} cannot become one file; name a folder"
    elif is_single and suffix and not formats:
        problem = f": cannot write motion as .{suffix}; known: {_KNOWN}"
    elif out.exists():
        problem = f" is a file; give a folder to fill, or a name ending in {_KNOWN}"
    if problem:
        raise ConfigError(f"{out}{problem}")
    return False


def _into_folder(sources: Sequence[Path], out: Path, formats: Sequence[str]) -> list[Task]:
    if not formats:
        raise ConfigError(f"{out} is a folder: give what to write into it: --format npz ({_KNOWN})")
    tasks: dict[tuple[str, str], Task] = {}
    for source in sources:
        for path, key in _keyed(source, out):
            if isinstance(path, OSError):
                where = Path(path.filename or source)
                tasks[str(where), ""] = Task("", where, error=f"{where}: {path.strerror}")
                continue
            # A file that is named twice is converted once; a link to it beside it is not it.
            tasks.setdefault((os.path.realpath(path), key), Task(key, path))
    _warn_of_unread(sources, {task.file.with_suffix("") for task in tasks.values()})
    if not tasks:
        raise ConfigError(f"{sources[0]}: {NO_MOTION}")
    return list(tasks.values())


def _warn_of_unread(sources: Sequence[Path], read: set[Path]) -> None:
    """Warn of unsupported motion files, except those beside a file of the same stem in `read`."""
    unread: dict[str, list[str]] = {}
    for folder in filter(Path.is_dir, sources):
        for _, _, files in visible_folders(folder, lambda error: None):  # named already
            for path in files:
                is_other = path.suffix.lower() in OTHER_MOTION_SUFFIXES
                if is_other and path.with_suffix("") not in read:
                    unread.setdefault(unreadable_media(path) or "", []).append(str(path))
    for reason, paths in unread.items():
        warnings.warn(f"{listed(paths, _SHOWN)}: {reason}", stacklevel=2)


def _keyed(source: Path, out: Path) -> Iterator[tuple[Path | OSError, str]]:
    """Yield the motions of a source, each with its path below `out`, without suffix."""
    if not source.is_dir():
        yield source, source.stem
        return
    if is_sequence(source):
        yield source, source.resolve().name
        return
    inside = out if os.path.realpath(out) != os.path.realpath(source) else None
    for path in motions_in(source, but=inside):
        if isinstance(path, OSError):
            yield path, ""
        else:
            within = path.relative_to(source)
            yield path, (within if path.is_dir() else within.with_suffix("")).as_posix()


def _without_copies(tasks: list[Task]) -> list[Task]:
    counts = Counter(task.id for task in tasks)
    # Only those with the same targets: each duplicate can still be converted by its name.
    rivals = [task.file for task in tasks if counts[task.id] > 1]
    copies, lines = one_of_two_formats(rivals)
    for line in lines:
        warnings.warn(line, stacklevel=2)
    return [task for task in tasks if counts[task.id] == 1 or task.path not in copies]


def _refuse_clashes(targets: Sequence[tuple[Path, Task]], sources: set[str]) -> None:
    taken: dict[str, Task] = {}
    for target, task in targets:
        where = os.path.realpath(target)
        if where in sources:
            raise ConfigError(f"{target} is one of the inputs; give another name or folder")
        if where in taken:
            both = f"{taken[where].source} and {task.source} would both be written as {target}"
            raise ConfigError(f"{both}; convert them into different folders")
        taken[where] = task


_WITHOUT_SHAPE = {".bvh": "BVH", ".glb": "glTF", ".vrma": "a VRM animation", ".fbx": "FBX"}
"""Formats without body shape, by suffix."""


@dataclass(frozen=True)
class Changes:
    """Changes to a motion, made in this order; by default none.

    Attributes:
        trim: (start, end) seconds to keep, rounded to frames; the end may be infinite.
        mirror: exchange left and right.
        rig: rig to retarget to.
        joints: "all", "body" (no fingers, face and end joints), or names to keep.
        fps: frames per second of the result.
        antialias: filter out frequencies above half of a lower frame rate.
    """

    trim: tuple[float, float] | None = None
    mirror: bool = False
    rig: Rig | None = None
    joints: str | tuple[str, ...] = "all"
    fps: float | None = None
    antialias: bool = False

    def __call__(self, motion: Motion) -> tuple[Motion, list[str]]:
        """Return the changed motion, and a phrase for each change.

        Warns:
            UserWarning: a kept joint has to move, because a rotating joint above was removed.

        Raises:
            MotionError: an unknown joint, body parts that cannot be identified, or nothing left
                after trimming.
        """
        done = []
        if self.trim is not None:
            # Some clips of a folder may be shorter than the range.
            start, end = self.trim
            if start >= motion.duration:
                lasts = f"it begins at {start:g} s, the motion lasts {motion.duration:g} s"
                raise MotionError(f"trim leaves nothing: {lasts}")
            motion = motion.trim(start, min(end, motion.duration))
            done.append(f"cut to {motion.duration:.2f} s")
        if self.mirror:
            motion = motion.mirror()
            done.append("mirrored")
        if self.rig is not None:
            motion = self.rig.put(motion)
            done.append(f"on {self.rig.name}, {counted(motion.skeleton.n_joints, 'joint')}")
        if self.joints != "all":
            before = motion
            motion = motion.keep(
                body_joints(motion.skeleton) if self.joints == "body" else self.joints
            )
            if motion is not before:
                done.append(f"{motion.skeleton.n_joints} of {before.skeleton.n_joints} joints")
            if moving := motion.joint_translations.keys() - before.joint_translations.keys():
                text = "for want of a parent, they get positions, which some programs ignore"
                warnings.warn(f"{', '.join(sorted(moving))}: {text}", stacklevel=2)
        if self.fps is not None and self.fps != motion.fps:
            done.append(f"{motion.fps:.6g} to {self.fps:.6g} fps")
            motion = motion.resample(self.fps, antialias=self.antialias)
        return motion, done


def parse_trim(text: str) -> tuple[float, float]:
    """Parse ``"2:10.5"`` as (start, end) seconds; start and end may be left out.

    Raises:
        ConfigError: not an interval, or one that ends before it begins.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)?\s*:\s*(\d+(?:\.\d*)?|\.\d+)?\s*", text)
    start = end = 0.0
    if match and (match[1] or match[2]):
        start, end = float(match[1] or 0), float(match[2] or math.inf)
    if end <= start:
        raise ConfigError(f"trim {text!r}; write START:END in seconds, as 2:10.5, 2: or :10.5")
    return start, end


class Converter(Processor):
    """Conversion of one motion, with all settings of a `Conversion`, into a folder."""

    def __init__(self, conversion: Conversion, out: Path, formats: Sequence[str]) -> None:
        body_model = conversion.body_model
        model = {} if body_model is None else {"body_model": body_model}
        self.read, self.write = {**conversion.read, **model}, {**conversion.write, **model}
        self.out, self.existing, self.parts = out, conversion.existing, conversion.parts
        self.changes, self.dry_run = conversion.changes, conversion.dry_run
        self.face = conversion._face
        changes = {f.name: getattr(self.changes, f.name) for f in dataclasses.fields(Changes)}
        read = {f"in-{name}": value for name, value in self.read.items()}
        self.settings = json_of({**changes, **read, "parts": dict(self.parts)})
        self.written = {
            kind: json_of(applicable_write_options(kind, self.write)) for kind in formats
        }

    def _face_of(self, task: Task) -> Path | None:
        """Return the file with the face of a motion, if it is given."""
        if self.face is None or not self.face.is_dir():
            return self.face
        file = self.face / f"{task.id}.csv"
        return file if file.exists() else None

    def input_of(self, task: Task, digest: str | None = None) -> dict[str, Any]:
        """Return what the results of a task depend on beside `settings`; see `Processor`."""
        face = self._face_of(task)
        return super().input_of(task, digest) | ({"face": path_digest(face)} if face else {})

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
        motion = load(task.file, self.read, self.parts)
        for reason in plausibility_warnings(motion, self.read):
            warnings.warn(f"{task.source}: {reason}", stacklevel=2)
        result.facts["found"] = _summary(motion)
        if (file := self._face_of(task)) is not None:
            motion = replace(motion, face=read_live_link(file, motion.fps, motion.n_frames))
        elif self.face is not None:
            warnings.warn(f"{task.source}: no {task.id}.csv in {self.face}", stacklevel=2)
        motion, done = self.changes(motion)
        result.facts["done"] = tuple(done)
        result.sound = motion.duration
        for target in self.missing(result, task.id):
            suffix = target.suffix.lower()
            options = applicable_write_options(suffix[1:], self.write)
            if self.changes.rig is not None:
                options |= self.changes.rig.options.get(suffix, {})
            _warn_of_losses(motion, target)
            if not self.dry_run:
                motion.save(target, **options)


@dataclass
class Conversion:
    """Conversion of motions to a file or into a folder.

    Into a folder, the work is a batch: what was made with the same settings and input is kept.

    Args:
        sources: motion files, and folders to search for motions.
        out: a file for a single motion, otherwise a folder; see `find_tasks`.
        formats: formats to write into a folder: bvh, npz, glb, vrma, fbx, html, mp4,
            png, svg, pdf, obj, csv (the face).
        changes: changes to make to each motion.
        read: options of readers, such as `up`, for those that have them; also `fps` and `height`,
            see `load`.
        write: the same for writers.
        body_model: npz file of an SMPL or SMPL-X model, or a folder of such files, for readers and
            writers that use one.
        parts: joints of the sources specified by hand, see `load`.
        face: CSV file of Live Link Face that becomes the face of a single motion, or a folder
            with one for each, named as its results.
        existing: "refuse", "skip" or "replace" files that were made with other settings.
        dry_run: read and change, but write nothing.
        execution: how the work is done.

    Attributes:
        tasks: the motions to convert.

    Raises:
        ConfigError: the conversion cannot start; see `find_tasks`.

    Warns:
        UserWarning: meshes that cannot be written without a body model, beside other formats.
    """

    sources: Sequence[str | os.PathLike[str]] | str | os.PathLike[str]
    out: str | os.PathLike[str]
    formats: Sequence[str] = ()
    changes: Changes = field(default_factory=Changes)
    read: Mapping[str, Any] = field(default_factory=dict)
    write: Mapping[str, Any] = field(default_factory=dict)
    body_model: str | os.PathLike[str] | None = None
    parts: Mapping[str, str] = field(default_factory=dict)
    face: str | os.PathLike[str] | None = None
    existing: str = "refuse"
    dry_run: bool = False
    execution: Execution = field(default_factory=Execution)
    tasks: list[Task] = field(init=False)

    def __post_init__(self) -> None:
        sources = self.sources
        paths = [sources] if isinstance(sources, str | os.PathLike) else sources
        self._sources = [Path(path) for path in paths]
        self._out = out = Path(self.out)
        self._face = None if self.face is None else Path(self.face)
        if self.body_model is None:
            self.formats = _without_mesh(self.formats, out)
        is_one = is_file_name(out, self._sources, self.formats)
        if is_one and self.execution.shard[1] > 1:
            raise ConfigError(f"{out}: a file cannot be split into shards; give a folder")
        folder, kinds = (out.parent, [out.suffix[1:]]) if is_one else (out, self.formats)
        self.tasks = self._find([kind.lower() for kind in kinds])
        self._converter = Converter(self, folder, kinds)
        self._batch = None if is_one else Batch(self._converter, self.tasks, self.execution)
        self.tasks = self._batch.tasks if self._batch else self.tasks
        self._kept = _kept(out, self.existing) if is_one else ()

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
        if self._batch and not self.dry_run:
            yield from self._batch.run()
            return
        # Without a record.
        for task in self.tasks:
            result = Result(task, "kept" if self._kept else "left", kept=self._kept)
            if self._batch:
                result = self._batch.known(task)
            yield self._converter(result) if result.status == "left" else result

    def _find(self, kinds: Sequence[str]) -> list[Task]:
        tasks = find_tasks(self._sources, self._out, self.formats)
        face = self._face
        if face is not None and not face.is_dir() and not (face.exists() and len(tasks) == 1):
            why = f"one file for {len(tasks)} motions" if face.exists() else "no such file"
            need = "give the CSV of a single motion, or a folder with one for each"
            raise ConfigError(f"--face {face}: {why}; {need}")
        paths = [task.file for task in tasks if task.error is None]
        kinds = kinds if paths else ()
        refuse_unused_options(self.read, paths, self.write, kinds, self.body_model)
        return tasks


def _summary(motion: Motion) -> str:
    """Return unit, axes, rate, frames and joints of a motion; "?" marks guesses."""
    words = describe_axes(motion.info, "?")
    if "scale" in motion.info:
        words.append(f"scaled by {motion.info['scale']:.4g}")
    frames, joints = counted(motion.n_frames, "frame"), counted(motion.skeleton.n_joints, "joint")
    return ", ".join([*words, f"{motion.fps:.6g} fps", frames, joints])


def _without_mesh(formats: Sequence[str], out: Path) -> Sequence[str]:
    """Return the formats that can be written without a body model."""
    if "obj" not in (formats or [out.suffix.lower()[1:]]):
        return formats
    needs = "an obj needs the mesh of a body model: give --body-model SMPLX_NEUTRAL.npz"
    others = [name for name in formats if name != "obj"]
    if not others:
        raise ConfigError(needs)
    warnings.warn(f"no obj is written; {needs}", stacklevel=3)
    return others


def _warn_of_losses(motion: Motion, target: Path) -> None:
    """Warn of data of a motion that the format of a target cannot hold."""
    suffix, face = target.suffix.lower(), motion.face
    lost = ["face"] if face and suffix == ".bvh" else []
    if face and is_smplx(face) and suffix in (".vrma", ".fbx"):
        lost.append("SMPL-X face coefficients")  # which are not in [0, 1]
    lost += ["body shape (betas)"] if motion.skeleton.body_shape.betas else []
    if lost and suffix in _WITHOUT_SHAPE:
        text = f"{_WITHOUT_SHAPE[suffix]} holds no {' and no '.join(lost)}; npz does"
        warnings.warn(f"{target}: {text}", stacklevel=2)


def _kept(target: Path, existing: str) -> tuple[Path, ...]:
    """Return the single target if it exists and is kept, or nothing.

    Raises:
        ConfigError: it exists, and `existing` is "refuse".
    """
    if existing == "replace" or not os.path.lexists(target):
        return ()
    if existing == "refuse":
        refuse_existing([target])
    return (target,)
