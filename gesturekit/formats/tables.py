"""Tables as text: events on the time line, paths over the ground, BEAT's scores of gestures.

Paths over the ground are also read from motion files.
"""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from audio_features.archive import read_bytes
from gesturekit.errors import FormatError, ModelError, MotionError
from gesturekit.formats.registry import READABLE
from gesturekit.motion.motion import Motion
from gesturekit.motion.resampling import LOWEST_FPS
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import FARTHEST
from gesturekit.wording import counted, did_you_mean, listed, printable

_MOST_BYTES = 32 << 20
_LONGEST_NAME = 80  # characters
_DAY = 24 * 3600.0  # seconds
_SECONDS = 0.0, 7 * _DAY, "seconds, 0 or more"
FINEST = 120.0
"""Largest frame rate to which a table of uneven times is resampled."""
_PATH = ("time", "x", "z", "heading")
_MAX_FRAMES = 10_000_000  # a day at 120 fps
_EVEN = 0.02
"""Largest deviation from evenly spaced times (due to rounding), as a share of a step."""


def csv_rows(
    path: Path, error: type[Exception] = FormatError, most: int = _MOST_BYTES
) -> Iterator[tuple[str, list[str]]]:
    """Yield each line of a CSV file that is not blank: its location (file and line), and its cells.

    Cells are separated by commas, semicolons (as by spreadsheets of some countries) or tabs.

    Args:
        path: the file; its first line is the header.
        error: class of errors.
        most: largest size of the file, bytes.

    Raises:
        Exception: of class `error`; the file cannot be read, is no CSV in UTF-8, or a line has
            another number of cells than the header.
    """
    header: list[str] = []
    try:
        text = io.StringIO(read_bytes(path, most, error).decode("utf-8-sig"), newline="")
        header_line = next(filter(str.strip, text), "")
        rows = csv.reader(text, strict=True, delimiter=max(",;\t", key=header_line.count))
        text.seek(0)
        for row in rows:
            cells, where = [cell.strip() for cell in row], f"{path}, line {rows.line_num}"
            if not any(cells):
                continue
            header = header or cells
            if len(cells) != len(header):
                names = listed([printable(name[:40]) for name in header])
                expected = f"but the header has {len(header)} ({names})"
                raise error(f"{where}: {counted(len(cells), 'cell')}, {expected}")
            yield where, cells
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not a CSV file in UTF-8 ({problem})") from None
    except csv.Error as problem:
        raise error(f"{path}, line {rows.line_num}: not a CSV file in UTF-8 ({problem})") from None


def read_table(
    path: Path, columns: Sequence[str], optional: Sequence[str] | None = ()
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the rows of a CSV table, each with its location (file and line) and cells by column.

    Columns may be in any order and their names in capitals; for separators see `csv_rows`.

    Args:
        path: the file.
        columns: required columns.
        optional: optional columns; None where a table may have any others.

    Raises:
        FormatError: the file is missing, too large, or not such a table; with its line.
    """
    rows = csv_rows(path)
    where, header = next(rows, (str(path), []))
    if not header:
        raise FormatError(f"{path}: empty; a table begins with the line {','.join(columns)}")
    names = [name.lower() for name in header]
    if optional is None:
        optional = [name for name in names if name not in columns]
    _check_columns(where, names, columns, optional)
    for where, cells in rows:
        yield where, dict(zip(names, cells, strict=True))


def _check_columns(
    where: str, names: list[str], columns: Sequence[str], optional: Sequence[str]
) -> None:
    known = [*columns, *optional]
    expected = "expected " + ",".join([*columns, *(f"[{name}]" for name in optional)])
    unknown = [name for name in names if name not in known]
    problems = [f"column {name[:40]!r}" for name in unknown]
    problems += [f"two columns {name!r}" for name in known if names.count(name) > 1]
    if missing := [name for name in columns if name not in names]:
        problems.append(f"no column {', '.join(missing)}")
    if problems:
        hint = did_you_mean(unknown[0], known, "did you mean {}? ") if unknown else ""
        raise FormatError(f"{where}: {problems[0]}; {hint}{expected}")


def _number(where: str, column: str, cell: str, low: float, high: float, kind: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        number = math.nan
    if not low <= number <= high:
        raise FormatError(f"{where}: {column} is {cell[:40]!r}; expected {kind}")
    return number


@dataclass(frozen=True, order=True)
class Event:
    """Something that happens: a kick, a beat of the music, a nod.

    Attributes:
        time: when it begins, seconds from the beginning of the recording.
        name: what it is.
        duration: seconds; 0 for a single frame.
    """

    time: float
    name: str
    duration: float = 0.0


def load_events(path: str | os.PathLike[str]) -> tuple[Event, ...]:
    """Read a CSV table of events, in order of time.

    The first line names the columns, `time,name` or `time,name,duration` in any order: seconds
    from the beginning of the recording, a name, and seconds (empty for a single frame).

    Raises:
        FormatError: the file is missing, too large, or not such a table; with its line.
    """
    events: list[Event] = []
    for where, cells in read_table(Path(path), ("time", "name"), ("duration",)):
        name = cells["name"]
        if not name or len(name) > _LONGEST_NAME or not name.isprintable():
            need = f"1 to {_LONGEST_NAME} printable characters"
            raise FormatError(f"{where}: name is {name[:40]!r}; expected {need}")
        time = _number(where, "time", cells["time"], *_SECONDS)
        duration = _number(where, "duration", cells.get("duration") or "0", *_SECONDS)
        events.append(Event(time, name, duration))
    return tuple(sorted(events))


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
    raise ModelError(f"path is a {type(path).__name__}; give a RootPath, a Motion, or a file")


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
        known = f"{', '.join(READABLE)}, or .csv with the columns {','.join(_PATH)}"
        raise FormatError(f"{path}: no path is read from {path.suffix!r}; expected {known}")
    times, x, z, *angles = _path_columns(path)
    fps = _frame_rate(path, times)
    n_frames = int(np.floor(times[-1] * fps + 0.5)) + 1
    if n_frames > _MAX_FRAMES:
        long = f"{times[-1]:g} s at {fps:.6g} fps are {n_frames} frames"
        raise FormatError(f"{path}: {long}; are the times seconds?")
    at = np.arange(n_frames) / fps
    places = np.stack([np.interp(at, times, x), np.interp(at, times, z)], axis=-1)
    try:
        if not angles:
            return RootPath.looking_ahead(places, fps, scale)
        headings = np.interp(at, times, np.unwrap(np.radians(angles[0])))
        return RootPath(places, headings, fps)
    except MotionError as error:
        raise FormatError(f"{path}: {error}") from None


def _path_columns(path: Path) -> np.ndarray:
    """Return (3 or 4, N) values in the order of `_PATH`."""
    values: list[list[float]] = []
    for where, cells in read_table(path, _PATH[:3], _PATH[3:]):
        numbers = [
            _number(where, name, cells[name], -FARTHEST, FARTHEST, "a finite number")
            for name in _PATH
            if name in cells
        ]
        if not values and abs(numbers[0]) > 1e-9:
            raise FormatError(f"{where}: the first time is {numbers[0]:g}; a path begins at 0 s")
        if values and numbers[0] <= values[-1][0]:
            order = f"time {numbers[0]:g} does not come after {values[-1][0]:g}"
            raise FormatError(f"{where}: {order}")
        values.append(numbers)
    if len(values) < 2:
        raise FormatError(f"{path}: {len(values)} rows of a path; at least two are needed")
    return np.array(values).T


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


def load_semantics(path: Path) -> list[tuple[float, float, float]]:
    """Read BEAT's table of gestures: (start, end, score) of each, in the order of the file.

    Lines are separated by tabs: gesture name, start, end, duration (seconds), score (0 to 1),
    keywords.

    Raises:
        FormatError: the table cannot be read, or a line is invalid.
    """
    intervals = []
    text = read_bytes(path, _MOST_BYTES, FormatError).decode("utf-8-sig", "replace")
    rows = csv.reader(io.StringIO(text, newline=""), delimiter="\t")
    try:
        for row in filter(None, rows):
            start, end, score = (float(row[column]) for column in (1, 2, 4))
            if not (0 <= start <= end <= _DAY and 0 <= score <= 1):
                raise ValueError
            intervals.append((start, end, score))
    except csv.Error as error:
        raise FormatError(f"{path}: cannot be read ({error})") from error
    except (IndexError, ValueError):
        text, need = " ".join(row)[:60], "name, start, end, duration and score, by tabs"
        where = f"{path}: line {rows.line_num}"
        raise FormatError(f"{where}: {text!r}: expected {need}") from None
    return intervals
