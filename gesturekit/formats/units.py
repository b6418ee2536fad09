"""Length units, and detection of a file's unit from the size of the body."""

from __future__ import annotations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.kinematics import forward_kinematics
from gesturekit.motion.parts.body_size import first_fork, stature
from gesturekit.motion.skeleton import Skeleton

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "cmu": 0.0254 / 0.45}
"""Metres in a unit of length; "cmu" is that of the CMU motion capture database, 5.64 cm."""

# Metres from ankle to head joint along the bones, 1.3 to 1.5 on adults. The ratio is small enough
# that "cm" and "inch" (2.54), or "inch" and "cmu" (2.22), do not overlap.
_SHORTEST, _TALLEST = 0.9, 2.1


def guess_unit(skeleton: Skeleton, rotations: np.ndarray) -> tuple[str, bool]:
    """Return the unit that gives the body the size of a person, and whether that is certain.

    Args:
        skeleton: rig in the file's unit, J joints.
        rotations: (J, 4) local quaternions of one pose; used only if the body parts cannot be
            identified.
    """
    try:
        height = stature(skeleton)
    except MotionError:
        # Joints above the first fork may lie anywhere between the origin and the body.
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
