"""Fast parser of the frames of a BVH file."""

from __future__ import annotations

import re
import warnings
from typing import TextIO

import numpy as np

from gesturekit.errors import FormatError

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
    if n_rows < n_frames:
        warnings.warn(
            f"{lines.path}: the file declares {n_frames} frames and holds {n_rows}{ending}: "
            "it was probably cut short",
            stacklevel=2,
        )
    elif n_rows > n_frames:
        warnings.warn(
            f"{lines.path}: the file declares {n_frames} frames; all {n_rows} that it holds are "
            "read",
            stacklevel=2,
        )
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
    raise lines.error(f"{word[:40]!r} is not a number", line)
