"""BEAT's tables of gestures with their semantic scores."""

from __future__ import annotations

import csv
from pathlib import Path

from gesturekit.errors import FormatError

_LONGEST = 24 * 3600.0
_MAX_BYTES = 32 << 20


def load_semantics(path: Path) -> list[tuple[float, float, float]]:
    """Read BEAT's table of gestures: (start, end, score) of each, in the order of the file.

    Lines are separated by tabs: gesture name, start, end, duration (seconds), score (0 to 1),
    keywords.

    Raises:
        FormatError: the table cannot be read, or a line is invalid.
    """
    intervals = []
    if path.is_file() and path.stat().st_size > _MAX_BYTES:
        raise FormatError(f"{path}: over {_MAX_BYTES >> 20} MB, too large for such a table")
    try:
        with path.open(encoding="utf-8", errors="replace", newline="") as file:
            for number, row in enumerate(csv.reader(file, delimiter="\t"), start=1):
                if row:
                    intervals.append(_interval(path, number, row))
    except (OSError, csv.Error) as error:
        raise FormatError(f"{path}: cannot be read ({error})") from error
    return intervals


def _interval(path: Path, number: int, row: list[str]) -> tuple[float, float, float]:
    try:
        start, end, score = float(row[1]), float(row[2]), float(row[4])
        if not (0 <= start <= end <= _LONGEST and 0 <= score <= 1):
            raise ValueError
    except (IndexError, ValueError):
        raise FormatError(
            f"{path}: line {number}: {' '.join(row)[:60]!r}: expected name, start, end, "
            "duration (seconds) and score (0 to 1), separated by tabs"
        ) from None
    return start, end, score
