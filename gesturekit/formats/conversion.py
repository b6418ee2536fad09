"""Conversion of motion files between formats; a broken file never stops the others."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.errors import ConfigError, FormatError, GestureKitError
from gesturekit.formats.changes import Changes
from gesturekit.formats.plausibility import plausibility_warnings
from gesturekit.formats.smpl.skeleton import is_smpl
from gesturekit.formats.sources import OTHER_MOTION_SUFFIXES, Job, plan, unreadable_media
from gesturekit.motion.motion import Motion
from gesturekit.wording import counted

# Options of each format's reader and writer.
_SEQUENCE = {"up", "fps", "person", "body_model"}
_READS = {
    ".bvh": {"unit", "up", "forward"},
    ".npz": {"up", "body_model"},
    ".json": _SEQUENCE,
    "EasyMocap": _SEQUENCE,
}
_IN = {name: f"in-{name}" for name in ("unit", "up", "forward")}
"""Reader options that have another name on the command line."""
_OF_ANY_FORMAT = ("fps", "height")
_WRITES = {
    ".bvh": {"unit"},
    ".npz": {"up"},
    ".obj": {"body_model", "frame"},
    ".html": {"body", "body_model"},
    ".mp4": {"body", "body_model", "size"},
    ".png": {"body"},
    ".svg": {"body"},
    ".pdf": {"body"},
}


@dataclass(frozen=True)
class Converted:
    """Outcome of one conversion.

    Attributes:
        source: the file, or the folder of a sequence.
        files: files written; empty if all of them existed and `existing` is "skip".
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
class FormatOptions:
    """Options of readers and writers; each gets those that it has.

    Attributes:
        read: options of readers, such as `up`; also `fps` and `height`, see `load`.
        write: options of writers, such as `up`.
        body_model: npz file of an SMPL or SMPL-X model, for readers and writers that use one.
        parts: joints of the sources specified by hand, see `load`.
    """

    read: Mapping[str, Any] = field(default_factory=dict)
    write: Mapping[str, Any] = field(default_factory=dict)
    body_model: str | os.PathLike[str] | None = None
    parts: Mapping[str, str] = field(default_factory=dict)


def convert(
    sources: Sequence[str | os.PathLike[str]] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    formats: Sequence[str] = (),
    changes: Changes | None = None,
    options: FormatOptions | None = None,
    existing: str = "refuse",
    dry_run: bool = False,
    progress: Callable[[list[Job]], Iterable[Job]] = iter,
) -> Iterator[Converted]:
    """Read each motion, change it, and write it in other formats.

    Args:
        sources: motion files, and folders to search for motions.
        out: a file for a single motion, otherwise a folder; see `gesturekit.formats.sources.plan`.
        formats: formats to write into a folder: bvh, npz, html, mp4, png, svg, pdf, obj.
        changes: changes to make to each motion.
        options: options of readers and writers.
        existing: "refuse", "skip" or "replace" files that exist.
        dry_run: read and change, but write nothing.
        progress: wrapper of the list of jobs, such as tqdm.

    Yields:
        The outcome of each motion, as soon as it is done.

    Raises:
        ConfigError: the conversion cannot start; see `gesturekit.formats.sources.plan`.

    Warns:
        UserWarning: meshes that cannot be written without a body model, beside other formats.
    """
    if isinstance(sources, str | os.PathLike):
        sources = [sources]
    options, changes = options or FormatOptions(), changes or Changes()
    if options.body_model is None:
        formats = _without_mesh(formats, Path(out))
    jobs = plan([Path(source) for source in sources], Path(out), formats, existing=existing)
    options = _checked(options, jobs)
    shown: set[str] = set()
    for job in progress(jobs):
        if job.targets or job.error:
            outcome = _convert(job, changes, options, dry_run)
            fresh = tuple(line for line in outcome.warnings if line not in shown)
            shown.update(fresh)
            yield replace(outcome, warnings=fresh)
        else:
            yield Converted(job.source)


def _checked(options: FormatOptions, jobs: Sequence[Job]) -> FormatOptions:
    """Raise ConfigError for options that no job uses; add the body model to `read` and `write`."""
    found = {_format(job.source) for job in jobs if not job.error}
    written = {_format(target) for job in jobs for target in job.targets}
    refuse_unused_read_options(options.read, found)
    _refuse_unused(options.write, _WRITES, written, "written")
    if options.body_model is None:
        return options
    model = {"body_model": options.body_model}
    _refuse_unused(model, _READS | _WRITES, found | written, "converted")
    return replace(options, read={**options.read, **model}, write={**options.write, **model})


def load(
    source: Path, options: Mapping[str, Any], parts: Mapping[str, str] | None = None
) -> Motion:
    """Read a motion of any format.

    Args:
        source: a file, or the folder of a sequence.
        options: options of the format's reader (others are ignored); `fps`, the true frame rate,
            which replaces that of the file; `height`, the body height in metres to scale to.
        parts: joints specified by hand, {"left_elbow": "Joint12"}, see `Skeleton.parts`.

    Raises:
        FormatError: it cannot be read.
        MotionError: `parts` names a joint that does not exist.
    """
    if _format(source) in OTHER_MOTION_SUFFIXES:
        raise FormatError(f"{source}: {unreadable_media(source)}")
    known = _READS.get(_format(source), ())
    motion = Motion.load(source, **{name: options[name] for name in options if name in known})
    motion = motion.with_parts(parts or {})
    if "height" in options:
        motion = motion.with_height(options["height"])
    return replace(motion, fps=options["fps"]) if "fps" in options else motion


def applicable_read_options(source: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `options` of `load` that have an effect on this source."""
    known = (*_OF_ANY_FORMAT, *_READS.get(_format(source), ()))
    return {name: value for name, value in options.items() if name in known}


def refuse_unused_read_options(options: Mapping[str, Any], formats: set[str]) -> None:
    """Refuse options of `load` that no reader of these formats (suffixes) has.

    Raises:
        ConfigError: an option would have no effect.
    """
    chosen = {name: value for name, value in options.items() if name not in _OF_ANY_FORMAT}
    _refuse_unused(chosen, _READS, formats, "read")


def describe(motion: Motion) -> str:
    """Return a summary of a motion: unit, axes, rate, frames, joints; "?" marks guesses."""
    words = describe_axes(motion.info, "?")
    if "scale" in motion.info:
        words.append(f"scaled by {motion.info['scale']:.4g}")
    words.append(f"{motion.fps:.6g} fps")
    words.append(counted(motion.n_frames, "frame"))
    words.append(counted(motion.skeleton.n_joints, "joint"))
    return ", ".join(words)


def describe_axes(info: Mapping[str, Any], guessed: str) -> list[str]:
    """Return unit and axes of a motion's file; `guessed` is appended to guesses."""
    words = []
    for key, text in (("unit", "{}"), ("up", "{} up"), ("forward", "{} forward")):
        if key in info:
            value = info[key] if key == "unit" else info[key].upper()
            words.append(text.format(value) + (guessed if key in info.get("guessed", ()) else ""))
    return words


def writer_options(formats: Sequence[str], options: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return, for each format, the options that its writer has: {"bvh": {"unit": "m"}}.

    Raises:
        ConfigError: an option that none of the formats has.
    """
    _refuse_unused(options, _WRITES, {f".{name}" for name in formats}, "written")
    return {
        name: {key: options[key] for key in options if key in _WRITES.get(f".{name}", ())}
        for name in formats
    }


def _without_mesh(formats: Sequence[str], out: Path) -> Sequence[str]:
    """Return the formats that can be written without a body model."""
    if "obj" not in (formats or [out.suffix.lower()[1:]]):
        return formats
    needs = "obj holds the skin of a body model: give it as --body-model SMPLX_NEUTRAL.npz"
    others = [name for name in formats if name != "obj"]
    if not others:
        raise ConfigError(needs)
    warnings.warn(f"no obj is written; {needs}", stacklevel=3)
    return others


def _refuse_unused(
    options: Mapping[str, Any], table: Mapping[str, set[str]], formats: set[str], verb: str
) -> None:
    """Raise ConfigError for an option that none of the formats has."""
    for name in options:
        fitting = [form for form, known in table.items() if name in known]
        if formats and not formats & set(fitting):
            option = f"--{_IN.get(name, name) if verb == 'read' else name}".replace("_", "-")
            raise ConfigError(
                f"{option} is an option of {', '.join(fitting)}; only "
                f"{', '.join(sorted(formats))} is {verb}"
            )


def _format(path: Path) -> str:
    return "EasyMocap" if path.is_dir() else path.suffix.lower()


def _convert(job: Job, changes: Changes, options: FormatOptions, dry_run: bool) -> Converted:
    """Return the outcome of one job; its errors and warnings are recorded in it."""
    outcome = Converted(job.source, error=job.error)
    files: list[Path] = []
    at = job.source
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            if job.error is None:
                motion = load(job.source, options.read, options.parts)
                for reason in plausibility_warnings(motion, options.read):
                    warnings.warn(f"{job.source}: {reason}", stacklevel=2)
                outcome = replace(outcome, found=describe(motion))
                motion, done = changes(motion)
                outcome = replace(outcome, done=tuple(done))
                for at in job.targets:
                    _write(motion, at, changes, options.write, dry_run)
                    files.append(at)
    except (GestureKitError, OSError, MemoryError, RecursionError) as error:
        outcome = replace(outcome, error=_reason(error, job.source, at))
    lines = dict.fromkeys(str(warning.message) for warning in caught)
    return replace(outcome, files=tuple(files), warnings=tuple(lines))


def _write(
    motion: Motion, target: Path, changes: Changes, write: Mapping[str, Any], dry_run: bool
) -> None:
    """Write one file, warning of data that its format cannot hold."""
    known = _WRITES.get(_format(target), ())
    options = {name: value for name, value in write.items() if name in known}
    if changes.rig is not None:
        options |= changes.rig.options.get(_format(target), {})
    if target.suffix.lower() == ".bvh":
        lost = ["face expressions"] if motion.expressions is not None else []
        if is_smpl(motion.skeleton) and np.any(motion.info.get("betas", 0)):
            lost.append("body shape (betas)")
        if lost:
            warnings.warn(f"{target}: BVH holds no {' and no '.join(lost)}; npz does", stacklevel=2)
    if not dry_run:
        motion.save(target, **options)


def _reason(error: Exception, source: Path, at: Path) -> str:
    """Return in one line why a motion was not read from `source` or not written to `at`."""
    if isinstance(error, OSError):  # it may name the temporary file, so name the target instead
        return f"{at}: {error.strerror or error}"
    reason = str(error) or "not enough memory"
    # Some errors do not name the file, such as those about joints.
    reason = reason if str(source) in reason or str(at) in reason else f"{source}: {reason}"
    # File names may hold line breaks and bytes that are not text.
    return " ".join(reason.encode("utf-8", "replace").decode().splitlines())
