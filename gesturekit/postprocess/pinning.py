"""By how much a point of a foot moves so that it stays where it stands, without a pop."""

from __future__ import annotations

import numpy as np

from gesturekit.motion.ik.two_bone import reachable
from gesturekit.postprocess.contact_spans import Span

BLEND = 0.15
"""Seconds over which a foot comes to its place and leaves it, at least."""
FASTEST = 0.3
"""m/s on the reference body at which a correction comes and goes, at most; large ones take longer
than `BLEND`."""
_GIVES = 0.25
"""The last share of the radius over which a pinned foot starts to give way."""


def pin(
    places: np.ndarray,
    spans: list[Span],
    floor: float,
    fps: float,
    radius: float,
    fastest: float,
    lifts: np.ndarray | float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Pin a point in each span at its mean place, on the floor.

    A point that comes down to the floor at the beginning of a span, or leaves it at the end, does
    so as it did: a foot that still flies is not pulled down, where it would slide.

    Args:
        places: (T, 3) of the point, metres.
        spans: when it stands, in order.
        floor: height of the point when it stands.
        fps: frames per second.
        radius: metres; a point that strays farther from its pin is let go, softly.
        fastest: m/s, `FASTEST` times the `body_scale` of the rig.
        lifts: (T,) metres over the floor at which it is meant to be, such as a heel that is lifted.

    Returns:
        (T, 3) what is to be added to `places`, and (T,) how much the pin holds: 1 within spans, 0
        away from them.
    """
    offset, hold = np.zeros_like(places), np.zeros(len(places))
    lifts = np.broadcast_to(lifts, len(places))
    pinned = []
    for start, stop in spans:
        inside = places[start:stop]
        target = np.tile(inside.mean(axis=0), (stop - start, 1))
        rolled = _rolled(inside[:, 1], start > 0, stop < len(places), fps)
        target[:, 1] = floor + np.maximum(rolled, lifts[start:stop])
        offset[start:stop] = give_way(target - inside, radius)
        hold[start:stop] = 1
        pinned.append((start, stop))
    gaps = zip([(0, 0), *pinned], [*pinned, (len(places), len(places))], strict=True)
    for before, after in gaps:
        _cross(offset, hold, before, after, fps, fastest)
    return offset, hold


def _rolled(height: np.ndarray, lands: bool, leaves: bool, fps: float) -> np.ndarray:
    """(T,) metres over the floor at which a point stays in a span: what it comes down from at its
    beginning and goes up to at its end, if it lands and leaves in sight."""
    above = np.maximum(height - np.median(height), 0)
    near = 1 - _ease(np.clip(np.arange(len(above)) / (BLEND * fps) - 1, 0, 1))
    landing = near * np.minimum.accumulate(above) * lands
    leaving = near[::-1] * np.minimum.accumulate(above[::-1])[::-1] * leaves
    return np.maximum(landing, leaving)


def give_way(offset: np.ndarray, radius: float) -> np.ndarray:
    """(T, 3) offsets of less than `radius`, those far below it as they are."""
    far = np.linalg.norm(offset, axis=-1, keepdims=True)
    allowed = reachable(far, np.array(radius), np.array(0.0), _GIVES)
    return offset * (allowed / np.maximum(far, 1e-9))


def _cross(
    offset: np.ndarray, hold: np.ndarray, before: Span, after: Span, fps: float, fastest: float
) -> None:
    """Fill the gap between two spans: out of the first and into the second, or straight across.

    Where the gap is too short for the way, it takes frames from both spans, half of each at most.
    """
    n_frames = len(offset)
    start, stop = before[1], after[0]
    first = offset[start - 1] if start else np.zeros(3)
    last = offset[stop] if stop < n_frames else np.zeros(3)
    out = _frames(first, fps, fastest) if start else 0
    into = _frames(last, fps, fastest) if stop < n_frames else 0
    if stop - start >= out + into:
        for edge, step, count, span in ((start, 1, out, before), (stop - 1, -1, into, after)):
            outside = edge + step * np.arange(count)
            share = 1 - _ease((1 + np.arange(count)) / (count + 1))
            from_span = first if step > 0 else last
            offset[outside] = from_span * share[:, None]
            hold[outside] = share
            if from_span[1] < 0:
                # Down it goes only once it stands: near the floor, what flies would slide.
                offset[outside, 1] = 0
                count = min(count, (span[1] - span[0]) // 2)
                inside = edge - step * (1 + np.arange(count))
                offset[inside, 1] *= _ease((1 + np.arange(count)) / (count + 1))
        return
    if not start or stop == n_frames:
        # Before the first span and after the last there is nothing to come from or to go to.
        frames = np.arange(start, stop)
        offset[frames], hold[frames] = (last, 1.0) if not start else (first, 1.0)
        return
    missing = _frames(last - first, fps, fastest) - (stop - start)
    if missing > 0:
        start -= min(-(-missing // 2), (before[1] - before[0]) // 2)
        stop += min(-(-missing // 2), (after[1] - after[0]) // 2)
        first, last = offset[start - 1], offset[stop]
    share = _ease((1 + np.arange(stop - start)) / (stop - start + 1))[:, None]
    offset[start:stop] = first + share * (last - first)
    hold[start:stop] = 1


def _frames(way: np.ndarray, fps: float, fastest: float) -> int:
    """Frames that a correction takes to come or go: its steepest is 1.5 times its mean."""
    seconds = max(BLEND, 1.5 * float(np.linalg.norm(way)) / fastest)
    return max(round(seconds * fps), 1)


def _ease(share: np.ndarray) -> np.ndarray:
    return share * share * (3 - 2 * share)
