"""Fast parser of the frames of a BVH file."""

from __future__ import annotations

import itertools
from typing import TextIO

import numpy as np

from gesturekit.errors import FormatError

LONGEST_LINE = 1 << 20
"""Most characters in a line of a BVH file."""

LARGEST = 1e9
"""Largest plausible offset, position or angle; larger ones could overflow."""

_BLOCK = 1 << 21  # characters read at a time


class Lines:
    """Text file with a line number for error messages."""

    def __init__(self, stream: TextIO, path: object) -> None:
        self.stream = stream
        self.path = path
        self.number = 0

    def next(self) -> str:
        """Return the next line that is not blank, stripped; "" at the end of the file."""
        while line := self.stream.readline(LONGEST_LINE):
            self.number += 1
            if len(line) >= LONGEST_LINE:
                raise self.error(f"a line of over {LONGEST_LINE} characters; not a BVH file")
            if line := line.strip():
                return line
        return ""

    def error(self, message: str, line: int | None = None) -> FormatError:
        """Return an error about the current line, or about line number `line`."""
        return FormatError(f"{self.path}:{line or self.number}: {message}")


def parse_rows(lines: Lines, n_frames: int, n_channels: int) -> np.ndarray:
    """(n_frames, n_channels) float64, one line per frame, to the end of the file.

    Raises:
        FormatError: too few or too many rows or values, or a value that is not a finite number.
    """
    blocks: list[np.ndarray] = []
    n_rows, rest = 0, ""
    while True:
        read = lines.stream.read(_BLOCK)
        text = rest + read
        end = text.rfind("\n") + 1 if read else len(text)
        text, rest = text[:end], text[end:]
        if len(rest) >= LONGEST_LINE:
            lines.number += text.count("\n") + 1
            raise lines.error(f"a line of over {LONGEST_LINE} characters; not a BVH file")
        values = _bulk(text, n_channels)
        if values is None:
            values = _line_by_line(text, lines, n_rows, n_frames, n_channels)
        if n_rows + len(values) > n_frames:
            raise lines.error(
                f"more rows than the {n_frames} that `Frames:` declares; correct `Frames:`, or "
                "delete the rows that do not belong to it",
                lines.number + _line_of_row(text, n_frames - n_rows) + 1,
            )
        n_rows += len(values)
        blocks.append(values)
        lines.number += text.count("\n")
        if not read:
            lines.number += bool(text)
            break
    if n_rows < n_frames:
        raise lines.error(
            f"the file holds {n_rows} frames but declares {n_frames}; it was cut short, or "
            "`Frames:` is wrong"
        )
    return np.concatenate(blocks)


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


def _line_of_row(text: str, row: int) -> int:
    """Return the index of the line of a row; blank lines are not rows."""
    filled = (index for index, line in enumerate(text.split("\n")) if line.strip())
    return next(itertools.islice(filled, row, None))


def _line_by_line(
    text: str, lines: Lines, n_before: int, n_frames: int, n_channels: int
) -> np.ndarray:
    """(R, C) rows like those of `_bulk`; raise FormatError with the line of a wrong one."""
    rows = []
    for index, line in enumerate(text.split("\n")):
        words = line.split()
        if not words:
            continue
        number, frame = lines.number + index + 1, n_before + len(rows) + 1
        row = [_number(word, lines, number) for word in words]
        if len(row) != n_channels:
            raise lines.error(
                f"frame {frame} of {n_frames} has {len(row)} values; the channels need "
                f"{n_channels}" + (" (is the file cut short?)" * (len(row) < n_channels)),
                number,
            )
        for column, value in enumerate(row, start=1):
            if not abs(value) <= LARGEST:
                hint = "" if value == value else "; fill the gap where the file was exported"
                raise lines.error(
                    f"value {column} of frame {frame} is {value}; expected a finite number up to "
                    f"{LARGEST:g}{hint}",
                    number,
                )
        rows.append(row)
    return np.array(rows).reshape(-1, n_channels)


def _number(word: str, lines: Lines, line: int) -> float:
    try:
        if "_" not in word:  # which float() passes over
            return float(word)
    except ValueError:
        pass
    hint = "; decimals need a point" if "," in word else ""
    raise lines.error(f"{word[:40]!r} is not a number{hint}", line)
