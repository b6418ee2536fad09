"""Motion files from one format to another, one or many; a broken one never stops the others."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
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

# Which options each format's reader and writer has.
_SEQUENCE = {"up", "fps", "person", "body_model"}
_READS = {
    ".bvh": {"unit", "up", "forward"},
    ".npz": {"up", "body_model"},
    ".json": _SEQUENCE,
    "EasyMocap": _SEQUENCE,
}
_IN = {name: f"in-{name}" for name in ("unit", "up", "forward")}
"""Options of readers that the command line gives another name."""
_OF_ANY_FORMAT = ("fps", "height")
_WRITES = {
    ".bvh": {"unit"},
    ".npz": {"up"},
    ".obj": {"body_model", "frame"},
    ".html": {"body_model"},
}


@dataclass(frozen=True)
class Converted:
    """What became of one motion.

    Attributes:
        source: the file, or the folder of a sequence.
        files: what was written; nothing where all of it was there already and was to be skipped.
        found: what was read, in words: unit, axes, rate, frames, joints.
        done: what was changed on the way, in words.
        warnings: what the files do not hold, or what other programs will make of them.
        error: why some or all files are missing.
    """

    source: Path
    files: tuple[Path, ...] = ()
    found: str = ""
    done: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    error: str | None = None


def convert(
    sources: Sequence[str | os.PathLike[str]] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    formats: Sequence[str] = (),
    changes: Changes | None = None,
    read: Mapping[str, Any] | None = None,
    write: Mapping[str, Any] | None = None,
    body_model: str | os.PathLike[str] | None = None,
    parts: Mapping[str, str] | None = None,
    existing: str = "refuse",
    dry_run: bool = False,
    progress: Callable[[list[Job]], Iterable[Job]] = iter,
) -> Iterator[Converted]:
    """Read each motion, change it, and write it in other formats.

    Args:
        sources: motion files, and folders, which stand for all motions below them.
        out: a file for a single motion, else a folder; see `gesturekit.formats.sources.plan`.
        formats: what to write into a folder, of bvh, npz, html, png, obj.
        changes: what to change on the way.
        read: options for those readers that have them, such as `up`; `fps`, the rate that a
            source really has, whatever it says; and `height`, to which its body is scaled.
        write: options for those writers that have them, such as `up`.
        body_model: npz file of an SMPL or SMPL-X model, for readers and writers that have a use.
        parts: joints of the sources named by hand, see `load`.
        existing: what to do about files that are there already: refuse, skip or replace.
        dry_run: read and change, but write nothing.
        progress: wraps the list of jobs while they are done, as tqdm does.

    Yields:
        an outcome for each motion, as it is done.

    Raises:
        ConfigError: nothing can start; see `gesturekit.formats.sources.plan`.

    Warns:
        UserWarning: meshes that cannot be written without a body model, beside other formats.
    """
    if isinstance(sources, str | os.PathLike):
        sources = [sources]
    if body_model is None:
        formats = _without_mesh(formats, Path(out))
    jobs = plan([Path(source) for source in sources], Path(out), formats, existing=existing)
    read, write, changes = dict(read or {}), dict(write or {}), changes or Changes()
    found = {_format(job.source) for job in jobs if not job.error}
    written = {_format(target) for job in jobs for target in job.targets}
    refuse_unused_read_options(read, found)
    _refuse_idle(write, _WRITES, written, "written")
    if body_model is not None:
        _refuse_idle({"body_model": body_model}, _READS | _WRITES, found | written, "converted")
        read["body_model"] = write["body_model"] = body_model
    said: set[str] = set()
    for job in progress(jobs):
        if job.targets or job.error:
            outcome = _convert(job, changes, read, parts, write, dry_run)
            fresh = tuple(line for line in outcome.warnings if line not in said)
            said.update(fresh)
            yield replace(outcome, warnings=fresh)
        else:
            yield Converted(job.source)


def load(
    source: Path, options: Mapping[str, Any], parts: Mapping[str, str] | None = None
) -> Motion:
    """Read a motion whatever its format is.

    Args:
        source: a file, or the folder of a sequence.
        options: those that the format's reader has are given to it; `fps`, the rate that the
            source really has, whatever it says; and `height`, to which the body is scaled.
        parts: joints named by hand, {"left_elbow": "Joint12"}, see `Skeleton.parts`.

    Raises:
        FormatError: it cannot be read.
        MotionError: `parts` names a joint that is not there.
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
    """Return those of the `options` of `load` that have an effect on this source."""
    known = (*_OF_ANY_FORMAT, *_READS.get(_format(source), ()))
    return {name: value for name, value in options.items() if name in known}


def refuse_unused_read_options(options: Mapping[str, Any], formats: set[str]) -> None:
    """Refuse an option of `load` that no reader of these formats (suffixes) has.

    Raises:
        ConfigError: it would be given in vain.
    """
    chosen = {name: value for name, value in options.items() if name not in _OF_ANY_FORMAT}
    _refuse_idle(chosen, _READS, formats, "read")


def describe(motion: Motion) -> str:
    """A motion in a few words: unit, axes, rate, frames, joints; ? marks what is but guessed."""
    words = describe_axes(motion.info, "?")
    if "scale" in motion.info:
        words.append(f"scaled by {motion.info['scale']:.4g}")
    words.append(f"{motion.fps:.6g} fps")
    words.append(counted(motion.n_frames, "frame"))
    words.append(counted(motion.skeleton.n_joints, "joint"))
    return ", ".join(words)


def describe_axes(info: Mapping[str, Any], guessed: str) -> list[str]:
    """Unit and axes of the file that a motion came from; `guessed` marks those without evidence."""
    words = []
    for key, text in (("unit", "{}"), ("up", "{} up"), ("forward", "{} forward")):
        if key in info:
            value = info[key] if key == "unit" else info[key].upper()
            words.append(text.format(value) + (guessed if key in info.get("guessed", ()) else ""))
    return words


def writer_options(formats: Sequence[str], options: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return, for each format, those options that its writer has: {"bvh": {"unit": "m"}}.

    Raises:
        ConfigError: an option that none of the formats has.
    """
    _refuse_idle(options, _WRITES, {f".{name}" for name in formats}, "written")
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


def _refuse_idle(
    options: Mapping[str, Any], table: Mapping[str, set[str]], formats: set[str], verb: str
) -> None:
    """An option that none of the formats has would be given in vain."""
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


def _convert(
    job: Job,
    changes: Changes,
    read: Mapping[str, Any],
    parts: Mapping[str, str] | None,
    write: Mapping[str, Any],
    dry_run: bool,
) -> Converted:
    outcome = Converted(job.source, error=job.error)
    files: list[Path] = []
    at = job.source
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            if job.error is None:
                motion = load(job.source, read, parts)
                for doubt in plausibility_warnings(motion, read):
                    warnings.warn(f"{job.source}: {doubt}", stacklevel=2)
                outcome = replace(outcome, found=describe(motion))
                motion, done = changes(motion)
                outcome = replace(outcome, done=tuple(done))
                for at in job.targets:
                    _write(motion, at, changes, write, dry_run)
                    files.append(at)
    except (GestureKitError, OSError, MemoryError, RecursionError) as error:
        outcome = replace(outcome, error=_reason(error, job.source, at))
    lines = dict.fromkeys(str(warning.message) for warning in said)
    return replace(outcome, files=tuple(files), warnings=tuple(lines))


def _write(
    motion: Motion, target: Path, changes: Changes, write: Mapping[str, Any], dry_run: bool
) -> None:
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
    """Why a motion was not read from `source`, or not written to `at`, in one line."""
    if isinstance(error, OSError):  # of a temporary file beside it, where it was written
        return f"{at}: {error.strerror or error}"
    reason = str(error) or "not enough memory"
    # Not every reason names the file: a joint that is not there, parts that cannot be told.
    reason = reason if str(source) in reason or str(at) in reason else f"{source}: {reason}"
    # One line, and printable: a file name need not be text.
    return " ".join(reason.encode("utf-8", "replace").decode().splitlines())
