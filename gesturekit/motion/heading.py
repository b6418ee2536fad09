"""Which way a body faces."""

from __future__ import annotations

import numpy as np

from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts


def heading(motion: Motion) -> float:
    """Mean direction the body faces, radians about Y; 0 is +Z, positive towards +X.

    A body that faces +Z has its left hip at +X of its right one.
    """
    legs = find_parts(motion.skeleton).legs
    positions = motion.positions()
    left, right = (motion.skeleton.index(legs[side].hip) for side in ("left", "right"))
    across = (positions[:, left] - positions[:, right]).mean(axis=0)
    return float(np.arctan2(-across[2], across[0]))
