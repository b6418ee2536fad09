"""A motion as seen in a mirror: left and right exchanged, x turned into -x.

A reflection is no rotation, so each joint's frame is reflected too. With M = diag(-1, 1, 1) the
world's mirror, G_j the rotation from joint j's frame to the world and j' the counterpart of j,

    G'_j' = M G_j S_j,    so that locally    L'_j' = S_p L_j S_j    (p the parent of j),

and offsets, end sites and moving places within frame j turn by S_j. Each S_j is one of diag(-1,
1, 1), diag(1, -1, 1), diag(1, 1, -1) and -I: how the frames of left and right relate is up to who
made the rig. Whatever the choice, the mirrored bones lie exactly where the mirror shows them; the
right choice makes the mirrored angles mean what the rig's own angles mean.

- Where left and right offsets are reflections of each other by one and the same S, as in every rig
  whose rest pose is a T-pose with parallel frames (ZEGGS, Mixamo, SMPL), that S serves all joints.
- Else (rigs with bones along their own x axes, such as Bandai-Namco's) each S_j is the one that
  reflects offsets best; where offsets leave a choice, the one that makes the mirrored motion's
  local rotations most like those of the motion itself, as people move alike on both sides.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import left_right_pairs
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    rotation_angles,
)
from gesturekit.motion.skeleton import Skeleton

# S = -H with H a half turn about x, y or z, or none: as diagonals, and H as quaternions.
_REFLECTIONS = np.array([[-1.0, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, -1]])
_HALF_TURNS = np.eye(4)
_WORLD = 0
_PARALLEL = 0.1
"""Left and right bones may differ by this share of their lengths and still be reflections."""
_AS_MUCH_AS_A_RADIAN = 1e-3
"""Metres on the reference body that a reflected offset may lie off, for a radian that a rotation
may."""
_ALIKE = 0.1
"""In this share of the frames, at least, people stand alike on both sides."""
_CHANGE = 1.0
"""Radians that the rest must speak for a frame reflected unlike its parent's."""
_FRAMES = 300
"""As many frames tell how left and right relate."""


def mirror_motion(motion: Motion) -> Motion:
    """Exchange left and right, and reflect x.

    The skeleton is mirrored with it (a longer left arm becomes a longer right arm), so that the
    joints lie exactly where the mirror shows their counterparts. Counterparts are told as
    `gesturekit.motion.parts.left_right_pairs` tells them; joints without one are their own. Face
    expressions stay as they are: their coefficients do not say what is left.

    Raises:
        MotionError: a rig with limbs of which none can be told to be left and right.
    """
    skeleton = motion.skeleton
    other = _counterparts(skeleton)
    if not can_be_mirrored(skeleton):
        raise MotionError(
            "cannot tell left from right by joint names or shape, so that the rig cannot be "
            "mirrored; name limbs by hand (parts: left_elbow: JOINT, right_elbow: JOINT, ...)"
        )
    kind = _reflections(motion, other)
    above = np.array([kind[p] if p >= 0 else _WORLD for p in skeleton.parents])
    rotations = np.empty_like(motion.rotations)
    rotations[:, other] = _reflected(motion.rotations, above, kind)
    offsets = np.empty_like(skeleton.offsets)
    offsets[other] = skeleton.offsets * _REFLECTIONS[above]
    names = skeleton.names
    ends = {
        names[other[j]]: tuple(site * _REFLECTIONS[kind[j]] for site in skeleton.end_sites[name])
        for j, name in enumerate(names)
        if name in skeleton.end_sites
    }
    moving = {
        names[other[j]]: motion.joint_translations[name] * _REFLECTIONS[above[j]]
        for j, name in enumerate(names)
        if name in motion.joint_translations
    }
    return replace(
        motion,
        skeleton=replace(skeleton, offsets=offsets, end_sites=ends),
        rotations=rotations,
        translation=motion.translation * _REFLECTIONS[_WORLD],
        joint_translations=moving,
        info=dict(motion.info),
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
        # Where parents are no counterparts of each other, the names deceive.
        if i and j and other[skeleton.parents[i]] == skeleton.parents[j]:
            other[i], other[j] = j, i
    return other


def _reflected(rotations: np.ndarray, above: np.ndarray, own: np.ndarray) -> np.ndarray:
    """S_p L S_j as quaternions: the two minus signs cancel, half turns are left."""
    turned = multiply_quaternions(_HALF_TURNS[above], rotations)
    return multiply_quaternions(turned, invert_quaternions(_HALF_TURNS[own]))


def _reflections(motion: Motion, other: np.ndarray) -> np.ndarray:
    """(J,) which S each joint's frame has; counterparts have the same."""
    skeleton = motion.skeleton
    n = skeleton.n_joints
    # mismatch[j, s]: by how much S fails to reflect the bone to joint j onto its counterpart.
    bones = skeleton.offsets[:, None] * _REFLECTIONS - skeleton.offsets[other][:, None]
    mismatch = np.linalg.norm(bones, axis=-1)
    fixed = [j for j in range(1, n) if skeleton.names[j] not in motion.joint_translations]
    lengths = np.linalg.norm(skeleton.offsets[fixed], axis=-1).sum()
    total = mismatch[fixed].sum(axis=0)
    if total.min() <= _PARALLEL * max(lengths, 1e-9):
        return np.full(n, total.argmin())
    return _by_joint(motion, other, mismatch, fixed)


def _by_joint(
    motion: Motion, other: np.ndarray, mismatch: np.ndarray, fixed: list[int]
) -> np.ndarray:
    """The cheapest choice for the whole tree: each joint's depends on its parent's (Viterbi)."""
    skeleton = motion.skeleton
    n = skeleton.n_joints
    every = max(1, motion.n_frames // _FRAMES)
    rotations = motion.rotations[::every]
    # Above the pelvis frames are the world's, and nobody faces the same way as in the mirror: there
    # is nothing to learn from rotations down to the first fork.
    fork = next((j for j in range(n) if len(skeleton.children(j)) > 1), 0)
    # cost[j, s]: of the frame of j being reflected by s, with all that hangs on it.
    cost = np.zeros((n, 4))
    choice = np.full((n, 4), _WORLD)
    radian = _AS_MUCH_AS_A_RADIAN * body_scale(skeleton)
    for j in fixed:
        cost[skeleton.parents[j]] += mismatch[j] / radian
    for j in reversed(range(fork, n)):
        for above in range(4):
            total = cost[j].copy()
            if j != fork:
                total += _CHANGE * (np.arange(4) != above)
                for own in range(4):
                    mirrored = _reflected(rotations[:, j], np.array(above), np.array(own))
                    unlike = rotation_angles(mirrored, rotations[:, other[j]])
                    total[own] += np.quantile(unlike, _ALIKE)
            choice[j, above] = total.argmin()
            if j != fork:
                cost[skeleton.parents[j], above] += total.min()
    kind = np.zeros(n, dtype=np.int64)
    for j, parent in enumerate(skeleton.parents):
        kind[j] = choice[j, kind[parent] if parent >= 0 else _WORLD]
        if other[j] < j:
            kind[j] = kind[other[j]]
    return kind
