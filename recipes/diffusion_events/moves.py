"""Whether a move is at its height when it should be."""

from __future__ import annotations

import numpy as np
from scipy.signal import find_peaks

from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import rotate_vectors

NEAR = 0.15
"""Seconds from a moment within which a move belongs to it."""
HALFWAY = {"punch": 0.385, "duck": -0.84}
"""Metres of `extent`, between rest and the move at its height."""


def extent(motion: Motion, name: str) -> np.ndarray:
    """(T,) metres: how far ahead of the chest the right fist is, or how deep the hips are."""
    places, joint = motion.positions(), motion.skeleton.index
    if name == "duck":
        return -places[:, joint("Hips"), 1]
    chest = motion.global_rotations()[:, joint("Spine2")]
    ahead = rotate_vectors(chest, np.array([0.0, 0.0, 1.0]))
    return ((places[:, joint("RightHand")] - places[:, joint("Spine2")]) * ahead).sum(axis=-1)


def met(motion: Motion, name: str, moments: np.ndarray) -> float:
    """Share of moments (S,) in seconds near which the move is at its height."""
    peaks = find_peaks(extent(motion, name), height=HALFWAY[name])[0] / motion.fps
    if not len(peaks):
        return 0.0
    return float((np.abs(moments[:, None] - peaks).min(axis=1) < NEAR).mean())
