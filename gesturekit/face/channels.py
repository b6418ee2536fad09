"""Channels of a face that rules make, and their ARKit names."""

from __future__ import annotations

import numpy as np

MOUTH = ("jawOpen", "mouthClose", "mouthFunnel", "mouthPucker", "mouthRollLower", "mouthRollUpper")
_MOUTH_SIDES = ("mouthPress", "mouthStretch", "mouthLowerDown", "mouthUpperUp")
SHAPES = (*MOUTH, *_MOUTH_SIDES)
"""Shapes of the mouth in the order of their columns; the last four have a left and a right."""
_EYES = ("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp")
_SIDED = [name + side for name in (*_MOUTH_SIDES, *_EYES) for side in ("Left", "Right")]
NAMES = (*MOUTH, *_SIDED)
"""Names of the columns of `channels`."""
_FULL_LOOK = 30.0
"""Degrees of gaze at which ARKit's eyeLook shapes are 1."""


def channels(mouth: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    """Return the values (T, E) of the channels NAMES.

    Args:
        mouth: (T, S) values of SHAPES.
        eyes: (T, 3) lids, gaze to the person's left and up in degrees, from `Eyes`.
    """
    middle = len(MOUTH)
    lids, left, up = eyes[:, 0], eyes[:, 1] / _FULL_LOOK, eyes[:, 2] / _FULL_LOOK
    pairs = [np.repeat(mouth[:, middle:], 2, axis=1), lids, lids, -up, -up]
    pairs += [-left, left, left, -left, up, up]  # the left eye looks in to the right
    return np.column_stack([mouth[:, :middle], *pairs]).clip(0.0, 1.0)
