"""Paths over the ground, read from a table or from a motion file."""

from __future__ import annotations

import csv
import difflib
import io
import os
from pathlib import Path

import numpy as np

from gesturekit.errors import FormatError, MotionError
from gesturekit.motion.motion import LOWEST_FPS, Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import FARTHEST

MOTION_SUFFIXES = (".bvh", ".npz", ".json")
FINEST = 120.0
"""Frames per second that a table of uneven times is laid out at, at the most."""
_COLUMNS = ("time", "x", "z", "heading")
_MAX_BYTES = 32 << 20
_MAX_FRAMES = 10_000_000  # a day at 120 fps
_EVEN = 0.02
"""Share of a step that times may be off by (rounded digits) and still be even."""


def load_root_path(path: str | os.PathLike[str]) -> RootPath:
    """Read a path from a CSV table or from any motion file.

    The table's first line names its columns, `time,x,z` or `time,x,z,heading` in any order:
    seconds from the beginning of the path (the first is 0), metres, and degrees about Y (0 faces
    +Z, 90 faces +X). Without headings the path looks where it goes. Between rows it runs straight,
    so a few rows are enough. Even times give the frame rate; uneven ones are laid out evenly at
    the rate of the shortest step, 120 fps at the most.

    Raises:
        FormatError: the file is missing, too large, or not such a table; with its line.
    """
    path = Path(path)
    if path.is_dir() or path.suffix.lower() in MOTION_SUFFIXES:
        return RootPath.of(Motion.load(path))
    if path.suffix.lower() != ".csv":
        raise FormatError(
            f"{path}: cannot read a path from {path.suffix or 'a file without suffix'}; expected "
            f"{', '.join(MOTION_SUFFIXES)}, or .csv with the columns {','.join(_COLUMNS)}"
        )
    table, has_heading = _table(path, _text(path))
    times, x, z = table[:, :3].T
    fps = _frame_rate(path, times)
    n_frames = int(np.floor(times[-1] * fps + 0.5)) + 1
    if n_frames > _MAX_FRAMES:
        raise FormatError(
            f"{path}: {times[-1]:g} s at {fps:.6g} fps are {n_frames} frames of a path; are the "
            "times seconds?"
        )
    at = np.arange(n_frames) / fps
    places = np.stack([np.interp(at, times, x), np.interp(at, times, z)], axis=-1)
    try:
        if not has_heading:
            return RootPath.looking_ahead(places, fps)
        angles = np.unwrap(np.radians(table[:, 3]))
        return RootPath(places, np.interp(at, times, angles), fps)
    except MotionError as error:
        raise FormatError(f"{path}: {error}") from None


def _text(path: Path) -> str:
    if path.exists() and not path.is_file():
        raise FormatError(f"{path}: not a regular file")
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
        if len(data) > _MAX_BYTES:
            raise FormatError(f"{path}: over {_MAX_BYTES >> 20} MB, too large for a path")
        return data.decode("utf-8-sig")
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{path}: cannot be read as text ({error})") from None


def _table(path: Path, text: str) -> tuple[np.ndarray, bool]:
    """(N, 3 or 4) time, x, z and heading in the order of `_COLUMNS`; whether headings are there."""
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    columns: list[str] | None = None
    order: list[int] = []
    values: list[list[float]] = []
    try:
        for row in rows:
            line = rows.line_num
            if not any(cell.strip() for cell in row):
                continue
            if columns is None:
                columns = [cell.strip().lower() for cell in row]
                order = _order(path, line, columns)
                continue
            if len(row) != len(columns):
                raise FormatError(
                    f"{path}, line {line}: {len(row)} values; expected {len(columns)} "
                    f"({','.join(columns)})"
                )
            numbers = [_number(path, line, columns[k], row[k]) for k in order]
            if not values and abs(numbers[0]) > 1e-9:
                raise FormatError(
                    f"{path}, line {line}: the first time is {numbers[0]:g}; a path begins at 0 s"
                )
            if values and numbers[0] <= values[-1][0]:
                raise FormatError(
                    f"{path}, line {line}: time {numbers[0]:g} does not come after "
                    f"{values[-1][0]:g}; rows must be in order of time"
                )
            values.append(numbers)
    except csv.Error as error:
        raise FormatError(f"{path}, line {rows.line_num}: not a CSV table ({error})") from None
    if len(values) < 2:
        raise FormatError(
            f"{path}: {len(values)} row{'s' if len(values) != 1 else ''} below the names of the "
            "columns; a path needs at least two"
        )
    return np.array(values), len(order) == len(_COLUMNS)


def _order(path: Path, line: int, columns: list[str]) -> list[int]:
    """Where in a row each of `_COLUMNS` stands."""
    expected = "expected time,x,z or time,x,z,heading"
    for name in columns:
        if name not in _COLUMNS:
            near = difflib.get_close_matches(name, _COLUMNS, n=1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise FormatError(f"{path}, line {line}: column {name[:40]!r}; {hint}{expected}")
        if columns.count(name) > 1:
            raise FormatError(f"{path}, line {line}: two columns {name!r}; {expected}")
    missing = [name for name in _COLUMNS[:3] if name not in columns]
    if missing:
        raise FormatError(f"{path}, line {line}: no column {', '.join(missing)}; {expected}")
    return [columns.index(name) for name in _COLUMNS if name in columns]


def _number(path: Path, line: int, column: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        number = np.nan
    if not abs(number) <= FARTHEST:
        raise FormatError(
            f"{path}, line {line}: {column} is {cell.strip()[:40]!r}; expected a finite number"
        )
    return number


def _frame_rate(path: Path, times: np.ndarray) -> float:
    """1 / step where all steps are alike, else the rate of the shortest step.

    A whole number is meant where it explains the times as well.
    """
    steps = np.diff(times)
    mean = times[-1] / len(steps)
    if not 1e-9 < mean < 1 / LOWEST_FPS:
        raise FormatError(f"{path}: rows {mean:g} s apart; are the times seconds?")
    if np.abs(times - mean * np.arange(len(times))).max() > _EVEN * mean:
        return float(1 / max(1 / FINEST, steps.min()))
    whole = round(1 / mean)
    if whole and abs(len(steps) / whole - times[-1]) <= _EVEN * mean:
        return float(whole)
    return float(1 / mean)
