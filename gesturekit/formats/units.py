"""The unit of a file's lengths, told from the size of the body."""

from __future__ import annotations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.kinematics import forward_kinematics
from gesturekit.motion.parts import find_parts, leg_length
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
        stature = leg_length(skeleton) + _spine_length(skeleton)
    except MotionError:
        # Below the first fork: joints above it may lie anywhere between the origin and the body.
        positions = forward_kinematics(rotations, np.zeros(3), skeleton)
        fork = first_fork(skeleton)
        reach = np.ptp(positions[[fork, *skeleton.descendants(fork)]], axis=0).max()
        return "m" if reach < 8 else "cm" if reach < 500 else "mm", False
    for unit in ("m", "cm", "mm", "inch", "cmu"):
        if _SHORTEST <= stature * METRES[unit] <= _TALLEST:
            return unit, True
    middle = np.log((_SHORTEST * _TALLEST) ** 0.5)
    usual = ("m", "cm", "mm")
    off = [abs(np.log(max(stature, 1e-12) * METRES[unit]) - middle) for unit in usual]
    return usual[int(np.argmin(off))], False


def first_fork(skeleton: Skeleton) -> int:
    """Index of the first joint with more than one child: joints above it hold no bone."""
    return next((j for j in range(skeleton.n_joints) if len(skeleton.children(j)) > 1), 0)


def _spine_length(skeleton: Skeleton) -> float:
    """From the pelvis to the head (or what comes nearest it) along the bones."""
    parts = find_parts(skeleton)
    pelvis = skeleton.index(parts.pelvis)
    joint, length = skeleton.index(parts.head or parts.spine[-1]), 0.0
    while joint not in (pelvis, -1):
        length += float(np.linalg.norm(skeleton.offsets[joint]))
        joint = skeleton.parents[joint]
    return length
