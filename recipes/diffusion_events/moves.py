"""Detection of punches and ducks in a motion."""

from __future__ import annotations

import numpy as np
from scipy.signal import find_peaks

from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import rotate_vectors

NEAR = 0.15
"""Largest distance in seconds of a move from its event."""
HALFWAY = {"punch": 0.385, "duck": -0.84}
"""Threshold of `extent` in metres, halfway between rest and the full move."""


def extent(motion: Motion, name: str) -> np.ndarray:
    """Return (T,) in metres: the right fist's distance ahead of the chest, or the hips' depth."""
    places, joint = motion.positions(), motion.skeleton.index
    if name == "duck":
        return -places[:, joint("Hips"), 1]
    chest = motion.global_rotations()[:, joint("Spine2")]
    ahead = rotate_vectors(chest, np.array([0.0, 0.0, 1.0]))
    return ((places[:, joint("RightHand")] - places[:, joint("Spine2")]) * ahead).sum(axis=-1)


def met(motion: Motion, name: str, moments: np.ndarray) -> float:
    """Return the share of moments (S,), in seconds, with a peak of the move within `NEAR`."""
    peaks = find_peaks(extent(motion, name), height=HALFWAY[name])[0] / motion.fps
    if not len(peaks):
        return 0.0
    return float((np.abs(moments[:, None] - peaks).min(axis=1) < NEAR).mean())
