"""Registry of motion formats: one entry a format, from which every list of formats is made.

Also the kinds of other files, from their first bytes and whatever their suffixes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Set
from dataclasses import dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

from gesturekit.errors import FormatError
from gesturekit.wording import listed

FOLDER = "EasyMocap"
"""Stands for a suffix where a folder is one motion."""

_AXES = {"unit", "up", "forward", "fps"}
_CURVES = {"animation", *_AXES}
_BODY = {"body", "body_model"}
_SMPL = {"up", "body_model"}
_SEQUENCE = {"fps", "person", *_SMPL}
_GLTF, _EASYMOCAP = "formats.gltf.reading:read_gltf", "formats.easymocap:read_easymocap"
_PICTURE = "viewer:write_picture"


@dataclass(frozen=True)
class Format:
    """A format of motion files.

    Attributes:
        suffix: of the files, or `FOLDER`.
        reader, writer: "module:function" in gesturekit, imported on first use; None without one.
        reads, writes: options of reader and writer that commands offer.
        searched: whether such files are searched for in folders.
    """

    suffix: str
    reader: str | None
    writer: str | None
    reads: Set[str] = frozenset()
    writes: Set[str] = frozenset()
    searched: bool = False


FORMATS = (
    Format(".bvh", "formats.bvh:read_bvh", "formats.bvh:write_bvh", _AXES, {"unit"}, searched=True),
    Format(".npz", "formats.npz:read_npz", "formats.npz:write_npz", _SMPL, {"up"}, searched=True),
    Format(".glb", _GLTF, "viewer:write_glb", _CURVES, _BODY, searched=True),
    Format(".gltf", _GLTF, None, _CURVES, searched=True),
    Format(".vrm", _GLTF, None, _CURVES),  # an avatar, which has no motion: a rig
    Format(".vrma", _GLTF, "viewer:write_vrma", _CURVES, searched=True),
    Format(".fbx", "formats.fbx:read_fbx", "viewer:write_fbx", _CURVES, _BODY),
    Format(".frames", "formats.npz:read_frames", None),
    Format(".json", _EASYMOCAP, None, _SEQUENCE),
    Format(FOLDER, _EASYMOCAP, None, _SEQUENCE),
    Format(".html", None, "viewer:write_html", writes=_BODY | {"framing"}),
    Format(".mp4", None, "viewer:write_video", writes=_BODY | {"framing", "size", "fps"}),
    *(Format(suffix, None, _PICTURE, writes={"body"}) for suffix in (".png", ".svg", ".pdf")),
    Format(".obj", None, "formats.smpl:write_obj", writes={"body_model"}),
    Format(".csv", None, "formats.live_link:write_live_link"),  # the face alone
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
    known_options = _keywords(table[suffix])
    for option in set(options).difference(known_options):
        others = ", ".join(other for other in table if option in _keywords(table[other]))
        only = f"only {others}" if others else "nor has any other format"
        known = ", ".join(known_options) or "no options"
        what = f"{suffix} has no option {option!r} to {verb} it with"
        raise FormatError(f"{path}: {what}, {only}; {suffix} has {known}")
    return load_function(table[suffix])


def notebook_player() -> Callable[..., Any]:
    """Return the function that makes a player for a notebook."""
    return load_function("viewer:display")


def load_function(place: str) -> Callable[..., Any]:
    """Import and return the function of "module:function"."""
    module, _, name = place.partition(":")
    return getattr(import_module(f"gesturekit.{module}"), name)


def _keywords(place: str) -> list[str]:
    parameters = signature(load_function(place)).parameters.values()
    return [each.name for each in parameters if each.default is not each.empty]


A_JSON_FILE = "a JSON file"
_SIGNATURES = {
    b"HIERARCHY": "a BVH file",
    b"RIFF": "a wav file",
    b"fLaC": "a flac file",
    b"OggS": "an ogg file",
    b"PK\x03\x04": "a zip or npz file",
    b"Kaydara FBX": "an FBX file",
    b"\x93NUMPY": "an npy file",
    b"glTF": "a glTF file",
    b"; FBX": "an FBX file",
    b"<": "an XML or HTML file",
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"%PDF": "a PDF document",
    b"{": A_JSON_FILE,
}
REPORT_IN_WORDS = "figures that gesturekit evaluate wrote (--json); --out FILE.html shows them"
_REPORT = {"reference", "models", "definitions"}  # keys


def kind_by_content(start: bytes) -> str | None:
    """Return the kind of a file from its first 16 bytes or more; None if unknown."""
    kinds = (kind for mark, kind in _SIGNATURES.items() if start.startswith(mark))
    return next(kinds, None)


def is_report(path: Path) -> bool:
    """Return whether a JSON file holds the metrics of an evaluation."""
    try:
        return json_in_words(json.loads(path.read_text(encoding="utf-8"))) == REPORT_IN_WORDS
    except (OSError, ValueError, RecursionError):
        return False


def json_in_words(content: Any) -> str:
    """Return a description of the content of a JSON file."""
    if not isinstance(content, dict):
        return f"a JSON {type(content).__name__}"
    if content.keys() >= _REPORT:
        return REPORT_IN_WORDS
    keys = [ascii(key)[1:-1][:40] for key in content]
    return f"a JSON object with {'the keys ' + listed(keys) if keys else 'no keys'}"
