"""Changes of a rig with its motion: removal of joints, and mirroring.

Mirroring exchanges left and right, and turns x into -x.

A reflection is not a rotation, so each joint's frame is reflected too. With M = diag(-1, 1, 1) the
mirror of the world, G_j the rotation from joint j's frame to the world, j' the counterpart of j and
p the parent of j,

    G'_j' = M G_j S_j,    and locally    L'_j' = S_p L_j S_j.

Offsets, end sites and joint translations within frame j are multiplied by S_j. Each S_j is one of
diag(-1, 1, 1), diag(1, -1, 1), diag(1, 1, -1) and -I. The mirrored joint positions are exact for
every choice; the right choice also gives the mirrored angles the meaning they have on the rig.

- If one S reflects all left offsets onto the right ones, that S is used for all joints. This holds
  for every rig whose rest pose is a T-pose with parallel frames (ZEGGS, Mixamo, SMPL).
- Otherwise (rigs with bones along their own x axes, such as Bandai-Namco's) each S_j is the one
  that reflects the offsets best. Where the offsets allow several, the mirrored local rotations
  should resemble those of the motion itself, because people move alike on both sides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.parts import left_right_pairs
from gesturekit.motion.parts.body_size import body_scale, first_fork
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    rotate_vectors,
    rotation_angles,
)
from gesturekit.motion.skeleton import Skeleton, forward_kinematics, global_rotations

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

    See `Motion.keep`; an added end site is at the removed child, or at the mean of several (the
    knuckles of a hand).

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
    below_others = [j for j in kept if parent[j] != skeleton.parents[j]]
    if below_others:  # not if leaves go, such as fingers
        world = global_rotations(rotations, skeleton)
        positions = forward_kinematics(rotations, translation, skeleton, moving)
    rotations, offsets, moving = rotations.copy(), skeleton.offsets.copy(), dict(moving)
    still = STILL * body_scale(skeleton)
    for j in below_others:
        moving.pop(skeleton.names[j], None)
        if j == kept[0]:
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
    ends = {j: skeleton.end_sites.get(skeleton.names[j], ()) for j in kept}
    for j in kept:
        children = list(skeleton.children(j))
        if children and not ends[j] and number.keys().isdisjoint(skeleton.descendants(j)):
            ends[j] = (skeleton.offsets[children].mean(axis=0),)
    rig = Skeleton(
        names=tuple(skeleton.names[j] for j in kept),
        parents=tuple(number.get(parent[j], -1) for j in kept),
        offsets=offsets[kept],
        end_sites={skeleton.names[j]: sites for j, sites in ends.items() if sites},
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
        joints = (*roots[:2], skeleton.common_ancestor(*roots[:2]))
        one, two, three = (skeleton.names[j] for j in joints)
        raise MotionError(f"no kept joint lies above both {one!r} and {two!r}; keep {three!r} too")
    return above


# S = -H, H a half turn about x, y or z, or the identity: S as diagonals, H as quaternions.
_REFLECTIONS = np.array([[-1.0, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, -1]])
_HALF_TURNS = np.eye(4)
_WORLD = 0
_PARALLEL = 0.1
"""Largest mismatch of left and right offsets, as a share of their lengths, for parallel frames."""
_METRES_PER_RADIAN = 1e-3
"""Offset mismatch (metres on the reference body) that costs as much as one radian."""
_ALIKE = 0.1
"""Quantile over frames of the angle between the two sides: people are symmetric in some frames."""
_CHANGE = 1.0
"""Cost, radians, of a joint frame that is reflected by another S than its parent's."""
_FRAMES = 300
"""Number of frames that are compared, evenly spaced."""


def mirror(
    skeleton: Skeleton,
    rotations: np.ndarray,
    translation: np.ndarray,
    joint_translations: Mapping[str, np.ndarray],
) -> tuple[Skeleton, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Exchange left and right, and reflect x; see `Motion.mirror`.

    Args:
        skeleton: the rig, J joints.
        rotations: (T, J, 4) local unit quaternions.
        translation: (T, 3) root positions, metres.
        joint_translations: joint name to (T, 3), metres.

    Returns:
        The four mirrored arguments, in the same order.

    Raises:
        MotionError: a rig with limbs whose left and right cannot be identified.
    """
    if not can_be_mirrored(skeleton):
        raise MotionError("cannot tell left from right; name limbs (parts: left_elbow: JOINT, ...)")
    other = _counterparts(skeleton)
    kinds = _reflections(skeleton, rotations, joint_translations, other)
    parent = np.array([kinds[p] if p >= 0 else _WORLD for p in skeleton.parents])
    mirrored = np.empty_like(rotations)
    mirrored[:, other] = _reflected(rotations, parent, kinds)
    offsets = np.empty_like(skeleton.offsets)
    offsets[other] = skeleton.offsets * _REFLECTIONS[parent]
    names, end_sites, moving = skeleton.names, {}, {}
    for j, name in enumerate(names):
        if name in skeleton.end_sites:
            sites = skeleton.end_sites[name]
            end_sites[names[other[j]]] = tuple(site * _REFLECTIONS[kinds[j]] for site in sites)
        if name in joint_translations:
            moving[names[other[j]]] = joint_translations[name] * _REFLECTIONS[parent[j]]
    return (
        replace(skeleton, offsets=offsets, end_sites=end_sites),
        mirrored,
        translation * _REFLECTIONS[_WORLD],
        moving,
    )


def can_be_mirrored(skeleton: Skeleton) -> bool:
    """Return whether left and right of a rig can be identified, or it has no limbs at all."""
    forks = any(len(skeleton.children(j)) > 1 for j in range(skeleton.n_joints))
    return not forks or bool((_counterparts(skeleton) != np.arange(skeleton.n_joints)).any())


def _counterparts(skeleton: Skeleton) -> np.ndarray:
    """(J,) index of each joint's mirror image."""
    other = np.arange(skeleton.n_joints)
    for left, right in left_right_pairs(skeleton):
        i, j = skeleton.index(left), skeleton.index(right)
        # Names are not trusted if the parents are not counterparts of each other.
        if i and j and other[skeleton.parents[i]] == skeleton.parents[j]:
            other[i], other[j] = j, i
    return other


def _reflected(rotations: np.ndarray, parent: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return S_p L S_j as quaternions (..., 4): the minus signs cancel and half turns remain."""
    turned = multiply_quaternions(_HALF_TURNS[parent], rotations)
    return multiply_quaternions(turned, invert_quaternions(_HALF_TURNS[kind]))


def _reflections(
    skeleton: Skeleton,
    rotations: np.ndarray,
    joint_translations: Mapping[str, np.ndarray],
    other: np.ndarray,
) -> np.ndarray:
    """(J,) index of each joint's S in `_REFLECTIONS`; counterparts have the same.

    Without parallel frames it has the lowest total cost over the tree, by dynamic programming from
    leaves to root.
    """
    n = skeleton.n_joints
    # mismatch[j, s]: metres between the reflection of joint j's bone by S and its counterpart.
    bones = skeleton.offsets[:, None] * _REFLECTIONS - skeleton.offsets[other][:, None]
    mismatch = np.linalg.norm(bones, axis=2)
    fixed = [j for j in range(1, n) if skeleton.names[j] not in joint_translations]
    lengths = np.linalg.norm(skeleton.offsets[fixed], axis=1).sum()
    total = mismatch[fixed].sum(axis=0)
    if total.min() <= _PARALLEL * max(lengths, 1e-9):
        return np.full(n, total.argmin())
    rotations = rotations[:: max(1, len(rotations) // _FRAMES)]
    # Rotations above the first fork place the body in the world. They do not resemble their
    # mirror image, so they carry no evidence.
    fork = first_fork(skeleton)
    # cost[j, s]: cost of reflecting the frame of j by s, all joints below included.
    cost = np.zeros((n, 4))
    choice = np.full((n, 4), _WORLD)
    radian = _METRES_PER_RADIAN * body_scale(skeleton)
    for j in fixed:
        cost[skeleton.parents[j]] += mismatch[j] / radian
    for j in reversed(range(fork, n)):
        for parent in range(4):
            total = cost[j].copy()
            if j != fork:
                total += _CHANGE * (np.arange(4) != parent)
                for s in range(4):
                    mirrored = _reflected(rotations[:, j], np.array(parent), np.array(s))
                    angle = rotation_angles(mirrored, rotations[:, other[j]])
                    total[s] += np.quantile(angle, _ALIKE)
            choice[j, parent] = total.argmin()
            if j != fork:
                cost[skeleton.parents[j], parent] += total.min()
    kind = np.zeros(n, dtype=np.int64)
    for j, parent in enumerate(skeleton.parents):
        kind[j] = choice[j, kind[parent] if parent >= 0 else _WORLD]
        if other[j] < j:
            kind[j] = kind[other[j]]
    return kind
