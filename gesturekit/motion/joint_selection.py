"""Removal of joints from a motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.kinematics import forward_kinematics, global_rotations
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import invert_quaternions, multiply_quaternions, rotate_vectors
from gesturekit.motion.skeleton import Skeleton

STILL = 2.5e-6
"""Metres on the reference body; a position that varies by less is a constant offset."""


def keep_joints(
    skeleton: Skeleton,
    rotations: np.ndarray,
    translation: np.ndarray,
    moving: Mapping[str, np.ndarray],
    names: Sequence[str],
) -> tuple[Skeleton, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return rig and movement without all joints but `names`, which stay where they are.

    A joint whose parent is removed becomes a child of its nearest kept ancestor. If a removed
    joint between them rotates, the position under the new parent varies and is stored among the
    joints that move. A joint that loses all its children gets an end site at the removed child, or
    at the mean of several (the knuckles of a hand).

    Args:
        skeleton: J joints.
        rotations: (T, J, 4) local quaternions.
        translation: (T, 3) root positions, metres.
        moving: joint name to (T, 3) positions in the parent's frame, metres.
        names: the joints to keep, in any order.

    Raises:
        MotionError: no names, an unknown one, or no kept joint above all others.
    """
    kept = sorted({skeleton.index(name) for name in names})
    parent = _kept_parents(skeleton, kept)
    root = kept[0]
    below_others = [j for j in kept if parent[j] != skeleton.parents[j]]
    if below_others:  # not if leaves go, such as fingers
        world = global_rotations(rotations, skeleton)
        positions = forward_kinematics(rotations, translation, skeleton, moving)
    rotations, offsets, moving = rotations.copy(), skeleton.offsets.copy(), dict(moving)
    still = STILL * body_scale(skeleton)
    for j in below_others:
        moving.pop(skeleton.names[j], None)
        if j == root:
            rotations[:, j], translation = world[:, j], positions[:, j]
            offsets[j] = skeleton.offsets[[j, *skeleton.ancestors(j)]].sum(axis=0)
            continue
        back = invert_quaternions(world[:, parent[j]])
        rotations[:, j] = multiply_quaternions(back, world[:, j])
        local = rotate_vectors(back, positions[:, j] - positions[:, parent[j]])
        low, high = local.min(axis=0), local.max(axis=0)
        offsets[j] = (low + high) / 2
        if (high - low > still).any():
            moving[skeleton.names[j]] = local
    number = {j: k for k, j in enumerate(kept)}
    rig = Skeleton(
        names=tuple(skeleton.names[j] for j in kept),
        parents=tuple(number.get(parent[j], -1) for j in kept),
        offsets=offsets[kept],
        end_sites=_end_sites(skeleton, kept),
        rotation_orders=tuple(skeleton.rotation_orders[j] for j in kept),
        parts={p: name for p, name in skeleton.parts.items() if skeleton.index(name) in number},
        body_shape=skeleton.body_shape,
    )
    moving = {name: values for name, values in moving.items() if name in rig.names}
    return rig, rotations[:, kept], translation, moving


def _kept_parents(skeleton: Skeleton, kept: Sequence[int]) -> dict[int, int]:
    """Return kept joint to its nearest kept ancestor, -1 for the root, which comes first."""
    if not kept:
        raise MotionError("no joints to keep; name at least one")
    staying = set(kept)
    above = {j: next((a for a in skeleton.ancestors(j) if a in staying), -1) for j in kept}
    roots = [j for j in kept if above[j] < 0]
    if len(roots) > 1:
        first, second = roots[:2]
        above_first = set(skeleton.ancestors(first))
        common = next(j for j in skeleton.ancestors(second) if j in above_first)
        raise MotionError(
            f"no kept joint lies above both {skeleton.names[first]!r} and "
            f"{skeleton.names[second]!r}; keep {skeleton.names[common]!r} too"
        )
    return above


def _end_sites(skeleton: Skeleton, kept: Sequence[int]) -> dict[str, tuple[np.ndarray, ...]]:
    """Return joint name to offsets (3,) of its end sites, added ones included, metres."""
    staying = set(kept)
    ends = {}
    for j in kept:
        sites = skeleton.end_sites.get(skeleton.names[j], ())
        children = skeleton.children(j)
        lost_all = children and not staying & set(skeleton.descendants(j))
        if lost_all and not sites:
            sites = (skeleton.offsets[list(children)].mean(axis=0),)
        if sites:
            ends[skeleton.names[j]] = tuple(sites)
    return ends
