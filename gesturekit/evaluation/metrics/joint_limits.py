"""Joint limits, learned from recordings.

Rigs differ in their joint axes, so anatomical tables of Euler angles do not apply. Instead, limits
are ranges of each component of the rotation vector relative to a joint's mean rotation.
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
"""Radians by which a joint may exceed its recorded range."""


@dataclass(frozen=True, eq=False)
class JointLimits:
    """The rotation range of each joint.

    Attributes:
        joints: names of J joints.
        mean: (J, 4) mean local rotations, quaternions.
        low: (J, 3) lower limits of the rotation vector from the mean, radians, with margin.
        high: (J, 3) upper limits.
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
            joints: names of the joints; leave out the root, which has no limits.

        Raises:
            MotionError: no motions, or a joint that one of them lacks.
        """
        rotations = [_rotations(motion, joints) for motion in motions]
        if not rotations:
            raise MotionError("no recording to learn joint limits from")
        stacked = np.concatenate(rotations)
        mean = np.stack([mean_quaternion(stacked[:, j]) for j in range(stacked.shape[1])])
        away = _away(stacked, mean)
        return cls(tuple(joints), mean, away.min(axis=0) - MARGIN, away.max(axis=0) + MARGIN)


def joint_limit_share(motion: Motion, limits: JointLimits) -> float:
    """Return the fraction of joints and frames beyond the limits on any axis, 0 to 1.

    Raises:
        MotionError: the motion lacks a joint of the limits.
    """
    away = _away(_rotations(motion, limits.joints), limits.mean)
    return float(((away < limits.low) | (away > limits.high)).any(axis=-1).mean())


def _rotations(motion: Motion, joints: Sequence[str]) -> np.ndarray:
    return motion.rotations[:, [motion.skeleton.index(name) for name in joints]]


def _away(rotations: np.ndarray, mean: np.ndarray) -> np.ndarray:
    return rotation_vector_from_quaternion(
        multiply_quaternions(invert_quaternions(mean), rotations)
    )
