"""Which way a body faces, and turning it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
)


def heading(motion: Motion) -> float:
    """Mean direction the body faces, radians about Y; 0 is +Z, positive towards +X.

    A body that faces +Z has its left hip at +X of its right one.
    """
    legs = find_parts(motion.skeleton).legs
    positions = motion.positions()
    left, right = (motion.skeleton.index(legs[side].hip) for side in ("left", "right"))
    across = (positions[:, left] - positions[:, right]).mean(axis=0)
    return float(np.arctan2(-across[2], across[0]))


def turned(motion: Motion, angle: float) -> Motion:
    """The motion turned about the world's Y axis by `angle`, radians."""
    turn = quaternion_from_rotation_vector(np.array([0.0, angle, 0.0]))
    rotations = motion.rotations.copy()
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    return replace(
        motion, rotations=rotations, translation=rotate_vectors(turn, motion.translation)
    )


def facing_forward(motion: Motion) -> Motion:
    """The motion turned so that, on the whole, it faces +Z."""
    return turned(motion, -heading(motion))
