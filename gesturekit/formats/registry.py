"""Registry of motion formats: one entry a format, from which every list of formats is made."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

from gesturekit.errors import FormatError

FOLDER = "EasyMocap"
"""Stands for a suffix where a folder is one motion."""

_CURVES = frozenset({"animation", "unit", "up", "forward", "fps"})
_BODY = frozenset({"body", "body_model"})
_SEQUENCE = frozenset({"up", "fps", "person", "body_model"})


@dataclass(frozen=True)
class Format:
    """A format of motion files.

    Attributes:
        suffix: of the files, or `FOLDER`.
        reader, writer: "module:function", imported on first use; None if there is none.
        reads, writes: options of reader and writer that commands offer.
        searched: whether such files are searched for in folders.
    """

    suffix: str
    reader: str | None = None
    writer: str | None = None
    reads: frozenset[str] = field(default_factory=frozenset)
    writes: frozenset[str] = field(default_factory=frozenset)
    searched: bool = False


FORMATS = (
    Format(
        ".bvh",
        "gesturekit.formats.bvh.bvh:read_bvh",
        "gesturekit.formats.bvh.bvh:write_bvh",
        reads=frozenset({"unit", "up", "forward", "fps"}),
        writes=frozenset({"unit"}),
        searched=True,
    ),
    Format(
        ".npz",
        "gesturekit.formats.npz:read_npz",
        "gesturekit.formats.npz:write_npz",
        reads=frozenset({"up", "body_model"}),
        writes=frozenset({"up"}),
        searched=True,
    ),
    *(
        Format(
            suffix,
            "gesturekit.formats.gltf.reading:read_gltf",
            writer,
            reads=_CURVES,
            writes=_BODY if suffix == ".glb" else frozenset(),
            searched=suffix != ".vrm",  # an avatar, which has no motion: a rig
        )
        for suffix, writer in (
            (".glb", "gesturekit.viewer:write_glb"),
            (".gltf", None),
            (".vrm", None),
            (".vrma", "gesturekit.viewer:write_vrma"),
        )
    ),
    Format(
        ".fbx",
        "gesturekit.formats.fbx:read_fbx",
        "gesturekit.viewer:write_fbx",
        reads=_CURVES,
        writes=_BODY,
    ),
    Format(".frames", "gesturekit.formats.frames:read_frames"),
    Format(".json", "gesturekit.formats.smpl.easymocap:read_easymocap", reads=_SEQUENCE),
    Format(FOLDER, "gesturekit.formats.smpl.easymocap:read_easymocap", reads=_SEQUENCE),
    Format(
        ".html",
        writer="gesturekit.viewer:write_html",
        writes=frozenset({"body", "body_model", "framing"}),
    ),
    Format(
        ".mp4",
        writer="gesturekit.viewer:write_video",
        writes=frozenset({"body", "body_model", "framing", "size", "fps"}),
    ),
    *(
        Format(suffix, writer="gesturekit.viewer:write_picture", writes=frozenset({"body"}))
        for suffix in (".png", ".svg", ".pdf")
    ),
    Format(
        ".obj",
        writer="gesturekit.formats.obj:write_obj",
        writes=frozenset({"body_model", "frame"}),
    ),
)
"""All formats, in the order in which messages and help list them."""

MOTION_SUFFIXES = tuple(entry.suffix for entry in FORMATS if entry.searched)
"""Motion files searched for in folders, besides EasyMocap sequences."""
READABLE = tuple(entry.suffix for entry in FORMATS if entry.reader and entry.suffix != FOLDER)
"""Suffixes of files that are read as one motion."""
WRITABLE = tuple(entry.suffix[1:] for entry in FORMATS if entry.writer)
"""Names of formats that are written."""
READ_OPTIONS = {entry.suffix: entry.reads for entry in FORMATS if entry.reader}
WRITE_OPTIONS = {entry.suffix: entry.writes for entry in FORMATS if entry.writer}
"""Options that commands offer, by suffix."""


def format_of(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a path in lower case, `FOLDER` for a folder."""
    return FOLDER if Path(path).is_dir() else Path(path).suffix.lower()


def reader_of(path: str | os.PathLike[str], options: Iterable[str]) -> Callable[..., Any]:
    """Return the reader of a file or folder.

    Raises:
        FormatError: no format is read from such a path, or its reader lacks an option.
    """
    readers = {entry.suffix: entry.reader for entry in FORMATS if entry.reader}
    return _function(readers, path, "read", options)


def writer_of(path: str | os.PathLike[str], options: Iterable[str]) -> Callable[..., Any]:
    """Return the writer of a file.

    Raises:
        FormatError: no format is written to such a path, or its writer lacks an option.
    """
    writers = {entry.suffix: entry.writer for entry in FORMATS if entry.writer}
    return _function(writers, path, "write", options)


def _function(
    table: dict[str, str], path: str | os.PathLike[str], verb: str, options: Iterable[str]
) -> Callable[..., Any]:
    """Return the function of a path's format, after checking that it has these options."""
    suffix = format_of(path)
    if suffix not in table:
        kind = "a folder" if suffix == FOLDER else suffix or "a file without suffix"
        known = ", ".join("a folder" if each == FOLDER else each for each in table)
        raise FormatError(f"{path}: cannot {verb} motion as {kind}; expected {known}")
    for option in options:
        if option not in (own := _keywords(table[suffix])):
            others = ", ".join(other for other in table if option in _keywords(table[other]))
            raise FormatError(
                f"{path}: {suffix} has no option {option!r} to {verb} it with, "
                f"{f'only {others}' if others else 'nor has any other format'}; "
                f"{suffix} has {', '.join(own) or 'no options'}"
            )
    return load_function(table[suffix])


def load_function(place: str) -> Callable[..., Any]:
    """Import and return the function of "module:function"."""
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


def _keywords(place: str) -> list[str]:
    parameters = signature(load_function(place)).parameters.values()
    return [each.name for each in parameters if each.default is not each.empty]
