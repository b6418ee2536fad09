"""The text of a BVH file: taken apart and checked, not yet understood."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np

from gesturekit.errors import FormatError

_LONGEST_LINE = 1 << 20
_MOST_JOINTS = 10_000


@dataclass
class ParsedJoint:
    """A ROOT or JOINT as written.

    Attributes:
        name: unique; a name that comes again has a number added.
        parent: index of the joint that it stands in, -1 for the root.
        line: where it begins.
        offset: in the file's unit.
        channels: "Xp" for Xposition, "Zr" for Zrotation, ..., in the file's order.
        ends: OFFSETs of its end sites.
    """

    name: str
    parent: int
    line: int
    offset: tuple[float, float, float] | None = None
    channels: list[str] = field(default_factory=list)
    ends: list[tuple[float, float, float]] = field(default_factory=list)


@dataclass
class ParsedBvh:
    """A file taken apart.

    Attributes:
        joints: parents before children.
        frame_time: as written.
        frames: (T, C) float64, one column a channel, in the file's units.
        renamed: names that had to be changed, to what the file calls them.
    """

    joints: list[ParsedJoint]
    frame_time: str
    frames: np.ndarray
    renamed: dict[str, str]


def parse_bvh(path: Path) -> ParsedBvh:
    """Take a file apart.

    Raises:
        FormatError: missing, no BVH, broken, or cut short; the message names file and line.
    """
    try:
        try:
            return _parse(path, "utf-8-sig")
        except UnicodeDecodeError:
            return _parse(path, "latin-1")
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None


def _parse(path: Path, encoding: str) -> ParsedBvh:
    # newline=None takes all three line ends: \n, \r\n, and the \r of old Macs.
    with path.open(encoding=encoding, newline=None) as stream:
        reader = _Lines(stream, path)
        lines = iter(reader)
        if (first := next(lines, "").upper()) != "HIERARCHY":
            what = "is empty" if not reader.number else f"begins with {first[:40]!r}"
            raise reader.error(f"the file {what}; a BVH file begins with HIERARCHY")
        joints, renamed = _parse_hierarchy(lines, reader)
        n_frames, frame_time = _parse_timing(lines, reader)
        n_channels = sum(len(joint.channels) for joint in joints)
        frames = _parse_frames(lines, reader, n_frames, n_channels)
    return ParsedBvh(joints, frame_time, frames, renamed)


class _Lines:
    """Lines of a file that are not blank, and where we are."""

    def __init__(self, stream: TextIO, path: Path) -> None:
        self.stream = stream
        self.path = path
        self.number = 0

    def __iter__(self) -> Iterator[str]:
        while line := self.stream.readline(_LONGEST_LINE):
            self.number += 1
            if len(line) >= _LONGEST_LINE:
                raise self.error(f"a line of over {_LONGEST_LINE} characters; this is no BVH file")
            if line := line.strip():
                yield line

    def error(self, message: str) -> FormatError:
        return FormatError(f"{self.path}:{self.number}: {message}")


def _parse_hierarchy(
    lines: Iterator[str], reader: _Lines
) -> tuple[list[ParsedJoint], dict[str, str]]:
    joints: list[ParsedJoint] = []
    renamed: dict[str, str] = {}
    taken: set[str] = set()
    open_blocks: list[int | None] = []  # index of the joint, None for an end site
    opening: int | None | str = "nothing"  # what the next { opens
    for statement in _statements(lines):
        word, _, rest = statement.partition(" ")
        keyword = word.upper()
        inside = open_blocks[-1] if open_blocks else None
        if keyword == "{":
            if opening == "nothing":
                raise reader.error("a { that opens no joint")
            open_blocks.append(opening)
            opening = "nothing"
            continue
        if opening != "nothing":
            raise reader.error(f"expected {{ after the name of a joint, found {statement[:40]!r}")
        if keyword == "}":
            if not open_blocks:
                raise reader.error("a } too many")
            open_blocks.pop()
        elif keyword == "MOTION":
            if open_blocks:
                raise reader.error(f"MOTION while {len(open_blocks)} joints lack their }}")
            break
        elif keyword in ("ROOT", "JOINT"):
            if keyword == "ROOT" and joints:
                raise reader.error(
                    f"a second ROOT, {rest!r} (the first is {joints[0].name!r}); "
                    "export one skeleton a file"
                )
            if keyword == "JOINT" and inside is None:
                raise reader.error(f"JOINT {rest!r} hangs on no joint")
            if len(joints) >= _MOST_JOINTS:
                raise reader.error(f"over {_MOST_JOINTS} joints")
            name = rest.strip() or f"joint{len(joints)}"
            unique, n = name, 1
            while unique in taken:
                n += 1
                unique = f"{name}_{n}"
            if unique != name:
                renamed[unique] = name
            taken.add(unique)
            opening = len(joints)
            joints.append(ParsedJoint(unique, -1 if inside is None else inside, reader.number))
        elif keyword == "END":
            if inside is None:
                raise reader.error("an End Site that hangs on no joint")
            opening = None
        elif keyword == "OFFSET":
            offset = _three_numbers(rest, reader)
            if open_blocks and open_blocks[-1] is None:
                joints[open_blocks[-2]].ends.append(offset)
            elif inside is not None:
                joints[inside].offset = offset
            else:
                raise reader.error("an OFFSET outside any joint")
        elif keyword == "CHANNELS":
            if inside is None:
                raise reader.error("CHANNELS outside any joint")
            joints[inside].channels = _parse_channels(rest, reader)
        else:
            raise reader.error(f"{statement[:40]!r} is nothing that a BVH hierarchy holds")
    else:
        raise reader.error("the file stops before MOTION")
    if not joints:
        raise reader.error("no ROOT before MOTION")
    for joint in joints:
        if joint.offset is None:
            raise FormatError(f"{reader.path}:{joint.line}: joint {joint.name!r} has no OFFSET")
    return joints, renamed


def _statements(lines: Iterator[str]) -> Iterator[str]:
    """Statements of the hierarchy; braces may stand on lines of their own or not."""
    for line in lines:
        for part in line.replace("{", "\n{\n").replace("}", "\n}\n").split("\n"):
            if part := " ".join(part.split()):
                yield part


def _three_numbers(text: str, reader: _Lines) -> tuple[float, float, float]:
    try:
        x, y, z = (float(word) for word in text.split())
    except ValueError:
        raise reader.error(f"OFFSET {text[:60]!r}; expected three numbers") from None
    if not np.isfinite([x, y, z]).all():
        raise reader.error(f"OFFSET {text[:60]!r} is not finite")
    return x, y, z


def _parse_channels(text: str, reader: _Lines) -> list[str]:
    """As "Xp" and "Zr", in the file's order."""
    count, *names = text.split() or [""]
    if not count.isdecimal() or int(count) != len(names):
        raise reader.error(f"CHANNELS {text[:80]!r}: a count of {count!r} for {len(names)} names")
    channels = []
    for name in names:
        axis, kind = name[:1].upper(), name[1:].lower()
        if axis not in ("X", "Y", "Z") or kind not in ("position", "rotation"):
            raise reader.error(f"channel {name[:40]!r}; expected Xposition ... Zrotation")
        channels.append(axis + kind[0])
    if len(set(channels)) != len(channels):
        raise reader.error(f"CHANNELS {text[:80]!r} names a channel twice")
    return channels


def _parse_timing(lines: Iterator[str], reader: _Lines) -> tuple[int, str]:
    n_frames = frame_time = None
    while n_frames is None or frame_time is None:
        key, colon, value = next(lines, "").partition(":")
        key, value = " ".join(key.upper().split()), value.strip()
        if key == "FRAMES" and colon:
            if not value.isdecimal():
                raise reader.error(f"Frames: {value[:40]!r}; expected a whole number")
            n_frames = int(value)
        elif key == "FRAME TIME" and colon:
            frame_time = value
        else:
            missing = "Frames:" if n_frames is None else "Frame Time:"
            raise reader.error(f"expected {missing!r} after MOTION, found {key[:40]!r}")
    if n_frames == 0:
        raise reader.error("the file holds no frame (Frames: 0)")
    return n_frames, frame_time


def _parse_frames(
    lines: Iterator[str], reader: _Lines, n_frames: int, n_channels: int
) -> np.ndarray:
    rows = []
    for line in lines:
        if len(rows) == n_frames:
            raise reader.error(f"more rows than the {n_frames} that `Frames:` declares")
        try:
            # Faster than numpy's own parsers of text.
            row = np.array([float(word) for word in line.split()])
        except ValueError:
            raise reader.error(_bad_number(line)) from None
        if "_" in line:  # which float() passes over
            raise reader.error(_bad_number(line))
        if len(row) != n_channels:
            raise reader.error(
                f"frame {len(rows) + 1} of {n_frames} has {len(row)} values; the channels "
                f"need {n_channels}" + (" (is the file cut short?)" * (len(row) < n_channels))
            )
        if not np.isfinite(row).all():
            bad = int(np.flatnonzero(~np.isfinite(row))[0])
            raise reader.error(f"value {bad + 1} of frame {len(rows) + 1} is {row[bad]}")
        rows.append(row)
    if len(rows) < n_frames:
        raise reader.error(
            f"the file holds {len(rows)} frames but declares {n_frames}; it was cut short, or "
            "`Frames:` is wrong"
        )
    return np.stack(rows)


def _bad_number(line: str) -> str:
    """What to say of a line of which not every word is a number."""
    for word in line.split():
        try:
            float(word)
        except ValueError:
            hint = "; decimals need a point" if "," in word else ""
            return f"{word[:40]!r} is no number{hint}"
    return f"{line[:40]!r}: numbers hold no underscore"
