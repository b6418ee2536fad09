"""Plausible end sites: those that mark the end of a bone, and are not placeholders of an exporter.

A BVH file needs an end site on each leaf joint, and exporters without data write a placeholder: as
long as the bone before it but pointing up (Blender on Mixamo's rigs), the same vector everywhere,
or beyond a joint that already marks the end ("LeftToe_End"). Toes and fingertips drawn from these
point up.
"""

from __future__ import annotations

import numpy as np

from gesturekit.motion.parts.body_size import body_size
from gesturekit.motion.parts.joint_names import bare_name
from gesturekit.motion.skeleton import Skeleton

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
        marks_end = skeleton.is_leaf(joint) and bare_name(name, "").endswith(_MARKERS)
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
