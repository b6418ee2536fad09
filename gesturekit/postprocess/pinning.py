"""Pinning: smooth corrections that keep a point of a foot in place while it stands."""

from __future__ import annotations

import numpy as np

from gesturekit.motion.ik.two_bone import reachable
from gesturekit.postprocess.contact_spans import Span

BLEND = 0.15
"""Least time in seconds over which a correction is blended in and out."""
FASTEST = 0.3
"""Largest speed of a correction while it is blended, m/s on the reference body; large corrections
take longer than `BLEND`."""
_SOFTNESS = 0.25
"""Last share of the radius over which a correction is compressed."""


def pin(
    places: np.ndarray,
    spans: list[Span],
    floor: float,
    fps: float,
    radius: float,
    fastest: float,
    lifts: np.ndarray | float,
) -> tuple[np.ndarray, np.ndarray]:
    """Pin a point at its mean position on the floor in each span.

    A point that descends to the floor at the beginning of a span, or rises at its end, keeps its
    height there: pulling a foot in flight down to the floor would make it slide.

    Args:
        places: (T, 3) positions of the point, metres.
        spans: spans in which it stands, in order.
        floor: height of the point when it stands.
        fps: frames per second.
        radius: largest correction, metres; larger ones are compressed.
        fastest: m/s, `FASTEST` times the `body_scale` of the rig.
        lifts: (T,) intended height above the floor, such as that of a lifted heel, metres.

    Returns:
        (T, 3) corrections to add to `places`, and (T,) weight of the pin: 1 in spans, 0 far away.
    """
    offset, hold = np.zeros_like(places), np.zeros(len(places))
    lifts = np.broadcast_to(lifts, len(places))
    pinned = []
    for start, stop in spans:
        inside = places[start:stop]
        target = np.tile(inside.mean(axis=0), (stop - start, 1))
        rolled = _rolled(inside[:, 1], start > 0, stop < len(places), fps)
        target[:, 1] = floor + np.maximum(rolled, lifts[start:stop])
        offset[start:stop] = soft_clamp(target - inside, radius)
        hold[start:stop] = 1
        pinned.append((start, stop))
    gaps = zip([(0, 0), *pinned], [*pinned, (len(places), len(places))], strict=True)
    for before, after in gaps:
        _fill_gap(offset, hold, before, after, fps, fastest)
    return offset, hold


def _rolled(height: np.ndarray, lands: bool, leaves: bool, fps: float) -> np.ndarray:
    """(T,) height above the floor that a point keeps in a span as it descends and rises, metres.

    `height` is (T,); `lands` and `leaves`: the motion shows the beginning and the end of the span.
    """
    above = np.maximum(height - np.median(height), 0)
    near = 1 - _ease(np.clip(np.arange(len(above)) / (BLEND * fps) - 1, 0, 1))
    landing = near * np.minimum.accumulate(above) * lands
    leaving = near[::-1] * np.minimum.accumulate(above[::-1])[::-1] * leaves
    return np.maximum(landing, leaving)


def soft_clamp(offset: np.ndarray, radius: float) -> np.ndarray:
    """(T, 3) offsets limited to length `radius`; those far below it do not change."""
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    allowed = reachable(length, np.array(radius), np.array(0.0), _SOFTNESS)
    return offset * (allowed / np.maximum(length, 1e-9))


def _fill_gap(
    offset: np.ndarray, hold: np.ndarray, before: Span, after: Span, fps: float, fastest: float
) -> None:
    """Fill the gap between two spans in place, by blending to zero and back or straight across.

    Changes the corrections `offset` (T, 3) and the pin's weight `hold` (T,). A gap too short for a
    straight blend at `fastest` m/s is extended into both spans, by half of each at most.
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
                # Lower the foot only while it stands; pulled to the floor in flight it would slide.
                offset[outside, 1] = 0
                count = min(count, (span[1] - span[0]) // 2)
                inside = edge - step * (1 + np.arange(count))
                offset[inside, 1] *= _ease((1 + np.arange(count)) / (count + 1))
        return
    if not start or stop == n_frames:
        # No span on one side: keep the correction of the other.
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


def _frames(change: np.ndarray, fps: float, fastest: float) -> int:
    """Return the frames over which to blend a correction (3,).

    The largest slope of `_ease` is 1.5 times its mean slope.
    """
    seconds = max(BLEND, 1.5 * float(np.linalg.norm(change)) / fastest)
    return max(round(seconds * fps), 1)


def _ease(share: np.ndarray) -> np.ndarray:
    """Return the smoothstep 3 x^2 - 2 x^3 of shares in [0, 1]."""
    return share * share * (3 - 2 * share)
