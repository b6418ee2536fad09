"""Parser of BVH files: syntax and its checks, without interpretation."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gesturekit.errors import FormatError
from gesturekit.formats.bvh.mark import marked_unit
from gesturekit.formats.bvh.rows import LARGEST, Lines, parse_rows
from gesturekit.formats.frame_rate import frame_rate
from gesturekit.formats.signatures import kind_by_content
from gesturekit.motion.skeleton import LONGEST_NAME, unique_names

_MOST_JOINTS = 2000
_NOTHING = -2  # value of `opening` if the next { opens no joint
_BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}


@dataclass
class ParsedJoint:
    """ROOT or JOINT as written, or an End Site that has channels.

    Attributes:
        name: unique; a number is added to a repeated name.
        parent: index of the parent joint, -1 for the root.
        line: line number of its beginning.
        is_end: true if the file calls it an End Site.
        offset: OFFSET in the file's unit.
        channels: "Xp" for Xposition, "Zr" for Zrotation, ..., in the file's order.
        ends: OFFSETs of its end sites.
    """

    name: str
    parent: int
    line: int
    is_end: bool = False
    offset: tuple[float, float, float] | None = None
    channels: list[str] = field(default_factory=list)
    ends: list[tuple[float, float, float]] = field(default_factory=list)


@dataclass
class ParsedBvh:
    """Content of a BVH file.

    Attributes:
        joints: parents before children.
        frame_time: Frame Time as written.
        fps: frames per second.
        frames: (T, C) float64, one column per channel, in the file's units.
        renamed: new name to name in the file, for names that had to be changed.
        unit: unit of our mark, see `mark`; None in files of other programs.
    """

    joints: list[ParsedJoint]
    frame_time: str
    fps: float
    frames: np.ndarray
    renamed: dict[str, str]
    unit: str | None


def parse_bvh(path: Path, fps: float | None = None) -> ParsedBvh:
    """Parse a file.

    Args:
        path: the file.
        fps: frames per second in place of `Frame Time`, which may then be anything.

    Raises:
        FormatError: missing, not a BVH file, or broken; the message names file and line.
    """
    try:
        with path.open("rb") as stream:
            start = stream.read(16)
        _refuse_others(path, start)
        encoding = _BYTE_ORDER_MARKS.get(start[:2], "utf-8-sig")
        try:
            return _parse(path, encoding, fps)
        except UnicodeError:
            return _parse(path, "latin-1", fps)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None


def _refuse_others(path: Path, start: bytes) -> None:
    what = kind_by_content(start)
    if what is not None and not start.startswith(b"HIERARCHY"):
        raise FormatError(
            f"{path}:1: the file looks like {what} inside; a BVH file begins with HIERARCHY"
        )


def _parse(path: Path, encoding: str, fps: float | None) -> ParsedBvh:
    # newline=None takes all three line ends: \n, \r\n, and the \r of old Macs.
    with path.open(encoding=encoding, newline=None) as stream:
        lines = Lines(stream, path)
        first = lines.next()
        if not first:
            raise FormatError(f"{path}: the file is empty; a BVH file begins with HIERARCHY")
        if first.upper() != "HIERARCHY":
            what = ascii(first[:20])
            raise lines.error(f"the first line is {what}; that of a BVH file is HIERARCHY")
        blocks, unit = _parse_hierarchy(lines)
        joints, renamed = _name_apart(_fold_ends(blocks))
        n_frames, frame_time, fps = _parse_timing(lines, fps)
        n_channels = sum(len(joint.channels) for joint in joints)
        if not n_channels:
            raise lines.error("no joint has CHANNELS: the file holds no motion")
        frames = parse_rows(lines, n_frames, n_channels)
    if lines.has_decimal_commas:
        warnings.warn(f"{path}: its decimal commas are read as points", stacklevel=2)
    return ParsedBvh(joints, frame_time, fps, frames, renamed, unit)


# The hierarchy


def _parse_hierarchy(lines: Lines) -> tuple[list[ParsedJoint], str | None]:
    """Return all blocks in the file's order, end sites included, and the unit of our mark."""
    blocks: list[ParsedJoint] = []
    unit = None
    open_blocks: list[int] = []
    opening = _NOTHING
    for statement in _statements(lines):
        word, _, rest = statement.partition(" ")
        keyword = word.upper()
        inside = blocks[open_blocks[-1]] if open_blocks else None
        if keyword == "{":
            if opening == _NOTHING:
                raise lines.error("a { that does not follow ROOT, JOINT or End Site")
            open_blocks.append(opening)
            opening = _NOTHING
        elif opening != _NOTHING:
            raise lines.error(f"expected {{ after the name of a joint, found {statement[:40]!r}")
        elif keyword == "}":
            if not open_blocks:
                raise lines.error("a } without its {")
            open_blocks.pop()
        elif keyword == "MOTION":
            if open_blocks:
                raise lines.error(f"MOTION while {len(open_blocks)} joints lack their }}")
            break
        elif keyword in ("ROOT", "JOINT", "END", "ENDSITE"):
            parent = open_blocks[-1] if open_blocks else -1
            opening = len(blocks)
            blocks.append(_block(keyword, rest, parent, blocks, lines))
        elif keyword == "OFFSET" and inside:
            inside.offset = _three_numbers(rest, lines)
            if inside is blocks[0]:
                unit = marked_unit(rest)
        elif keyword == "CHANNELS" and inside:
            inside.channels = _parse_channels(rest, lines)
        elif keyword in ("OFFSET", "CHANNELS"):
            raise lines.error(f"{keyword} outside any joint")
        else:
            raise lines.error(f"{statement[:40]!r} is not a statement of a BVH hierarchy")
    else:
        raise lines.error("the file stops before MOTION")
    if not blocks:
        raise lines.error("no ROOT before MOTION")
    for block in blocks:
        if block.offset is None:
            if not block.is_end:
                raise lines.error(f"joint {block.name!r} has no OFFSET", block.line)
            block.offset = (0.0, 0.0, 0.0)
    return blocks, unit


def _block(
    keyword: str, rest: str, parent: int, blocks: list[ParsedJoint], lines: Lines
) -> ParsedJoint:
    if keyword == "ROOT" and blocks:
        raise lines.error(
            f"a second ROOT, {rest[:40]!r} (the first is {blocks[0].name!r}); "
            "export one skeleton a file"
        )
    if keyword != "ROOT" and parent < 0:
        raise lines.error(f"{keyword} {rest[:40]!r} has no parent joint")
    if len(blocks) >= _MOST_JOINTS:
        raise lines.error(f"over {_MOST_JOINTS} joints")
    if len(rest) > LONGEST_NAME:
        raise lines.error(
            f"a joint name of {len(rest)} characters; over {LONGEST_NAME} means that the file is "
            "damaged"
        )
    if not rest.isprintable():
        raise lines.error(f"joint name {rest[:40]!r} holds characters that cannot be shown")
    if is_end := keyword.startswith("END"):
        rest = f"{blocks[parent].name}_End"
    return ParsedJoint(rest or f"joint{len(blocks)}", parent, lines.number, is_end)


def _fold_ends(blocks: list[ParsedJoint]) -> list[ParsedJoint]:
    """Return the joints; end sites without channels or children become `ends` of their parent."""
    bears = {block.parent for block in blocks}
    joints: list[ParsedJoint] = []
    index: dict[int, int] = {-1: -1}
    for number, block in enumerate(blocks):
        block.parent = index[block.parent]
        if block.is_end and block.offset and not block.channels and number not in bears:
            joints[block.parent].ends.append(block.offset)
        else:
            index[number] = len(joints)
            joints.append(block)
    return joints


def _name_apart(joints: list[ParsedJoint]) -> tuple[list[ParsedJoint], dict[str, str]]:
    """Return the joints with unique names, and new name to name in the file."""
    renamed: dict[str, str] = {}
    for joint, name in zip(joints, unique_names([joint.name for joint in joints])):
        if name != joint.name:
            renamed[name], joint.name = joint.name, name
    return joints, renamed


def _statements(lines: Lines) -> Iterator[str]:
    """Yield the statements of the hierarchy; braces may share a line with others."""
    while line := lines.next():
        for part in line.replace("{", "\n{\n").replace("}", "\n}\n").split("\n"):
            if part := " ".join(part.split()):
                yield part


def _three_numbers(text: str, lines: Lines) -> tuple[float, float, float]:
    try:
        x, y, z = (float(word) for word in lines.with_points(text).split())
    except ValueError:
        raise lines.error(f"OFFSET {text[:60]!r}; expected three numbers") from None
    if not all(abs(value) <= LARGEST for value in (x, y, z)):
        raise lines.error(f"OFFSET {text[:60]!r} is not finite, or over {LARGEST:g}")
    return x, y, z


def _parse_channels(text: str, lines: Lines) -> list[str]:
    """Return channels as "Xp" and "Zr", in the file's order."""
    count, *names = text.split() or [""]
    if not count.isdecimal() or int(count[:9]) != len(names):
        raise lines.error(
            f"CHANNELS {text[:80]!r}: a count of {count[:9]!r} for {len(names)} names"
        )
    channels = []
    for name in names:
        axis, kind = name[:1].upper(), name[1:].lower()
        if axis not in ("X", "Y", "Z") or kind not in ("position", "rotation"):
            raise lines.error(f"channel {name[:40]!r}; expected Xposition ... Zrotation")
        channels.append(axis + kind[0])
    if len(set(channels)) != len(channels):
        raise lines.error(f"CHANNELS {text[:80]!r} names a channel twice")
    return channels


# The head of the motion


def _parse_timing(lines: Lines, fps: float | None) -> tuple[int, str, float]:
    n_frames = frame_time = None
    while n_frames is None or frame_time is None or fps is None:
        line = lines.next()
        key, value = re.findall(r"(?i)(frames|frame\s+time|)\s*:?\s*(.*)", line)[0]
        if key.upper() == "FRAMES":
            if not value.isdecimal() or len(value) > 18:
                raise lines.error(f"Frames: {value[:40]!r}; expected a whole number")
            n_frames = int(value)
        elif key:
            frame_time = lines.with_points(value)
            try:
                fps = frame_rate(frame_time) if fps is None else fps
            except ValueError as error:
                raise lines.error(f"{error}; --in-fps RATE sets the rate") from None
        else:
            missing = "Frames:" if n_frames is None else "Frame Time:"
            raise lines.error(f"expected {missing!r} after MOTION, found {line[:40]!r}")
    return n_frames, frame_time, fps
