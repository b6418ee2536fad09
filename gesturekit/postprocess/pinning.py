"""By how much a point of a foot moves so that it stays where it stands, without a pop."""

from __future__ import annotations

import numpy as np

from gesturekit.motion.ik import reachable
from gesturekit.postprocess.contact_spans import Span

BLEND = 0.15
"""Seconds over which a foot comes to its place and leaves it, at least."""
FASTEST = 0.3
"""m/s at which a correction comes and goes, at most; large ones take longer than `BLEND`."""
_GIVES = 0.25
"""The last share of the radius over which a pinned foot starts to give way."""


def pin(
    places: np.ndarray, spans: list[Span], floor: float, fps: float, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pin a point in each span at its mean place, on the floor.

    Args:
        places: (T, 3) of the point, metres.
        spans: when it stands, in order.
        floor: height of the point when it stands.
        fps: frames per second.
        radius: metres; a point that strays farther from its pin is let go, softly.

    Returns:
        (T, 3) what is to be added to `places`, and (T,) how much the pin holds: 1 within spans, 0
        away from them.
    """
    offset, hold = np.zeros_like(places), np.zeros(len(places))
    pinned = []
    for start, stop in spans:
        inside = places[start:stop]
        target = inside.mean(axis=0)
        target[1] = floor
        offset[start:stop] = give_way(target - inside, radius)
        hold[start:stop] = 1
        pinned.append((start, stop))
    gaps = zip([(0, 0), *pinned], [*pinned, (len(places), len(places))], strict=True)
    for before, after in gaps:
        _cross(offset, hold, before, after, fps)
    return offset, hold


def give_way(offset: np.ndarray, radius: float) -> np.ndarray:
    """(T, 3) offsets of less than `radius`, those far below it as they are."""
    far = np.linalg.norm(offset, axis=-1, keepdims=True)
    allowed = reachable(far, np.array(radius), np.array(0.0), _GIVES)
    return offset * (allowed / np.maximum(far, 1e-9))


def _cross(offset: np.ndarray, hold: np.ndarray, before: Span, after: Span, fps: float) -> None:
    """Fill the gap between two spans: out of the first and into the second, or straight across.

    Where the gap is too short for the way, it takes frames from both spans, half of each at most.
    """
    n_frames = len(offset)
    start, stop = before[1], after[0]
    first = offset[start - 1] if start else np.zeros(3)
    last = offset[stop] if stop < n_frames else np.zeros(3)
    out = _frames(first, fps) if start else 0
    into = _frames(last, fps) if stop < n_frames else 0
    if stop - start >= out + into:
        for edge, step, count in ((start, 1, out), (stop - 1, -1, into)):
            frames = edge + step * np.arange(count)
            share = 1 - _ease((1 + np.arange(count)) / (count + 1))
            offset[frames] = (first if step > 0 else last) * share[:, None]
            hold[frames] = share
        return
    if not start or stop == n_frames:
        # Before the first span and after the last there is nothing to come from or to go to.
        frames = np.arange(start, stop)
        offset[frames], hold[frames] = (last, 1.0) if not start else (first, 1.0)
        return
    missing = _frames(last - first, fps) - (stop - start)
    if missing > 0:
        start -= min(-(-missing // 2), (before[1] - before[0]) // 2)
        stop += min(-(-missing // 2), (after[1] - after[0]) // 2)
        first, last = offset[start - 1], offset[stop]
    share = _ease((1 + np.arange(stop - start)) / (stop - start + 1))[:, None]
    offset[start:stop] = first + share * (last - first)
    hold[start:stop] = 1


def _frames(way: np.ndarray, fps: float) -> int:
    """Frames that a correction takes to come or go: its steepest is 1.5 times its mean."""
    seconds = max(BLEND, 1.5 * float(np.linalg.norm(way)) / FASTEST)
    return max(round(seconds * fps), 1)


def _ease(share: np.ndarray) -> np.ndarray:
    return share * share * (3 - 2 * share)
