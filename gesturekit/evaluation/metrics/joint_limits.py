"""Joint limits: does a motion bend joints further than the recordings do?

Rigs differ in where their axes lie, so that anatomical tables of Euler angles fit none of them.
The limits here are learned: each joint's rotation away from its mean, as a rotation vector, stays
within a range on each axis.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion import Motion
from gesturekit.motion.rotations import (
    invert_quaternions,
    mean_quaternion,
    multiply_quaternions,
    rotation_vector_from_quaternion,
)

MARGIN = np.deg2rad(5.0)
"""Radians by which a joint may leave the range that was recorded."""


@dataclass(frozen=True, eq=False)
class JointLimits:
    """The range of each joint.

    Attributes:
        joints: names of J joints.
        mean: (J, 4) mean local rotations, quaternions.
        low: (J, 3) least rotation vector away from the mean, radians, margin included.
        high: (J, 3) the greatest.
    """

    joints: tuple[str, ...]
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def fit(cls, motions: Iterable[Motion], joints: Sequence[str]) -> JointLimits:
        """Learn the limits from recordings of one rig.

        Args:
            motions: recordings; iterated once.
            joints: names of the joints to watch; leave out the root, which turns as it likes.

        Raises:
            MotionError: no motions, or a joint that one of them lacks.
        """
        rotations = [_of(motion, joints) for motion in motions]
        if not rotations:
            raise MotionError("no recording to learn joint limits from")
        stacked = np.concatenate(rotations)
        mean = np.stack([mean_quaternion(stacked[:, j]) for j in range(stacked.shape[1])])
        away = _away(stacked, mean)
        return cls(tuple(joints), mean, away.min(axis=0) - MARGIN, away.max(axis=0) + MARGIN)


def joint_limit_share(motion: Motion, limits: JointLimits) -> float:
    """Share (0 to 1) of all joints in all frames that are beyond their limits on any axis.

    Raises:
        MotionError: a joint of the limits that the motion lacks.
    """
    away = _away(_of(motion, limits.joints), limits.mean)
    return float(((away < limits.low) | (away > limits.high)).any(axis=-1).mean())


def _of(motion: Motion, joints: Sequence[str]) -> np.ndarray:
    return motion.rotations[:, [motion.skeleton.index(name) for name in joints]]


def _away(rotations: np.ndarray, mean: np.ndarray) -> np.ndarray:
    return rotation_vector_from_quaternion(
        multiply_quaternions(invert_quaternions(mean), rotations)
    )
