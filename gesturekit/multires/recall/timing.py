"""Timing of recalled pieces: played faster or slower, so that they move at the times predicted from
speech."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

_FURTHEST_SECONDS = 0.4
"""Pieces are shown at most this much earlier or later than they were chosen for."""
_CHANGE_OF_TEMPO = 0.1
"""Cost of a change to the next tempo, in squared standard deviations of movement."""
_TEMPOS = (-1, 0, 1)
"""Slower, as recorded, and faster: change of the offset from frame to frame, in grid steps."""
_FRAMES_AT_ONCE = 1024


def time_offsets(own: np.ndarray, asked: np.ndarray, fps: float, stretch: float) -> np.ndarray:
    """Return the offsets with which recalled movement is closest to the movement predicted from
    speech.

    Dynamic time warping with three tempos: as recorded, and `stretch` faster and slower. The
    offsets are those with the lowest sum of squared differences and costs of changes of tempo.
    Recorded speeds are compared as they are, whatever the tempo: the aim is to move at other times,
    not faster.

    Args:
        own: (C, T) profile of the pieces: their movement, in standard deviations, and any other
            curves to be aligned.
        asked: (C, T) profile predicted from speech.
        fps: frames per second of both.
        stretch: fraction by which pieces may be played faster or slower, above 0.

    Returns:
        (T,) frames: frame t shows the pieces at t plus this offset.
    """
    n_frames, furthest = own.shape[1], int(_FURTHEST_SECONDS * fps / stretch)
    offsets = stretch * np.arange(-furthest, furthest + 1)
    steps = np.subtract.outer(_TEMPOS, _TEMPOS)
    changes = _CHANGE_OF_TEMPO * np.square(steps)[:, :, None]
    cost = np.zeros((len(_TEMPOS), len(offsets)))  # of the best path to each tempo and offset
    before = np.zeros((n_frames, *cost.shape), np.int8)  # the tempo that it had until then
    for t, difference in enumerate(_differences(own, asked, offsets)):
        if t:
            # The first axis is the tempo until this frame, the second the one that leads to it.
            totals = cost[:, None] + changes
            before[t] = _moved(totals.argmin(axis=0), 0)
            cost = _moved(totals.min(axis=0), np.inf)
        cost = cost + difference
    tempo, offset = np.unravel_index(cost.argmin(), cost.shape)
    path = np.empty(n_frames, int)
    for t in reversed(range(n_frames)):
        path[t] = offset
        tempo, offset = before[t, tempo, offset], offset - _TEMPOS[tempo]
    return offsets[path]


def _differences(own: np.ndarray, asked: np.ndarray, offsets: np.ndarray) -> Iterator[np.ndarray]:
    """Yield, for each frame, the squared differences (O,) at all offsets."""
    frames = np.arange(own.shape[1])
    for start in range(0, len(frames), _FRAMES_AT_ONCE):
        part = slice(start, start + _FRAMES_AT_ONCE)
        times = frames[part, None] + offsets
        rows = zip(own, asked, strict=True)
        yield from sum(
            np.square(np.interp(times, frames, curve) - goal[part, None]) for curve, goal in rows
        )


def _moved(rows: np.ndarray, outside: float) -> np.ndarray:
    """Return each tempo's row (3, O) one frame later, at the offsets that it has led to."""
    moved = np.full_like(rows, outside)
    for row, result, step in zip(rows, moved, _TEMPOS, strict=True):
        n = len(row) - abs(step)
        result[max(0, step) :][:n] = row[max(0, -step) :][:n]
    return moved
