"""Rigs for tests, as tables of joints."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gesturekit.motion import Motion, Skeleton

Bones = dict[str, tuple[str | None, tuple[float, float, float]]]
"""Joint: its parent, and its offset in metres."""

PERSON: Bones = {
    "Hips": (None, (0.0, 0.0, 0.0)),
    "Spine": ("Hips", (0.0, 0.1, 0.0)),
    "Chest": ("Spine", (0.0, 0.2, 0.0)),
    "Neck": ("Chest", (0.0, 0.2, 0.0)),
    "Head": ("Neck", (0.0, 0.1, 0.0)),
    "LeftShoulder": ("Chest", (0.05, 0.15, 0.0)),
    "LeftArm": ("LeftShoulder", (0.12, 0.0, 0.0)),
    "LeftForeArm": ("LeftArm", (0.28, 0.0, 0.0)),
    "LeftHand": ("LeftForeArm", (0.25, 0.0, 0.0)),
    "RightShoulder": ("Chest", (-0.05, 0.15, 0.0)),
    "RightArm": ("RightShoulder", (-0.12, 0.0, 0.0)),
    "RightForeArm": ("RightArm", (-0.28, 0.0, 0.0)),
    "RightHand": ("RightForeArm", (-0.25, 0.0, 0.0)),
    "LeftUpLeg": ("Hips", (0.1, -0.05, 0.0)),
    "LeftLeg": ("LeftUpLeg", (0.0, -0.42, 0.0)),
    "LeftFoot": ("LeftLeg", (0.0, -0.42, 0.0)),
    "RightUpLeg": ("Hips", (-0.1, -0.05, 0.0)),
    "RightLeg": ("RightUpLeg", (0.0, -0.42, 0.0)),
    "RightFoot": ("RightLeg", (0.0, -0.42, 0.0)),
}
# Faces +Z: its spine is level, its head in front, its tail behind.
QUADRUPED: Bones = {
    "Pelvis": (None, (0.0, 0.0, 0.0)),
    "Spine": ("Pelvis", (0.0, 0.02, 0.3)),
    "Chest": ("Spine", (0.0, -0.02, 0.3)),
    "Neck": ("Chest", (0.0, 0.2, 0.15)),
    "Head": ("Neck", (0.0, 0.2, 0.15)),
    "Tail1": ("Pelvis", (0.0, 0.05, -0.2)),
    "Tail2": ("Tail1", (0.0, -0.2, -0.1)),
    **{
        f"{side}{joint}": (parent.format(side), offset)
        for side, x in (("Left", 0.15), ("Right", -0.15))
        for joint, parent, offset in (
            ("UpperArm", "Chest", (x, -0.1, 0.0)),
            ("ForeArm", "{}UpperArm", (0.0, -0.35, 0.0)),
            ("Hand", "{}ForeArm", (0.0, -0.3, 0.02)),
            ("UpLeg", "Pelvis", (x, -0.08, 0.0)),
            ("Leg", "{}UpLeg", (0.0, -0.37, 0.0)),
            ("Foot", "{}Leg", (0.0, -0.3, 0.02)),
        )
    },
}


def rig_of(bones: Bones, **more: Any) -> Skeleton:
    """Return the skeleton of a table; parents stand before their children."""
    names = tuple(bones)
    parents = tuple(-1 if parent is None else names.index(parent) for parent, _ in bones.values())
    return Skeleton(names, parents, np.array([offset for _, offset in bones.values()]), **more)


_LIMBS = {"shoulder": "Arm", "elbow": "ForeArm", "hip": "UpLeg", "knee": "Leg", "ankle": "Foot"}


def nameless(motion: Motion) -> tuple[Motion, dict[str, str]]:
    """Return a motion of a person with joints named by number, without end sites; and its parts."""
    rig = motion.skeleton
    names = tuple(f"Joint{j}" for j in range(rig.n_joints))
    parts = {
        f"{side}_{part}": names[rig.index(side.title() + joint)]
        for side in ("left", "right")
        for part, joint in _LIMBS.items()
    }
    return replace(motion, skeleton=replace(rig, names=names, end_sites={})), parts


def prefixed(motion: Motion, prefix: str = "mixamorig:") -> Motion:
    """Return a motion whose joints' names have a prefix, as those of other programs have."""
    rig = motion.skeleton
    names = tuple(prefix + name for name in rig.names)
    end_sites = {prefix + name: sites for name, sites in rig.end_sites.items()}
    return replace(motion, skeleton=replace(rig, names=names, end_sites=end_sites))
