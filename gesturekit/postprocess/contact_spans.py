"""When a foot stands: spans of frames, from predicted labels or from speed and height.

Lengths and speeds are those of the reference body; callers give the `body_scale` of the rig.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter1d

from gesturekit.motion.contacts import CONTACT_SPEED

Span = tuple[int, int]
"""First frame, and the frame after the last."""

SETTLES = 0.4
"""m/s; a point just above the floor that is slower than this is about to stand, or stood."""
BELIEVED = 0.6
"""m/s; a label on a foot that moves faster is a mistake."""
TREMBLES = 1 / 30
"""Seconds (standard deviation) over which a tremble is averaged before it is called movement."""
NEAR = 0.03
"""Metres above or below its standing height where a point is not on the floor."""
SHORTEST = 0.1
"""Seconds; shorter spans are noise, and so are shorter gaps between them."""


def point_speed(places: np.ndarray, fps: float) -> np.ndarray:
    """(T,) m/s of a point (T, 3) since the frame before; frame 0 copies frame 1."""
    speed = np.zeros(len(places))
    speed[1:] = np.linalg.norm(np.diff(places, axis=0), axis=-1) * fps
    speed[0] = speed[min(1, len(speed) - 1)]
    return speed


def contact_frames(
    places: np.ndarray, fps: float, scale: float, labels: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """When a point of a foot is on the floor, and how high it then is.

    Args:
        places: (T, 3) of the point, metres.
        fps: frames per second.
        scale: of the body, see `body_scale`.
        labels: (T,) predicted contact, over 0.5 where it stands; None judges by speed alone, that
            of the point or of where it is on average, if that is slower.

    Returns:
        (T,) bool, and the height of the floor under the point: the median over the frames in which
        it stands, so that steps, jumps and single frames do not move it. A point that never stands
        has the lowest tenth of its heights.
    """
    speed = point_speed(places, fps)
    if labels is None:
        steady = gaussian_filter1d(places, TREMBLES * fps, axis=0)
        speed = np.minimum(speed, point_speed(steady, fps))
    speed /= scale
    stands = speed < CONTACT_SPEED if labels is None else (labels > 0.5) & (speed < BELIEVED)
    height = places[:, 1]
    floor = float(np.median(height[stands]) if stands.any() else np.quantile(height, 0.1))
    return stands & (np.abs(height - floor) < NEAR * scale), floor


def with_edges(
    stands: np.ndarray, places: np.ndarray, floor: float, fps: float, scale: float
) -> np.ndarray:
    """(T,) bool: when a point stands, lands and leaves.

    A foot passes `CONTACT_SPEED` some frames after it has landed, and before it leaves: up to
    `SHORTEST` on either side count in which the point is slow and low.

    Args:
        stands: (T,) bool.
        places: (T, 3) of the point, metres.
        floor: height of the point when it stands.
        fps: frames per second.
        scale: of the body, see `body_scale`.
    """
    low = np.abs(places[:, 1] - floor) < NEAR / 2 * scale
    settles = stands | (low & (point_speed(places, fps) < SETTLES * scale))
    frames = max(round(SHORTEST * fps), 1)
    return binary_dilation(stands, iterations=frames, mask=settles)


def contact_spans(stands: np.ndarray, fps: float) -> list[Span]:
    """Spans of a mask (T,), without the shortest gaps and the shortest spans."""
    shortest = max(round(SHORTEST * fps), 1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], stands.astype(np.int8), [0]])))
    spans: list[Span] = []
    for start, stop in edges.reshape(-1, 2).tolist():
        if spans and start - spans[-1][1] < shortest:
            start = spans.pop()[0]
        spans.append((start, stop))
    return [span for span in spans if span[1] - span[0] >= shortest]


def split_where_it_moves(
    spans: list[Span], places: np.ndarray, fps: float, radius: np.ndarray
) -> list[Span]:
    """Spans in which points stay within a radius of their mean places, as far as they can be had.

    A foot that shuffles or turns stands first here, then there: a span that is wider is cut where
    it moves fastest, and never into pieces that are too short.

    Args:
        spans: when the foot stands.
        places: (T, N, 3), metres.
        fps: frames per second.
        radius: (N,) metres.
    """
    shortest = max(round(2 * SHORTEST * fps), 2)
    shares = places / np.asarray(radius)[:, None]
    speed = np.max([point_speed(share, fps) for share in np.moveaxis(shares, 1, 0)], axis=0)
    kept, left = [], spans[::-1]
    while left:
        start, stop = left.pop()
        inside = shares[start:stop]
        away = np.linalg.norm(inside - inside.mean(axis=0), axis=-1).max()
        if away <= 1 or stop - start < 2 * shortest:
            kept.append((start, stop))
            continue
        cut = start + shortest + int(speed[start + shortest : stop - shortest + 1].argmax())
        left += [(cut, stop), (start, cut)]
    return kept
