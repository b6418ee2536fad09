"""The unit of a file's lengths, told from the size of the body."""

from __future__ import annotations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.body_size import first_fork, stature
from gesturekit.motion.kinematics import forward_kinematics
from gesturekit.motion.skeleton import Skeleton

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "cmu": 0.0254 / 0.45}
"""Metres in a unit of length; "cmu" is that of the CMU motion capture database, 5.64 cm."""

# Metres from sole-side ankle to head joint along the bones, 1.3 to 1.5 on adults; apart enough
# that "cm" and "inch" (2.54), or "inch" and "cmu" (2.22), do not overlap.
_SHORTEST, _TALLEST = 0.9, 2.1


def guess_unit(skeleton: Skeleton, rotations: np.ndarray) -> tuple[str, bool]:
    """The unit that makes the body of a person's size, and whether that is more than a guess.

    Args:
        skeleton: in the file's unit.
        rotations: (J, 4) local quaternions of one pose; used only where the parts of the body
            cannot be told from the names.
    """
    try:
        height = stature(skeleton)
    except MotionError:
        # Below the first fork: joints above it may lie anywhere between the origin and the body.
        positions = forward_kinematics(rotations, np.zeros(3), skeleton)
        fork = first_fork(skeleton)
        reach = np.ptp(positions[[fork, *skeleton.descendants(fork)]], axis=0).max()
        return "m" if reach < 8 else "cm" if reach < 500 else "mm", False
    for unit in ("m", "cm", "mm", "inch", "cmu"):
        if _SHORTEST <= height * METRES[unit] <= _TALLEST:
            return unit, True
    middle = np.log((_SHORTEST * _TALLEST) ** 0.5)
    usual = ("m", "cm", "mm")
    off = [abs(np.log(max(height, 1e-12) * METRES[unit]) - middle) for unit in usual]
    return usual[int(np.argmin(off))], False
