"""Parser of BVH files: syntax and its checks, without interpretation."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TextIO

import numpy as np

from gesturekit.errors import FormatError
from gesturekit.formats.registry import kind_by_content
from gesturekit.motion.resampling import COMMON_RATES
from gesturekit.motion.skeleton import unique_names

_NTSC = Decimal("1.001")


def frame_rate(text: str) -> float:
    """Return the frames per second of a `Frame Time` in seconds, which is often rounded.

    Raises:
        ValueError: not a number, or outside 0.00001 to 100000 s.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = Decimal("nan")
    if not seconds.is_finite() or not Decimal("1e-5") <= seconds <= 100_000:
        raise ValueError(f"Frame Time: {text[:40]!r} s; expected 0.00001 to 100000")
    whole = round(1 / seconds)
    common = min(COMMON_RATES, key=lambda rate: abs(1 / Decimal(rate) - seconds))
    # The most likely rate whose frame time differs by less than the last digit written.
    digit = Decimal(1).scaleb(int(seconds.as_tuple().exponent))
    exact = (1 / seconds).quantize(Decimal("0.01"))  # such as 12.5
    rates = (
        (whole, digit / 1000),
        (common, digit),
        (exact, Decimal("1e-20")),
        (whole, digit),
        (whole / _NTSC, digit),
    )
    for rate, tolerance in rates:
        if rate and abs(1 / Decimal(rate) - seconds) < tolerance:
            return float(rate)
    # All digits of a float64: several rates may have this quotient, so take the most likely, or
    # else the one with the fewest digits.
    shorter = (float(f"{1 / seconds:.{digits}g}") for digits in range(1, 17))
    for rate in (*(float(rate) for rate, _ in rates if rate), *shorter):
        if 1 / rate == float(seconds):
            return rate
    return float(1 / seconds)


UNIT_MARKS = {
    "m": "0.000000 0.0000000 0.00000000",
    "cm": "0.000000 0.00000000 0.0000000",
    "mm": "0.0000000 0.000000 0.00000000",
    "inch": "0.0000000 0.00000000 0.000000",
    "cmu": "0.00000000 0.000000 0.0000000",
}
"""OFFSET of the root in files that we write, which have Y up and +Z forward, by their unit.

BVH has no field for the unit, and some readers fail on comments or blank lines. Every reader sees
0 0 0; no other program writes three zeros with different numbers of decimals. The mark survives
changed line ends, indentation and trailing spaces. A program that rewrites the file formats the
zeros in its own way; unit and axes are then detected as in any other file."""

_MOST_JOINTS = 2000
_BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}


@dataclass
class ParsedJoint:
    """ROOT or JOINT as written, or an End Site that has channels.

    Attributes:
        name: unique; a number is added to a repeated name.
        parent: index of the parent joint, -1 for the root.
        is_end: true if the file calls it an End Site.
        offset: OFFSET in the file's unit.
        channels: "Xp" for Xposition, "Zr" for Zrotation, ..., in the file's order.
        ends: OFFSETs of its end sites.
    """

    name: str
    parent: int
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
        unit: unit of our mark, see `UNIT_MARKS`; None in files of other programs.
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
        kind = kind_by_content(start)
        if kind not in (None, "a BVH file"):
            raise FormatError(f"{path}:1: {kind} inside; a BVH file begins with HIERARCHY")
        try:
            return _parse(path, _BYTE_ORDER_MARKS.get(start[:2], "utf-8-sig"), fps)
        except UnicodeError:
            return _parse(path, "latin-1", fps)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None


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
        joints = _fold_ends(blocks)
        renamed: dict[str, str] = {}
        for joint, name in zip(joints, unique_names([joint.name for joint in joints])):
            if name != joint.name:
                renamed[name], joint.name = joint.name, name
        n_frames, frame_time, fps = _parse_timing(lines, fps)
        n_channels = sum(len(joint.channels) for joint in joints)
        if not n_channels:
            raise lines.error("no joint has CHANNELS: the file holds no motion")
        frames = parse_rows(lines, n_frames, n_channels)
    if lines.has_decimal_commas:
        warnings.warn(f"{path}: its decimal commas are read as points", stacklevel=2)
    return ParsedBvh(joints, frame_time, fps, frames, renamed, unit)


def _parse_hierarchy(lines: Lines) -> tuple[list[ParsedJoint], str | None]:
    """Return all blocks in the file's order, end sites included, and the unit of our mark."""
    units = {mark: unit for unit, mark in UNIT_MARKS.items()}
    blocks: list[ParsedJoint] = []
    unit = None
    open_blocks: list[int] = []
    is_named = False  # a joint whose { must follow
    for statement in _statements(lines):
        word, _, rest = statement.partition(" ")
        keyword = word.upper()
        inside = blocks[open_blocks[-1]] if open_blocks else None
        if is_named != (keyword == "{"):
            why = "a { follows ROOT, JOINT and End Site, and nothing else does"
            raise lines.error(f"{why}; found {statement[:40]!r}")
        if keyword == "{":
            open_blocks.append(len(blocks) - 1)
            is_named = False
        elif keyword == "}":
            if inside is None:
                raise lines.error("a } without its {")
            if inside.offset is None and not inside.is_end:
                raise lines.error(f"joint {inside.name!r} has no OFFSET")
            open_blocks.pop()
        elif keyword == "MOTION":
            break
        elif keyword in ("ROOT", "JOINT", "END", "ENDSITE"):
            parent = open_blocks[-1] if open_blocks else -1
            blocks.append(_block(keyword, rest, parent, blocks, lines))
            is_named = True
        elif keyword == "OFFSET" and inside:
            inside.offset = _three_numbers(rest, lines)
            if inside is blocks[0]:
                unit = units.get(rest)
        elif keyword == "CHANNELS" and inside:
            inside.channels = _parse_channels(rest, lines)
        else:
            where = "in a joint" if inside else "outside any joint"
            raise lines.error(f"{statement[:40]!r} is not a statement of a BVH hierarchy {where}")
    else:
        raise lines.error("the file stops before MOTION")
    if open_blocks:
        raise lines.error(f"MOTION while {len(open_blocks)} joints lack their }}")
    if not blocks:
        raise lines.error("no ROOT before MOTION")
    return blocks, unit


def _block(
    keyword: str, rest: str, parent: int, blocks: list[ParsedJoint], lines: Lines
) -> ParsedJoint:
    if keyword == "ROOT" and blocks:
        raise lines.error(f"a second ROOT, {rest[:40]!r}, after {blocks[0].name!r}: export one rig")
    if keyword != "ROOT" and parent < 0:
        raise lines.error(f"{keyword} {rest[:40]!r} has no parent joint")
    if len(blocks) >= _MOST_JOINTS:
        raise lines.error(f"over {_MOST_JOINTS} joints")
    if is_end := keyword.startswith("END"):
        rest = f"{blocks[parent].name}_End"
    return ParsedJoint(rest or f"joint{len(blocks)}", parent, is_end)


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
            block.offset = block.offset or (0.0, 0.0, 0.0)
            index[number] = len(joints)
            joints.append(block)
    return joints


def _statements(lines: Lines) -> Iterator[str]:
    """Yield the statements of the hierarchy; braces may share a line with others."""
    while line := lines.next():
        for text in line.replace("{", "\n{\n").replace("}", "\n}\n").split("\n"):
            if statement := " ".join(text.split()):
                yield statement


def _three_numbers(text: str, lines: Lines) -> tuple[float, float, float]:
    try:
        x, y, z = (float(word) for word in lines.with_points(text).split())
    except ValueError:
        x = y = z = math.nan
    if not all(abs(value) <= LARGEST for value in (x, y, z)):
        raise lines.error(f"OFFSET {text[:60]!r}; expected three numbers up to {LARGEST:g}")
    return x, y, z


def _parse_channels(text: str, lines: Lines) -> list[str]:
    """Return channels as "Xp" and "Zr", in the file's order."""
    count, *names = text.split() or [""]
    if count != str(len(names)):
        raise lines.error(f"CHANNELS {text[:80]!r}: count {count[:9]!r} for {len(names)} names")
    channels = []
    for name in names:
        axis, kind = name[:1].upper(), name[1:].lower()
        if axis not in ("X", "Y", "Z") or kind not in ("position", "rotation"):
            raise lines.error(f"channel {name[:40]!r}; expected Xposition ... Zrotation")
        channels.append(axis + kind[0])
    if len(set(channels)) != len(channels):
        raise lines.error(f"CHANNELS {text[:80]!r} names a channel twice")
    return channels


def _parse_timing(lines: Lines, fps: float | None) -> tuple[int, str, float]:
    n_frames = frame_time = None
    while n_frames is None or frame_time is None or fps is None:
        line = lines.next()
        key, value = re.findall(r"(?i)(frames|frame\s+time|)\s*:?\s*(.*)", line)[0]
        if key.upper() == "FRAMES":
            if not re.fullmatch(r"\d{1,18}", value):
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


LONGEST_LINE = 1 << 20
"""Most characters in a line of a BVH file."""

LARGEST = 1e9
"""Largest plausible offset, position or angle; larger ones could overflow."""

_BLOCK = 1 << 21  # characters read at a time
_DECIMAL_COMMA = re.compile(r"(?<=[0-9]),(?=[0-9])")


class Lines:
    """Text file with a line number for error messages.

    Attributes:
        has_decimal_commas: True once `with_points` has replaced one.
    """

    def __init__(self, stream: TextIO, path: object) -> None:
        self.stream = stream
        self.path = path
        self.number = 0
        self.has_decimal_commas = False

    def next(self) -> str:
        """Return the next line that is not blank, stripped; "" at the end of the file."""
        while line := self.stream.readline(LONGEST_LINE):
            self.number += 1
            if len(line) >= LONGEST_LINE:
                raise self.error(f"a line of over {LONGEST_LINE} characters; not a BVH file")
            if line := line.strip():
                return line
        return ""

    def with_points(self, text: str) -> str:
        """Return numbers with decimal points in the place of decimal commas."""
        if "," not in text:
            return text
        text, count = _DECIMAL_COMMA.subn(".", text)
        self.has_decimal_commas |= count > 0
        return text

    def error(self, message: str, line: int | None = None) -> FormatError:
        """Return an error about the current line, or about line number `line`."""
        return FormatError(f"{self.path}:{line or self.number}: {message}")


def parse_rows(lines: Lines, n_frames: int, n_channels: int) -> np.ndarray:
    """(T, n_channels) float64, one line per frame, to the end of the file.

    T is `n_frames` or, with a warning, as many as the file has. A last line that is incomplete, in
    a file with fewer frames than it declares, is left out.

    Raises:
        FormatError: no rows, too few or too many values, or a value that is not a finite number.
    """
    blocks: list[np.ndarray] = []
    n_rows, rest, ending = 0, "", ""
    while True:
        read = lines.stream.read(_BLOCK)
        text = rest + read
        # The last line is parsed at the end of the file: it may have been cut.
        end = text.rstrip().rfind("\n") + 1 if read else len(text)
        text, rest = text[:end], text[end:]
        if len(rest.rstrip()) >= LONGEST_LINE:
            lines.number += text.count("\n") + 1
            raise lines.error(f"a line of over {LONGEST_LINE} characters; not a BVH file")
        if not read and n_rows and _is_cut(text, n_frames - n_rows, n_channels):
            text, ending = "", ", and its last line is incomplete"
        text = lines.with_points(text)
        values = _bulk(text, n_channels)
        if values is None:
            values = _line_by_line(text, lines, n_rows, n_frames, n_channels)
        n_rows += len(values)
        blocks.append(values)
        lines.number += text.count("\n")
        if not read:
            break
    if not n_rows:
        raise lines.error(f"the file declares {n_frames} frames and holds none")
    if n_rows != n_frames:
        held = f"; all {n_rows} that it holds are read"
        if n_rows < n_frames:
            held = f" and holds {n_rows}{ending}: it was probably cut short"
        warnings.warn(f"{lines.path}: the file declares {n_frames} frames{held}", stacklevel=2)
    return np.concatenate(blocks)


def _is_cut(line: str, missing: int, n_channels: int) -> bool:
    """Return whether the file seems to end within its last line.

    Args:
        line: the last line.
        missing: rows that are missing without this line.
        n_channels: values that it needs.
    """
    is_short = 0 < len(line.split()) < n_channels
    # The last number may have lost digits if more rows should follow.
    return missing > 0 and (is_short or (missing > 1 and bool(line) and not line.endswith("\n")))


def _bulk(text: str, n_channels: int) -> np.ndarray | None:
    """(R, C) rows of `text` from numpy's parser; None if a row is unusual or wrong."""
    if not text.strip():
        return np.empty((0, n_channels))
    try:
        values = np.loadtxt(text.split("\n"), comments=None, ndmin=2)
    except ValueError:
        return None
    if values.shape[1] != n_channels or not (np.abs(values) <= LARGEST).all():
        return None
    return values


def _line_by_line(
    text: str, lines: Lines, n_before: int, n_frames: int, n_channels: int
) -> np.ndarray:
    """(R, C) rows like those of `_bulk`; raise FormatError with the line of a wrong one."""
    rows: list[list[float]] = []
    for index, line in enumerate(text.split("\n")):
        words = line.split()
        if not words:
            continue
        number, frame = lines.number + index + 1, n_before + len(rows) + 1
        row = [_number(word, lines, number) for word in words]
        if len(row) != n_channels:
            cut = " (is the file cut short?)" if len(row) < n_channels else ""
            held = f"has {len(row)} values; the channels need {n_channels}{cut}"
            raise lines.error(f"frame {frame} of {n_frames} {held}", number)
        for column, value in enumerate(row, start=1):
            if not abs(value) <= LARGEST:
                hint = "" if value == value else "; fill the gap where the file was exported"
                need = f"expected a finite number up to {LARGEST:g}{hint}"
                raise lines.error(f"value {column} of frame {frame} is {value}; {need}", number)
        rows.append(row)
    return np.array(rows).reshape(-1, n_channels)


def _number(word: str, lines: Lines, line: int) -> float:
    try:
        if "_" not in word:  # which float() passes over
            return float(word)
    except ValueError:
        pass
    raise lines.error(f"{word[:40]!r} is not a number", line)
