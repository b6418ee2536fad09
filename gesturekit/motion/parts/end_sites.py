"""End sites: which of them are where a bone stops, and which an exporter made up.

A BVH file has to give each last joint an end site, and exporters that know none write one of their
own: as long as the bone before it but pointing up (Blender on Mixamo's rigs), one and the same
vector everywhere, or beyond a joint that marks the end already ("LeftToe_End"). Drawn, they make
toes and fingertips stick up.
"""

from __future__ import annotations

import numpy as np

from gesturekit.motion.body_size import body_size
from gesturekit.motion.parts.joint_names import bare_name
from gesturekit.motion.skeleton import Skeleton

_MARKERS = ("end", "nub", "site", "headtop")
"""Endings of names of joints that are the end of a bone themselves."""
_OFF = np.cos(np.deg2rad(45.0))
"""A bone goes on in its direction, or turns by less than this angle, where it stops."""
_SAME = 1e-3
"""Share by which lengths and vectors that an exporter has copied differ: rounding."""
_COPIES = 3
"""A vector at so many ends is no measurement: left and right are two."""
_LONGEST, _LONGER = 0.25, 1.6
"""No end is longer than this share of the body (0.35 m on an adult) and by this factor longer than
the bone before it: a forearm with its hand is, but the upper arm is nearly as long."""


def real_end_sites(skeleton: Skeleton) -> dict[str, tuple[np.ndarray, ...]]:
    """Return the end sites that can be ends of bones, by joint name; the same at any scale."""
    named = [(name, site) for name, sites in skeleton.end_sites.items() for site in sites]
    if not named:
        return {}
    sites = np.stack([site for _, site in named])
    bones = skeleton.offsets[[skeleton.index(name) for name, _ in named]]
    length, bone = np.linalg.norm(sites, axis=1), np.linalg.norm(bones, axis=1)
    off = (sites * bones).sum(axis=1) < _OFF * length * bone
    alike = np.linalg.norm(sites[:, None] - sites, axis=-1) <= _SAME * length[:, None]
    copied = (np.abs(length - bone) <= _SAME * bone) | (alike.sum(axis=1) >= _COPIES)
    too_long = length > np.maximum(_LONGEST * body_size(skeleton), _LONGER * bone)
    real: dict[str, tuple[np.ndarray, ...]] = {}
    for (name, site), made_up in zip(named, (off & copied) | too_long):
        joint = skeleton.index(name)
        marks_end = skeleton.is_leaf(joint) and bare_name(name, "").endswith(_MARKERS)
        if joint == 0 or not (made_up or marks_end):
            real[name] = (*real.get(name, ()), site)
    return real
