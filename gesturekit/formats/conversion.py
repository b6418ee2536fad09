"""Options of the readers and writers of all motion formats."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gesturekit.errors import ConfigError, FormatError
from gesturekit.formats.sources import OTHER_MOTION_SUFFIXES, unreadable_media
from gesturekit.motion.motion import Motion
from gesturekit.wording import counted

# Options of each format's reader and writer.
_SEQUENCE = {"up", "fps", "person", "body_model"}
_READS = {
    ".bvh": {"unit", "up", "forward", "fps"},
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
class FormatOptions:
    """Options of readers and writers; each gets those that it has.

    Attributes:
        read: options of readers, such as `up`; also `fps` and `height`, see `load`.
        write: options of writers, such as `up`.
        body_model: npz file of an SMPL or SMPL-X model, or a folder of such files, for readers and
            writers that use one.
        parts: joints of the sources specified by hand, see `load`.
    """

    read: Mapping[str, Any] = field(default_factory=dict)
    write: Mapping[str, Any] = field(default_factory=dict)
    body_model: str | os.PathLike[str] | None = None
    parts: Mapping[str, str] = field(default_factory=dict)


def with_body_model(options: FormatOptions) -> FormatOptions:
    """Return options whose body model is among those of readers and writers."""
    if options.body_model is None:
        return options
    model = {"body_model": options.body_model}
    return replace(options, read={**options.read, **model}, write={**options.write, **model})


def refuse_unused_options(
    options: FormatOptions, sources: Iterable[Path], targets: Iterable[Path]
) -> None:
    """Refuse options that no reader of the sources and no writer of the targets has.

    Raises:
        ConfigError: an option would have no effect.
    """
    found, written = ({_format(path) for path in paths} for paths in (sources, targets))
    refuse_unused_read_options(options.read, found)
    _refuse_unused(options.write, "written", (_WRITES, written))
    if options.body_model is not None:
        model = {"body_model": options.body_model}
        _refuse_unused(model, "converted", (_READS, found), (_WRITES, written))


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


def load_with_warnings(
    source: Path, options: Mapping[str, Any], parts: Mapping[str, str] | None = None
) -> tuple[Motion, list[str]]:
    """Read a motion as `load` does; return it with the warnings of its reader."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", UserWarning)
        motion = load(source, options, parts)
    return motion, [str(warning.message) for warning in caught]


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
    _refuse_unused(chosen, "read", (_READS, formats))


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
    _refuse_unused(options, "written", (_WRITES, {f".{name}" for name in formats}))
    return {
        name: {key: options[key] for key in options if key in _WRITES.get(f".{name}", ())}
        for name in formats
    }


def without_mesh(formats: Sequence[str], out: Path) -> Sequence[str]:
    """Return the formats that can be written without a body model."""
    if "obj" not in (formats or [out.suffix.lower()[1:]]):
        return formats
    needs = "an obj needs the mesh of a body model: give --body-model SMPLX_NEUTRAL.npz"
    others = [name for name in formats if name != "obj"]
    if not others:
        raise ConfigError(needs)
    warnings.warn(f"no obj is written; {needs}", stacklevel=3)
    return others


def _refuse_unused(
    options: Mapping[str, Any], verb: str, *uses: tuple[Mapping[str, set[str]], set[str]]
) -> None:
    """Raise ConfigError for an option that none of the formats has.

    Args:
        options: by name.
        verb: what is done with the formats: "read", "written" or "converted".
        uses: pairs of a table of options by format, and the formats that are read or written.
    """
    formats = {form for _, used in uses for form in used}
    for name in options:
        fitting = [form for table, _ in uses for form, known in table.items() if name in known]
        has = any(name in table.get(form, ()) for table, used in uses for form in used)
        if formats and not has:
            option = f"--{_IN.get(name, name) if verb == 'read' else name}".replace("_", "-")
            raise ConfigError(
                f"{option} is an option of {', '.join(dict.fromkeys(fitting))}; only "
                f"{', '.join(sorted(formats))} is {verb}"
            )


def _format(path: Path) -> str:
    return "EasyMocap" if path.is_dir() else path.suffix.lower()


def applicable_write_options(target: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `options` of writers that have an effect on this target."""
    known = _WRITES.get(_format(target), ())
    return {name: value for name, value in options.items() if name in known}


def warn_of_losses(motion: Motion, target: Path) -> None:
    """Warn of data of a motion that the format of a target cannot hold."""
    if target.suffix.lower() == ".bvh":
        lost = ["face expressions"] if motion.expressions is not None else []
        if motion.skeleton.body_shape.betas:
            lost.append("body shape (betas)")
        if lost:
            warnings.warn(f"{target}: BVH holds no {' and no '.join(lost)}; npz does", stacklevel=2)
