"""Body size: the length by which speeds, distances and thresholds are scaled to a body."""

from __future__ import annotations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.kinematics import forward_kinematics
from gesturekit.motion.parts import arm_length, find_parts, leg_length
from gesturekit.motion.rotations import IDENTITY
from gesturekit.motion.skeleton import Skeleton

REFERENCE_SIZE = 1.4
"""Metres; size of the body that every constant in metres or m/s is given for, an adult of 1.7 m."""

_ABOVE_AND_BELOW = 0.16
"""Share of a body's height that is above the head's joint and below the ankles'."""

_STATURE_PER_ARM, _STATURE_PER_UPPER_ARM = 2.75, 5.3
"""Stature over the length of upper arm and forearm, and of the upper arm alone: 2.74 to 2.85, and
5.05 to 5.7, on adults and on the rigs of five datasets."""

# Longest chain of bones between two leaves over legs and spine, on adults without fingers.
_CHAIN_PER_STATURE = 1.54


def stature(skeleton: Skeleton) -> float:
    """Return the length of the bones from the ankles (mean of both) to the head, metres.

    That of a rig without legs is estimated from its arms: what the whole person would have.

    Raises:
        MotionError: legs or spine cannot be identified; see `gesturekit.motion.parts.find_parts`.
    """
    parts = find_parts(skeleton)
    if not parts.legs:
        upper, lower = arm_length(skeleton)
        return _STATURE_PER_ARM * (upper + lower) if lower else _STATURE_PER_UPPER_ARM * upper
    pelvis = skeleton.index(parts.pelvis)
    joint, length = skeleton.index(parts.head or parts.spine[-1]), leg_length(skeleton)
    while joint not in (pelvis, -1):
        length += float(np.linalg.norm(skeleton.offsets[joint]))
        joint = skeleton.parents[joint]
    return length


def body_size(skeleton: Skeleton) -> float:
    """Return the size of any rig, metres: its stature, or a length like it for other trees.

    Rigs whose legs or spine cannot be identified (a crab, a snake, a lone arm) are measured by
    their longest chain of bones between two leaves, divided by what that chain is to stature on an
    adult. Joints above the first fork hold no bone and do not count, nor do end sites. A rig
    scaled by c has c times the size; a rig without any bone has `REFERENCE_SIZE`.
    """
    try:
        size = stature(skeleton)
    except MotionError:
        size = _longest_chain(skeleton) / _CHAIN_PER_STATURE
    return size if size > 0 else REFERENCE_SIZE


def body_height(skeleton: Skeleton) -> float:
    """Return the height of a body that stands upright, sole to crown, metres.

    Rigs whose legs or spine cannot be identified have the largest extent of their rest pose,
    joints above the first fork left out. A rig scaled by c has c times the height.

    Raises:
        MotionError: a rig without any bone.
    """
    try:
        height = stature(skeleton) / (1 - _ABOVE_AND_BELOW)
    except MotionError:
        rest = np.broadcast_to(IDENTITY, (skeleton.n_joints, 4))
        fork = first_fork(skeleton)
        places = forward_kinematics(rest, np.zeros(3), skeleton)
        height = float(np.ptp(places[[fork, *skeleton.descendants(fork)]], axis=0).max())
    if height <= 0:
        raise MotionError("the rig has no bone of any length, and so no height")
    return height


def body_scale(skeleton: Skeleton) -> float:
    """Return `body_size` over `REFERENCE_SIZE`: multiply a length or speed threshold by it."""
    return body_size(skeleton) / REFERENCE_SIZE


def first_fork(skeleton: Skeleton) -> int:
    """Return the first joint with more than one child (0 if none): joints above hold no bone."""
    return next((j for j in range(skeleton.n_joints) if len(skeleton.children(j)) > 1), 0)


def _longest_chain(skeleton: Skeleton) -> float:
    """Return the length of the longest path along bones between two joints below the first fork."""
    bones = np.linalg.norm(skeleton.offsets, axis=1)
    depth = np.zeros(skeleton.n_joints)  # of the longest branch found so far below each joint
    longest, fork = 0.0, first_fork(skeleton)
    for joint in reversed(range(fork + 1, skeleton.n_joints)):
        parent, branch = skeleton.parents[joint], depth[joint] + bones[joint]
        longest = max(longest, depth[parent] + branch)
        depth[parent] = max(depth[parent], branch)
    return float(longest)
