"""Contact spans: frames in which a foot stands, from predicted labels or from speed and height.

Constants in metres and m/s are for the reference body; callers pass the `body_scale` of the rig.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter1d

from gesturekit.motion.contacts import CONTACT_SPEED

Span = tuple[int, int]
"""First frame, and the frame after the last."""

EDGE_SPEED = 0.4
"""m/s; a point just above the floor that is slower is landing or leaving."""
MAX_LABEL_SPEED = 0.6
"""m/s; a predicted contact of a faster foot is ignored."""
TREMBLE_SECONDS = 1 / 30
"""Seconds (standard deviation) of the smoothing that removes trembling from foot speed."""
NEAR = 0.03
"""Metres; a point farther from its standing height is not on the floor."""
SHORTEST = 0.1
"""Seconds; shorter spans are noise, and so are shorter gaps between them."""


def point_speed(positions: np.ndarray, fps: float) -> np.ndarray:
    """(T,) speed of a point (T, 3) since the previous frame, m/s; frame 0 copies frame 1."""
    speed = np.zeros(len(positions))
    speed[1:] = np.linalg.norm(np.diff(positions, axis=0), axis=1) * fps
    speed[0] = speed[min(1, len(speed) - 1)]
    return speed


def gaussian_smoothed(path: np.ndarray, frames: float) -> np.ndarray:
    """(T, ...) Gaussian smoothing, padded by point reflection so that linear drift is kept.

    `frames` is the standard deviation.
    """
    margin = round(4 * frames)
    around = ((margin, margin),) + ((0, 0),) * (path.ndim - 1)
    padded = np.pad(path, around, mode="reflect", reflect_type="odd")
    return gaussian_filter1d(padded, frames, axis=0)[margin : margin + len(path)]


def contact_frames(
    positions: np.ndarray, fps: float, scale: float, labels: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """Find the frames in which a point of a foot is on the floor, and its height there.

    Args:
        positions: (T, 3) positions of the point, metres.
        fps: frames per second.
        scale: `body_scale` of the body.
        labels: (T,) predicted contact, above 0.5 if it stands. Without labels the speed decides:
            the lower of the point's and of its smoothed positions'.

    Returns:
        (T,) bool, and the height of the floor under the point: the median over the frames in which
        it stands, which is robust to steps and jumps. For a point that never stands it is the 10th
        percentile of its height.
    """
    speed = point_speed(positions, fps)
    if labels is None:
        steady = gaussian_smoothed(positions, TREMBLE_SECONDS * fps)
        speed = np.minimum(speed, point_speed(steady, fps))
    speed /= scale
    if labels is None:
        stands = speed < CONTACT_SPEED
    else:
        stands = (labels > 0.5) & (speed < MAX_LABEL_SPEED)
    height = positions[:, 1]
    floor = float(np.median(height[stands]) if stands.any() else np.quantile(height, 0.1))
    return stands & (np.abs(height - floor) < NEAR * scale), floor


def include_landing(
    stands: np.ndarray, positions: np.ndarray, floor: float, fps: float, scale: float
) -> np.ndarray:
    """(T,) bool, true if a point stands, lands or leaves.

    A foot crosses `CONTACT_SPEED` some frames after it lands and before it leaves. Up to `SHORTEST`
    before and after are added in which the point is slow and low. `stands` (T,) and `floor` are
    results of `contact_frames`, which takes the other arguments too.
    """
    low = np.abs(positions[:, 1] - floor) < NEAR / 2 * scale
    settles = stands | (low & (point_speed(positions, fps) < EDGE_SPEED * scale))
    frames = max(round(SHORTEST * fps), 1)
    return binary_dilation(stands, iterations=frames, mask=settles)


def contact_spans(stands: np.ndarray, fps: float) -> list[Span]:
    """Return the spans of a mask (T,), with short gaps closed and short spans removed."""
    shortest = max(round(SHORTEST * fps), 1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], stands.astype(np.int8), [0]])))
    spans: list[Span] = []
    for start, stop in edges.reshape(-1, 2).tolist():
        if spans and start - spans[-1][1] < shortest:
            start = spans.pop()[0]
        spans.append((start, stop))
    return [span for span in spans if span[1] - span[0] >= shortest]


def split_at_movement(
    spans: list[Span], positions: np.ndarray, fps: float, radius: np.ndarray
) -> list[Span]:
    """Split spans until the points stay within a radius of their mean positions.

    A foot that shuffles or turns stands at several places in turn. A span that is too wide is cut
    at its fastest frame, but never into pieces that are too short.

    Args:
        spans: spans in which the foot stands.
        positions: (T, N, 3) positions of N points, metres.
        fps: frames per second.
        radius: (N,) metres.
    """
    shortest = max(round(2 * SHORTEST * fps), 2)
    shares = positions / np.asarray(radius)[:, None]
    speed = np.max([point_speed(share, fps) for share in np.moveaxis(shares, 1, 0)], axis=0)
    kept, left = [], spans[::-1]
    while left:
        start, stop = left.pop()
        inside = shares[start:stop]
        away = np.linalg.norm(inside - inside.mean(axis=0), axis=2).max()
        if away <= 1 or stop - start < 2 * shortest:
            kept.append((start, stop))
            continue
        cut = start + shortest + int(speed[start + shortest : stop - shortest + 1].argmax())
        left += [(cut, stop), (start, cut)]
    return kept
