"""Root drift: foot sliding common to both feet, which is corrected at the hips, not the legs."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gesturekit.postprocess.contact_spans import smooth_path

_STEADY = 0.2
"""Seconds (standard deviation) over which foot speeds are smoothed before they are compared."""
_SWAY = 1.0
"""Seconds (standard deviation); faster movement is sway, which the legs absorb, and not drift."""


def horizontal_drift(
    left: np.ndarray, right: np.ndarray, stands: np.ndarray, fps: float
) -> np.ndarray:
    """(T, 3) horizontal distance that the standing feet have slid so far, without sway, metres.

    If both feet stand, the drift is the common part of their velocities; if one stands, it is that
    foot's velocity. Zero in frame 0.

    Args:
        left: (T, 3) positions of the left foot, metres.
        right: (T, 3) positions of the right foot, metres.
        stands: (T, 2) bool, true if the left or right foot stands.
        fps: frames per second.
    """
    both = np.stack([left, right], axis=1)
    standing = np.zeros(stands.shape)
    standing[1:] = stands[1:] & stands[:-1]
    steps = np.diff(both, axis=0, prepend=both[:1]) * [1, 0, 1] * standing[..., None]
    weight = gaussian_filter1d(standing, _STEADY * fps, axis=0, mode="constant")[..., None]
    steady = gaussian_filter1d(steps, _STEADY * fps, axis=0, mode="constant")
    steady /= np.maximum(weight, 1e-6)
    return smooth_path(np.cumsum(_common(steady, standing), axis=0), _SWAY * fps)


def height_error(heights: np.ndarray, stands: np.ndarray, fps: float) -> np.ndarray:
    """(T,) smoothed height above the floor that is common to the standing feet, metres.

    `heights` (T, 2) are above the feet's standing heights, metres; `stands` as in
    `horizontal_drift`.
    """
    standing = stands.astype(float)
    common = _common(heights[..., None] * standing[..., None], standing)
    weight = smooth_path(standing.max(axis=1), _SWAY * fps)
    return smooth_path(common[:, 0], _SWAY * fps) / np.maximum(weight, 0.5)


def _common(both: np.ndarray, standing: np.ndarray) -> np.ndarray:
    """(T, D) common part of two vectors (T, 2, D), one a foot.

    If both feet stand, it points along the mean and is as long as the shorter of the projections
    onto it. If one stands, it is that foot's vector.
    """
    alone = (both * standing[..., None]).sum(axis=1)
    mean = both.mean(axis=1)
    direction = mean / np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-12)
    least = (both * direction[:, None]).sum(axis=-1).min(axis=1)
    together = direction * np.maximum(least, 0)[:, None]
    return np.where(standing.all(axis=1)[:, None], together, alone)
