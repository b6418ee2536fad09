"""A motion on some of its joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import invert_quaternions, multiply_quaternions, rotate_vectors
from gesturekit.motion.skeleton import Skeleton

STILL = 2.5e-6
"""Metres on the reference body that a place may vary by and still be an offset: rounding, not
movement."""


def keep_joints(motion: Motion, names: Sequence[str]) -> Motion:
    """Cut all joints but `names`; those that stay lie and turn in the world as before.

    A joint whose parent is cut hangs on the nearest joint above that stays. Where a cut joint
    turned between them, its place under the new parent varies, and it moves by
    `joint_translations`. A joint that has lost all its children gets an end site where its bone
    stopped: at the child that was cut, or amid them (the knuckles of a hand).

    Args:
        motion: what to cut.
        names: the joints to keep, in any order.

    Raises:
        MotionError: none, an unknown one, or joints without a kept joint above them all.
    """
    skeleton = motion.skeleton
    kept = sorted({skeleton.index(name) for name in names})
    if len(kept) == skeleton.n_joints:
        return motion
    parent = _kept_parents(skeleton, kept)
    root = kept[0]
    rotations = motion.rotations.copy()
    offsets = skeleton.offsets.copy()
    moving = {name: motion.joint_translations[name] for name in motion.joint_translations}
    translation = motion.translation
    still = STILL * body_scale(skeleton)
    if any(parent[j] != skeleton.parents[j] for j in kept):
        turned, places = motion.global_rotations(), motion.positions()
        for j in kept:
            if j == root:
                rotations[:, j], translation = turned[:, j], places[:, j]
                offsets[j] = skeleton.offsets[[j, *skeleton.ancestors(j)]].sum(axis=0)
                moving.pop(skeleton.names[j], None)
            elif parent[j] != skeleton.parents[j]:
                back = invert_quaternions(turned[:, parent[j]])
                rotations[:, j] = multiply_quaternions(back, turned[:, j])
                place = rotate_vectors(back, places[:, j] - places[:, parent[j]])
                low, high = place.min(axis=0), place.max(axis=0)
                offsets[j] = (low + high) / 2
                moving.pop(skeleton.names[j], None)
                if (high - low > still).any():
                    moving[skeleton.names[j]] = place
    number = {j: k for k, j in enumerate(kept)}
    rig = Skeleton(
        names=tuple(skeleton.names[j] for j in kept),
        parents=tuple(number.get(parent[j], -1) for j in kept),
        offsets=offsets[kept],
        end_sites=_ends(skeleton, kept),
        rotation_orders=tuple(skeleton.rotation_orders[j] for j in kept),
        parts={
            part: name for part, name in skeleton.parts.items() if skeleton.index(name) in number
        },
    )
    return replace(
        motion,
        skeleton=rig,
        rotations=rotations[:, kept],
        translation=translation,
        joint_translations={k: v for k, v in moving.items() if k in rig.names},
        info=dict(motion.info),
    )


def _kept_parents(skeleton: Skeleton, kept: Sequence[int]) -> dict[int, int]:
    """The nearest kept joint above each kept one, -1 for the root, which comes first."""
    if not kept:
        raise MotionError("no joints to keep; name at least one")
    staying = set(kept)
    above = {j: next((a for a in skeleton.ancestors(j) if a in staying), -1) for j in kept}
    roots = [j for j in kept if above[j] < 0]
    if len(roots) > 1:
        first, second = roots[:2]
        over_first = set(skeleton.ancestors(first))
        common = next(j for j in skeleton.ancestors(second) if j in over_first)
        raise MotionError(
            f"no joint that stays lies above both {skeleton.names[first]!r} and "
            f"{skeleton.names[second]!r}; keep {skeleton.names[common]!r} too"
        )
    return above


def _ends(skeleton: Skeleton, kept: Sequence[int]) -> dict[str, tuple[np.ndarray, ...]]:
    staying = set(kept)
    ends = {}
    for j in kept:
        sites = skeleton.end_sites.get(skeleton.names[j], ())
        children = skeleton.children(j)
        is_bare = children and not staying & set(skeleton.descendants(j))
        if is_bare and not sites:
            sites = (skeleton.offsets[list(children)].mean(axis=0),)
        if sites:
            ends[skeleton.names[j]] = tuple(sites)
    return ends
