"""Forward kinematics in numpy; see `torch_kinematics` for the differentiable version."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gesturekit.motion.rotations import product_components, rotated_components
from gesturekit.motion.skeleton import Skeleton

GROUND = [0, 2]
"""Columns x and z of positions (..., 3): the ground plane, Y up."""


def global_rotations(rotations: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """(..., J, 4) rotations from each joint's frame to the world, from local ones (..., J, 4)."""
    return _components_last(_global_components(rotations, skeleton))


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
    world = _global_components(rotations, skeleton)
    frames = world.shape[2:]
    local = skeleton.offsets.T.reshape(3, -1, *(1 for _ in frames))
    if joint_translations:
        local = np.broadcast_to(local, (3, *world.shape[1:])).copy()
        for name, values in joint_translations.items():
            local[:, skeleton.index(name)] = np.moveaxis(np.asarray(values), -1, 0)
    positions = np.empty((3, *world.shape[1:]))
    positions[:, 0] = np.moveaxis(np.broadcast_to(translation, (*frames, 3)), -1, 0)
    for joints, parents in _levels(skeleton):
        steps = rotated_components(world[:, parents], local[:, joints])
        for axis, step in zip(positions, steps, strict=True):
            axis[joints] = axis[parents] + step
    return _components_last(positions)


def _global_components(rotations: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the components (4, J, ...) of `global_rotations`."""
    local = _components_first(np.asarray(rotations, dtype=np.float64))
    world = local.copy()
    for joints, parents in _levels(skeleton):
        products = product_components(world[:, parents], local[:, joints])
        for component, values in zip(world, products, strict=True):
            component[joints] = values
    return world


def _components_first(values: np.ndarray) -> np.ndarray:
    """Return values (..., J, D) as (D, J, ...): numpy is faster with frames next to each other."""
    return np.ascontiguousarray(np.moveaxis(values, (-1, -2), (0, 1)))


def _components_last(values: np.ndarray) -> np.ndarray:
    """Return values (D, J, ...) as (..., J, D)."""
    return np.ascontiguousarray(np.moveaxis(values, (0, 1), (-1, -2)))


def _levels(skeleton: Skeleton) -> list[tuple[list[int], list[int]]]:
    """Return (joints, their parents) for each depth 1, 2, ..., to vectorise over a level."""
    levels: list[tuple[list[int], list[int]]] = [([], []) for _ in range(max(skeleton.depth))]
    for j, parent in enumerate(skeleton.parents[1:], start=1):
        joints, parents = levels[skeleton.depth[j] - 1]
        joints.append(j)
        parents.append(parent)
    return levels
