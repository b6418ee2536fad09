"""Options of the readers and writers of all motion formats."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gesturekit.errors import ConfigError, FormatError
from gesturekit.formats.registry import READ_OPTIONS, WRITE_OPTIONS, format_of
from gesturekit.formats.sources import OTHER_MOTION_SUFFIXES, unreadable_media
from gesturekit.motion.motion import Motion

_IN = {name: f"in-{name}" for name in ("unit", "up", "forward")}
"""Reader options that have another name on the command line."""
_OF_ANY_FORMAT = ("fps", "height")


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
    kind = format_of(source)
    if kind in OTHER_MOTION_SUFFIXES and kind not in READ_OPTIONS:
        raise FormatError(f"{source}: {unreadable_media(source)}")
    known = READ_OPTIONS.get(kind, ())
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
    known = (*_OF_ANY_FORMAT, *READ_OPTIONS.get(format_of(source), ()))
    return {name: value for name, value in options.items() if name in known}


def applicable_write_options(kind: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `options` of writers that the writer of a format ("bvh") has."""
    known = WRITE_OPTIONS.get(f".{kind.lower()}", ())
    return {name: value for name, value in options.items() if name in known}


def writer_options(formats: Sequence[str], options: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return, for each format, the options that its writer has: {"bvh": {"unit": "m"}}.

    Raises:
        ConfigError: an option that none of the formats has.
    """
    _refuse_unused(options, "written", (WRITE_OPTIONS, {f".{name}" for name in formats}))
    return {kind: applicable_write_options(kind, options) for kind in formats}


def refuse_unused_options(
    read: Mapping[str, Any],
    write: Mapping[str, Any],
    body_model: str | os.PathLike[str] | None,
    sources: Iterable[Path],
    formats: Iterable[str],
) -> None:
    """Refuse options that no reader of the sources and no writer of the formats has.

    Raises:
        ConfigError: an option would have no effect.
    """
    reads = {format_of(path) for path in sources}
    writes = WRITE_OPTIONS, {f".{name}" for name in formats}
    refuse_unused_read_options(read, reads)
    _refuse_unused(write, "written", writes)
    if body_model is not None:
        _refuse_unused(["body_model"], "converted", (READ_OPTIONS, reads), writes)


def refuse_unused_read_options(options: Mapping[str, Any], formats: set[str]) -> None:
    """Refuse options of `load` that no reader of these formats (suffixes) has.

    Raises:
        ConfigError: an option would have no effect.
    """
    names = [name for name in options if name not in _OF_ANY_FORMAT]
    _refuse_unused(names, "read", (READ_OPTIONS, formats))


def _refuse_unused(
    options: Iterable[str], verb: str, *uses: tuple[Mapping[str, Collection[str]], set[str]]
) -> None:
    """Raise ConfigError for an option that none of the formats has.

    Args:
        options: their names.
        verb: what is done with the formats: "read", "written" or "converted".
        uses: pairs of a table of options by format, and the formats that are read or written.
    """
    formats = {form for _, used in uses for form in used}
    for name in options if formats else ():
        fitting = [form for table, _ in uses for form, known in table.items() if name in known]
        if not any(name in table.get(form, ()) for table, used in uses for form in used):
            option = f"--{_IN.get(name, name) if verb == 'read' else name}".replace("_", "-")
            raise ConfigError(
                f"{option} is an option of {', '.join(dict.fromkeys(fitting))}; only "
                f"{', '.join(sorted(formats))} is {verb}"
            )


def describe_axes(info: Mapping[str, Any], guessed: str) -> list[str]:
    """Return unit and axes of a motion's file; `guessed` is appended to guesses."""
    words = []
    for key, text in (("unit", "{}"), ("up", "{} up"), ("forward", "{} forward")):
        if key in info:
            value = info[key] if key == "unit" else info[key].upper()
            words.append(text.format(value) + (guessed if key in info.get("guessed", ()) else ""))
    return words
