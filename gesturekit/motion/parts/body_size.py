"""Body size, by which speeds, distances and thresholds are scaled, and plausible end sites.

End sites mark the end of a bone. A BVH file needs one on each leaf joint, and exporters without
data write a placeholder: as long as the bone before it but pointing up (Blender on Mixamo's rigs),
the same vector everywhere, or beyond a joint that already marks the end ("LeftToe_End"). Toes and
fingertips drawn from these point up.
"""

from __future__ import annotations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.parts import arm_length, find_parts, leg_length
from gesturekit.motion.parts.finder import bare_name
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
        fork = first_fork(skeleton)
        body = skeleton.rest_positions[[fork, *skeleton.descendants(fork)]]
        height = float(np.ptp(body, axis=0).max())
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


_MARKERS = ("end", "nub", "site", "headtop")
"""Name endings of joints that are themselves the end of a bone."""
_OFF = np.cos(np.deg2rad(45.0))
"""Cosine of the largest angle between a plausible end site and the bone before it."""
_SAME = 1e-3
"""Relative difference of lengths and vectors that an exporter copied: rounding."""
_COPIES = 3
"""Number of equal end sites from which they are placeholders; left and right make two."""
_LONGEST, _LONGER = 0.25, 1.6
"""Largest plausible length, as a share of the body (0.35 m on an adult) and of the bone before. It
must exceed both to be rejected: a forearm with its hand is long, but so is the upper arm."""


def real_end_sites(skeleton: Skeleton) -> dict[str, tuple[np.ndarray, ...]]:
    """Return joint name to the offsets (3,) of its plausible end sites; independent of scale."""
    named = [(name, site) for name, sites in skeleton.end_sites.items() for site in sites]
    if not named:
        return {}
    sites = np.stack([site for _, site in named])
    bones = skeleton.offsets[[skeleton.index(name) for name, _ in named]]
    length, bone = np.linalg.norm(sites, axis=1), np.linalg.norm(bones, axis=1)
    off = (sites * bones).sum(axis=1) < _OFF * length * bone
    copied = (np.abs(length - bone) <= _SAME * bone) | (_n_alike(sites) >= _COPIES)
    too_long = length > np.maximum(_LONGEST * body_size(skeleton), _LONGER * bone)
    real: dict[str, list[np.ndarray]] = {}
    for (name, site), made_up in zip(named, (off & copied) | too_long):
        joint = skeleton.index(name)
        marks_end = not skeleton.children(joint) and bare_name(name, "").endswith(_MARKERS)
        if joint == 0 or not (made_up or marks_end):
            real.setdefault(name, []).append(site)
    return {name: tuple(sites) for name, sites in real.items()}


def _n_alike(sites: np.ndarray) -> np.ndarray:
    """Return how many of `sites` (N, 3) equal each one, itself included; counted up to _COPIES."""
    from scipy.spatial import KDTree

    kinds, of_kind, counts = np.unique(sites, axis=0, return_inverse=True, return_counts=True)
    nearest = np.arange(1, min(_COPIES, len(kinds)) + 1)
    away, which = KDTree(kinds).query(kinds, nearest)
    alike = away <= _SAME * np.linalg.norm(kinds, axis=1, keepdims=True)
    return (alike * counts[which]).sum(axis=1)[of_kind]
