"""Forward kinematics in numpy; see `torch_kinematics` for the differentiable version."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gesturekit.motion.rotations import multiply_quaternions, rotate_vectors
from gesturekit.motion.skeleton import Skeleton

GROUND = [0, 2]
"""Columns x and z of positions (..., 3): the ground plane, Y up."""


def global_rotations(rotations: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """(..., J, 4) rotations from each joint's frame to the world, from local ones (..., J, 4)."""
    rotations = np.asarray(rotations, dtype=np.float64)
    world = rotations.copy()
    for joints, parents in _levels(skeleton):
        world[..., joints, :] = multiply_quaternions(
            world[..., parents, :], rotations[..., joints, :]
        )
    return world


def forward_kinematics(
    rotations: np.ndarray,
    translation: np.ndarray,
    skeleton: Skeleton,
    joint_translations: Mapping[str, np.ndarray] | None = None,
) -> np.ndarray:
    """Return the world positions of all joints.

    Args:
        rotations: (..., J, 4) local unit quaternions.
        translation: (..., 3) root position, metres; it replaces the root's offset.
        skeleton: the rig.
        joint_translations: joint name to (..., 3), metres; it replaces that joint's offset.

    Returns:
        (..., J, 3), metres.
    """
    world = global_rotations(rotations, skeleton)
    local = np.broadcast_to(skeleton.offsets, (*world.shape[:-1], 3))
    if joint_translations:
        local = local.copy()
        for name, values in joint_translations.items():
            local[..., skeleton.index(name), :] = values
    positions = np.empty(local.shape)
    positions[..., 0, :] = translation
    for joints, parents in _levels(skeleton):
        step = rotate_vectors(world[..., parents, :], local[..., joints, :])
        positions[..., joints, :] = positions[..., parents, :] + step
    return positions


def _levels(skeleton: Skeleton) -> list[tuple[list[int], list[int]]]:
    """Return (joints, their parents) for each depth 1, 2, ..., to vectorise over a level."""
    levels: list[tuple[list[int], list[int]]] = [([], []) for _ in range(max(skeleton.depth))]
    for j, parent in enumerate(skeleton.parents[1:], start=1):
        joints, parents = levels[skeleton.depth[j] - 1]
        joints.append(j)
        parents.append(parent)
    return levels
