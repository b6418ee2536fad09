"""Constraints on the output of each level, applied before the next level adds detail.

This is inpainting in a coarse-to-fine pyramid: finer levels see the constrained part and fit the
rest to it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from torch import Tensor

from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    quaternion_from_sixd,
    sixd_from_quaternion,
)
from gesturekit.multires.motion_vector import VectorLayout

Constraint = Callable[[int, Tensor], Tensor]
"""constraint(level, output): the normalised output of a level, (1, D, T_i), with the constraint
applied. The next level starts from it."""

_MAX_STEP = 3.0
"""Limit of root steps that the next level gets, in standard deviations: far outside of the training
data its output is arbitrary."""


def turned(values: np.ndarray, angle: np.ndarray | float, layout: VectorLayout) -> np.ndarray:
    """Return motion vectors (T, D) turned about the world's Y axis.

    Args:
        values: (T, D) in their own units.
        angle: radians, (T,) or one for all frames.
        layout: columns of the vectors.
    """
    values = values.copy()
    angle = np.broadcast_to(angle, len(values))
    about_y = quaternion_from_rotation_vector(angle[:, None] * np.array([0.0, 1.0, 0.0]))
    root = quaternion_from_sixd(values[:, layout.root_rotation])
    root = multiply_quaternions(about_y, root)
    values[:, layout.root_rotation] = sixd_from_quaternion(root)
    values[:, layout.root_xz] = turned_plane(values[:, layout.root_xz], angle)
    return values


def clamped_steps(vectors: Tensor, layout: VectorLayout) -> Tensor:
    """Return normalised vectors (1, D, T) with root steps within `_MAX_STEP`."""
    vectors = vectors.clone()
    vectors[:, layout.root_xz] = vectors[:, layout.root_xz].clamp(-_MAX_STEP, _MAX_STEP)
    return vectors


def fastest_second(steps: np.ndarray, fps: float) -> float:
    """Return the ground speed (m/s) in the fastest second, or on average if there is less.

    Args:
        steps: (T, 2) displacement over the ground in each frame, m.
        fps: frames per second.
    """
    window = max(1, min(len(steps), round(fps)))
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    distance = np.linalg.norm(path[window:] - path[:-window], axis=1)
    return float(distance.max(initial=0.0) * fps / window)  # a single frame has no steps


def turned_plane(plane: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Return x and z (T, 2) turned about Y; a quarter turn takes +Z to +X."""
    x, z = plane.T
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.stack([x * cosine + z * sine, z * cosine - x * sine], axis=1)
