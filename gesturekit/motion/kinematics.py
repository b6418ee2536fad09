"""From local rotations to places in the world (numpy; `torch_kinematics` is the other half)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gesturekit.motion.rotations import multiply_quaternions, rotate_vectors
from gesturekit.motion.skeleton import Skeleton


def global_rotations(rotations: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """(..., J, 4) quaternions from each joint's frame to the world, of local ones (..., J, 4)."""
    rotations = np.asarray(rotations, dtype=np.float64)
    turned = rotations.copy()
    for joints, parents in _levels(skeleton):
        turned[..., joints, :] = multiply_quaternions(
            turned[..., parents, :], rotations[..., joints, :]
        )
    return turned


def forward_kinematics(
    rotations: np.ndarray,
    translation: np.ndarray,
    skeleton: Skeleton,
    joint_translations: Mapping[str, np.ndarray] | None = None,
) -> np.ndarray:
    """World positions of all joints.

    Args:
        rotations: (..., J, 4) local unit quaternions.
        translation: (..., 3) of the root joint, metres; it replaces the root's offset.
        skeleton: the rig.
        joint_translations: joint name to (..., 3), metres; it replaces that joint's offset.

    Returns:
        (..., J, 3), metres.
    """
    turned = global_rotations(rotations, skeleton)
    local = np.broadcast_to(skeleton.offsets, (*turned.shape[:-1], 3))
    if joint_translations:
        local = local.copy()
        for name, places in joint_translations.items():
            local[..., skeleton.index(name), :] = places
    positions = np.empty(local.shape)
    positions[..., 0, :] = translation
    for joints, parents in _levels(skeleton):
        step = rotate_vectors(turned[..., parents, :], local[..., joints, :])
        positions[..., joints, :] = positions[..., parents, :] + step
    return positions


def _levels(skeleton: Skeleton) -> list[tuple[list[int], list[int]]]:
    """Joints of depth 1, 2, ... with their parents: one level at a time, not one joint."""
    levels: list[tuple[list[int], list[int]]] = [([], []) for _ in range(max(skeleton.depth))]
    for j, parent in enumerate(skeleton.parents[1:], start=1):
        joints, parents = levels[skeleton.depth[j] - 1]
        joints.append(j)
        parents.append(parent)
    return levels
