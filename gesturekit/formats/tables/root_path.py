"""Paths over the ground, read from a table or from a motion file."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from gesturekit.errors import FormatError, ModelError, MotionError
from gesturekit.formats.registry import READABLE
from gesturekit.formats.tables.table import read_table
from gesturekit.motion.motion import Motion
from gesturekit.motion.resampling import LOWEST_FPS
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import FARTHEST

FINEST = 120.0
"""Largest frame rate to which a table of uneven times is resampled."""
_COLUMNS = ("time", "x", "z", "heading")
_MEGABYTES = 32
_MAX_FRAMES = 10_000_000  # a day at 120 fps
_EVEN = 0.02
"""Largest deviation from evenly spaced times (due to rounding), as a share of a step."""


def as_root_path(path: str | os.PathLike[str] | RootPath | Motion, scale: float = 1.0) -> RootPath:
    """Return a path given as a path, a motion, or the name of a file.

    `scale` is that of `load_root_path`.

    Raises:
        ModelError: it is none of these.
        FormatError: a file that cannot be read.
    """
    if isinstance(path, RootPath):
        return path
    if isinstance(path, Motion):
        return RootPath.of(path)
    if isinstance(path, (str, os.PathLike)):
        return load_root_path(path, scale)
    raise ModelError(
        f"path is a {type(path).__name__}; give a RootPath, a Motion, or the name of a file"
    )


def load_root_path(path: str | os.PathLike[str], scale: float = 1.0) -> RootPath:
    """Read a path from a CSV table or from any motion file.

    The table's first line names its columns, `time,x,z` or `time,x,z,heading` in any order:
    seconds from the beginning of the path (the first is 0), metres, and degrees about Y (0 faces
    +Z, 90 faces +X). Without headings the path faces its direction of travel. Positions are
    interpolated linearly, so a few rows are enough. Even times give the frame rate; uneven ones
    are resampled at the rate of the shortest step, 120 fps at most.

    Args:
        path: the file.
        scale: `body_scale` of the body that follows it, to scale the speed of standing.

    Raises:
        FormatError: the file is missing, too large, or not such a table; with its line.
    """
    path = Path(path)
    if path.is_dir() or path.suffix.lower() in READABLE:
        return RootPath.of(Motion.load(path))
    if path.suffix.lower() != ".csv":
        raise FormatError(
            f"{path}: cannot read a path from {path.suffix or 'a file without suffix'}; expected "
            f"{', '.join(READABLE)}, or .csv with the columns {','.join(_COLUMNS)}"
        )
    table, has_heading = _table(path)
    times, x, z, *angles = table.T
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
            return RootPath.looking_ahead(places, fps, scale)
        headings = np.interp(at, times, np.unwrap(np.radians(angles[0])))
        return RootPath(places, headings, fps)
    except MotionError as error:
        raise FormatError(f"{path}: {error}") from None


def _table(path: Path) -> tuple[np.ndarray, bool]:
    """Return (N, 3 or 4) values in the order of `_COLUMNS`, and whether headings are present."""
    values: list[list[float]] = []
    for where, cells in read_table(path, _COLUMNS[:3], _COLUMNS[3:], _MEGABYTES):
        numbers = [_number(where, name, cells[name]) for name in _COLUMNS if name in cells]
        if not values and abs(numbers[0]) > 1e-9:
            raise FormatError(f"{where}: the first time is {numbers[0]:g}; a path begins at 0 s")
        if values and numbers[0] <= values[-1][0]:
            raise FormatError(
                f"{where}: time {numbers[0]:g} does not come after {values[-1][0]:g}; rows must "
                "be in order of time"
            )
        values.append(numbers)
    if len(values) < 2:
        raise FormatError(
            f"{path}: {len(values)} row{'s' if len(values) != 1 else ''} below the names of the "
            "columns; a path needs at least two"
        )
    return np.array(values), len(values[0]) == len(_COLUMNS)


def _number(where: str, column: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        number = np.nan
    if not abs(number) <= FARTHEST:
        raise FormatError(f"{where}: {column} is {cell[:40]!r}; expected a finite number")
    return number


def _frame_rate(path: Path, times: np.ndarray) -> float:
    """Return 1 / step if all steps of times (N,) are equal, else the rate of the shortest step.

    A whole number is preferred if it explains the times equally well.
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
