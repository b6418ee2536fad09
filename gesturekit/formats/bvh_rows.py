"""The frames of a BVH file: millions of numbers in rows, read in bulk."""

from __future__ import annotations

import warnings
from typing import TextIO

import numpy as np

from gesturekit.errors import FormatError

LONGEST_LINE = 1 << 20
"""Characters; what has longer lines is no BVH file."""

LARGEST = 1e9
"""Offsets, positions and angles beyond this are damage, and would overflow further on."""

_BLOCK = 1 << 21  # characters read at a time
_POWERS_OF_TEN = 10.0 ** np.arange(23)  # those that a float64 holds exactly


class Lines:
    """A text file, where we are in it, and errors that say so."""

    def __init__(self, stream: TextIO, path: object) -> None:
        self.stream = stream
        self.path = path
        self.number = 0

    def next(self) -> str:
        """The next line that is not blank, stripped; "" at the end of the file."""
        while line := self.stream.readline(LONGEST_LINE):
            self.number += 1
            if len(line) >= LONGEST_LINE:
                raise self.error(f"a line of over {LONGEST_LINE} characters; this is no BVH file")
            if line := line.strip():
                return line
        return ""

    def error(self, message: str, line: int | None = None) -> FormatError:
        """Say what is wrong in the current line, or in line number `line`."""
        return FormatError(f"{self.path}:{line or self.number}: {message}")


def parse_rows(lines: Lines, n_frames: int, n_channels: int) -> np.ndarray:
    """(n_frames, n_channels) float64, one line a frame, to the end of the file.

    Raises:
        FormatError: too few or too many rows or values, or what is no finite number.
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
            raise lines.error(f"a line of over {LONGEST_LINE} characters; this is no BVH file")
        values, at = _bulk(text, n_channels) or _line_by_line(
            text, lines, n_rows, n_frames, n_channels
        )
        n_rows += len(values)
        if n_rows > n_frames:
            surplus = at[len(values) - (n_rows - n_frames)]
            raise lines.error(
                f"more rows than the {n_frames} that `Frames:` declares",
                lines.number + int(surplus) + 1,
            )
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


def _bulk(text: str, n_channels: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows (R, C) and the line (R,) of `text` that each stands in; None where one is not plain."""
    try:
        raw = np.frombuffer(f"\n{text}\n".encode("ascii"), np.uint8)
    except UnicodeEncodeError:
        return None
    blank = raw <= 32
    befores = np.flatnonzero(blank[:-1] > blank[1:])  # the place before each word
    lasts = np.flatnonzero(blank[:-1] < blank[1:])  # the last place of each word
    in_line = np.diff(np.searchsorted(befores, np.flatnonzero(raw == ord("\n"))))
    if ((in_line != 0) & (in_line != n_channels)).any():
        return None
    values = _numbers(text, raw, befores, lasts)
    if values is None or not (np.abs(values) <= LARGEST).all():
        return None
    return values.reshape(-1, n_channels), np.flatnonzero(in_line)


def _numbers(
    text: str, raw: np.ndarray, befores: np.ndarray, lasts: np.ndarray
) -> np.ndarray | None:
    """The words of `text` as float64, None where one is no number."""
    dots = np.flatnonzero(raw == ord("."))
    if len(dots) == len(befores) and (dots > befores).all() and (dots <= lasts).all():
        # Every word has one point: as whole numbers over powers of ten, four times faster. The
        # quotient of two numbers that float64 holds exactly is the nearest to what was written.
        whole = _from_text(text.replace(".", ""), np.int64)
        if whole is not None and len(whole) == len(dots):
            places = lasts - dots
            long = np.flatnonzero(
                (whole >= 2**53) | (whole <= -(2**53)) | (places >= len(_POWERS_OF_TEN))
            )
            if len(long) < len(whole) // 8:
                places[long] = 0
                values = whole / _POWERS_OF_TEN[places]
                values[long] = [float(text[befores[i] : lasts[i]]) for i in long]
                return values
    values = _from_text(text, np.float64)
    # "1-2" is read as two numbers.
    return values if values is not None and len(values) == len(befores) else None


def _from_text(text: str, dtype: type) -> np.ndarray | None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.fromstring(text, dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            return None


def _line_by_line(
    text: str, lines: Lines, n_before: int, n_frames: int, n_channels: int
) -> tuple[np.ndarray, np.ndarray]:
    """As `_bulk`, for what is unusual or wrong; says which line, and what is wrong with it."""
    rows, at = [], []
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
                raise lines.error(
                    f"value {column} of frame {frame} is {value}; expected a finite number up to "
                    f"{LARGEST:g}",
                    number,
                )
        rows.append(row)
        at.append(index)
    return np.array(rows).reshape(-1, n_channels), np.array(at, dtype=int)


def _number(word: str, lines: Lines, line: int) -> float:
    try:
        if "_" not in word:  # which float() passes over
            return float(word)
    except ValueError:
        pass
    hint = "; decimals need a point" if "," in word else ""
    raise lines.error(f"{word[:40]!r} is no number{hint}", line)
