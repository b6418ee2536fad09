"""CSV files of faces that Epic's iPhone app Live Link Face records.

Each row is a frame: a timecode, the number of values (61), ARKit's 52 channels, and nine angles of
head and eyes, which are left out. Timecodes are HH:MM:SS:FF.SSS, FF.SSS in frames at its rate.
"""

from __future__ import annotations

import csv
import io
import os
import re
import warnings
from pathlib import Path

import numpy as np

from audio_features.archive import read_bytes
from audio_features.atomic import atomic_write
from gesturekit.errors import FormatError
from gesturekit.motion.face import ARKIT, FaceTrack, values_of
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import FARTHEST
from gesturekit.wording import listed

_COLUMNS = """
    EyeBlinkLeft EyeLookDownLeft EyeLookInLeft EyeLookOutLeft EyeLookUpLeft EyeSquintLeft
    EyeWideLeft EyeBlinkRight EyeLookDownRight EyeLookInRight EyeLookOutRight EyeLookUpRight
    EyeSquintRight EyeWideRight JawForward JawRight JawLeft JawOpen MouthClose MouthFunnel
    MouthPucker MouthRight MouthLeft MouthSmileLeft MouthSmileRight MouthFrownLeft MouthFrownRight
    MouthDimpleLeft MouthDimpleRight MouthStretchLeft MouthStretchRight MouthRollLower
    MouthRollUpper MouthShrugLower MouthShrugUpper MouthPressLeft MouthPressRight
    MouthLowerDownLeft MouthLowerDownRight MouthUpperUpLeft MouthUpperUpRight BrowDownLeft
    BrowDownRight BrowInnerUp BrowOuterUpLeft BrowOuterUpRight CheekPuff CheekSquintLeft
    CheekSquintRight NoseSneerLeft NoseSneerRight TongueOut HeadYaw HeadPitch HeadRoll LeftEyeYaw
    LeftEyePitch LeftEyeRoll RightEyeYaw RightEyePitch RightEyeRoll
"""
"""Values of a row, in the order of the app."""
_MOST_BYTES, _MOST_ROWS = 256 << 20, 500_000
"""Largest file: over an hour at 60 frames a second."""
_DAY = 24 * 3600.0
_TIMECODE = re.compile(r"(\d\d?):(\d\d?):(\d\d?)[:;]((?:\d\d?|1[01]\d)(?:\.\d{1,9})?)")
_RATE = 60
"""Usual frames a second of timecodes; those of written ones."""
_RATES = (24, 25, 30, 50, _RATE, 120)


def read_live_link(path: str | os.PathLike[str], fps: float, n_frames: int) -> FaceTrack:
    """Read a face at the frames of a motion, whose first frame is the first row.

    Values are interpolated between the rows' timecodes, which count frames at the least usual rate
    that is above all of them, and at 60 a second within a second. Columns may be in any order, and
    missing; rows without values (no face was seen) are skipped.

    Args:
        path: the file.
        fps: frames per second of the motion.
        n_frames: number of its frames.

    Raises:
        FormatError: missing, too large, or not such a table; with its line.

    Warns:
        UserWarning: the face is shorter (its last values are held) or longer than the motion.
    """
    path = Path(path)
    names, codes, values = _rows(path)
    whole, frames = np.unwrap(codes[:, 0], period=_DAY), codes[:, 1]  # midnight may pass
    rate = next(rate for rate in _RATES if rate > frames.max())
    times = whole - whole[0] + frames / (rate if np.ptp(whole) else max(rate, _RATE))
    if len(back := np.flatnonzero(np.diff(times) < 0)):
        text = f"the timecode of row {back[0] + 2} is before that of row {back[0] + 1}"
        raise FormatError(f"{path}: {text}")
    times -= times[0]
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1 / _RATE
    lasts, needed = times[-1] + step, n_frames / fps
    if abs(lasts - needed) > step + 1 / fps:
        text = "its last values are held" if lasts < needed else "the rest is left out"
        said = f"{path}: the face lasts {lasts:.2f} s, the motion {needed:.2f} s: {text}"
        warnings.warn(said, stacklevel=2)
    at = np.arange(n_frames) / fps
    return FaceTrack(names, np.stack([np.interp(at, times, column) for column in values.T], axis=1))


def _rows(path: Path) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Return names of E channels, timecodes (N, 2) as seconds and frames, and values (N, E)."""
    known = {name.lower(): name for name in ARKIT}
    found = list[np.ndarray]()
    try:
        content = io.BytesIO(read_bytes(path, _MOST_BYTES, FormatError))
        text = io.TextIOWrapper(content, encoding="utf-8-sig", newline="")
        rows = csv.reader(text, strict=True)
        head = [cell.strip().lower() for cell in next(rows, [])]
        columns = {known[cell]: k for k, cell in enumerate(head) if cell in known}
        if "timecode" not in head or not columns:
            raise FormatError(f"{path}: no columns Timecode and EyeBlinkLeft, ..., TongueOut")
        at = head.index("timecode")
        for row in rows:
            cells = [row[k] if k < len(row) else "" for k in (at, *columns.values())]
            if len(found) == _MOST_ROWS:
                raise FormatError(f"{path}: over {_MOST_ROWS} rows; cut it into parts")
            if any(map(str.strip, cells[1:])):
                found.append(_numbers(f"{path}, line {rows.line_num}", *cells))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FormatError(f"{path}: not a CSV table ({error})") from None
    if not found:
        raise FormatError(f"{path}: no row with values of a face")
    table = np.stack(found)
    return tuple(columns), table[:, :2], table[:, 2:]


def _numbers(where: str, code: str, *cells: str) -> np.ndarray:
    """Return the seconds and the frames of a timecode, and the values of a row."""
    if not (match := _TIMECODE.fullmatch(code.strip())):
        need = "expected HH:MM:SS:FF.SSS, FF below 120"
        raise FormatError(f"{where}: Timecode is {code[:40]!r}; {need}")
    hours, minutes, seconds = (int(match[k]) for k in (1, 2, 3))
    try:
        numbers = np.array([3600 * hours + 60 * minutes + seconds, match[4], *cells], float)
    except ValueError:
        numbers = np.array([np.nan])
    if not (np.abs(numbers) <= FARTHEST).all():
        raise FormatError(f"{where}: expected {len(cells)} finite numbers, one for each channel")
    return numbers


def write_live_link(motion: Motion, path: str | os.PathLike[str]) -> None:
    """Write the face of a motion, with angles of 0, and timecodes that count 60 frames a second.

    Args:
        motion: with a face; nothing else of it is written.
        path: the .csv file, written atomically.

    Raises:
        FormatError: no face, or none of ARKit's channels.

    Warns:
        UserWarning: channels that are not ARKit's, or a face by rules, which reads as recorded.
    """
    face = motion.face
    if face is None or not set(face.names) & set(ARKIT):
        what = "no face" if face is None else "a face without ARKit's channels"
        raise FormatError(f"{path}: the motion has {what}; csv holds nothing else")
    if others := sorted(set(face.names).difference(ARKIT)):
        warnings.warn(f"{path}: not ARKit's, and left out: {listed(others)}", stacklevel=2)
    if face.origin == "rules":
        warnings.warn(f"{path}: csv cannot say that rules made this face", stacklevel=2)
    columns = _COLUMNS.split()
    table = values_of(face, [name[0].lower() + name[1:] for name in columns])
    with atomic_write(path) as temporary, temporary.open("w", encoding="ascii", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["Timecode", "BlendshapeCount", *columns])
        for time, row in zip(motion.times, table):
            seconds, part = divmod(round(1000 * _RATE * time), 1000 * _RATE)
            clock = f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
            code = f"{clock}:{part / 1000:06.3f}"
            writer.writerow([code, len(columns), *(f"{value:.6f}" for value in row)])
