"""Rigs for tests, as tables of joints."""

from dataclasses import replace
from typing import Any

import numpy as np

from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    rotate_vectors,
)

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


def at_rest(rig: Skeleton, n_frames: int, place: Any = (0.0, 0.0, 0.0), fps: float = 30) -> Motion:
    """Return frames in which no joint turns, the root at a place; its arrays may be changed."""
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (n_frames, rig.n_joints, 1))
    return Motion(rig, rotations, np.broadcast_to(place, (n_frames, 3)).copy(), fps)


def with_offsets(rig: Skeleton, **offsets: tuple[float, float, float]) -> Skeleton:
    """Return the rig with other offsets of some joints."""
    changed = rig.offsets.copy()
    for name, offset in offsets.items():
        changed[rig.index(name)] = offset
    return replace(rig, offsets=changed)


def turned_at_root(motion: Motion, turn: np.ndarray) -> Motion:
    """Return the motion with another rotation before those of its root, which stays in place."""
    rotations = motion.rotations.copy()
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    return replace(motion, rotations=rotations)


def with_rest_turned(motion: Motion, turn: np.ndarray, *joints: str) -> Motion:
    """Return the same movement on a rig whose joints are turned at rest, with all below them."""
    rig, back = motion.skeleton, invert_quaternions(turn)
    rotations, offsets = motion.rotations.copy(), rig.offsets.copy()
    for joint in map(rig.index, joints):
        rotations[:, joint] = multiply_quaternions(rotations[:, joint], turn)
        below = [j for j, parent in enumerate(rig.parents) if parent == joint]
        rotations[:, below] = multiply_quaternions(back, rotations[:, below])
        offsets[below] = rotate_vectors(back, offsets[below])
    return replace(motion, skeleton=replace(rig, offsets=offsets), rotations=rotations)


def below_a_root(rig: Skeleton, height: float, name: str = "Reference") -> Skeleton:
    """Return the rig below another joint, whose height above that is in metres."""
    return Skeleton(
        (name, *rig.names),
        (-1, *(parent + 1 for parent in rig.parents)),
        np.concatenate([np.zeros((1, 3)), [[0.0, height, 0.0]], rig.offsets[1:]]),
    )


def renamed(rig: Skeleton, names: dict[str, str]) -> Skeleton:
    """Return the rig with other names of some joints."""
    new = tuple(names.get(name, name) for name in rig.names)
    ends = {names.get(name, name): sites for name, sites in rig.end_sites.items()}
    return replace(rig, names=new, end_sites=ends)


def numbered(rig: Skeleton) -> Skeleton:
    """Return the rig with joints called Joint0, Joint1, ..."""
    return renamed(rig, {name: f"Joint{j}" for j, name in enumerate(rig.names)})


_LIMBS = {"shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand"}
_LIMBS |= {"hip": "UpLeg", "knee": "Leg", "ankle": "Foot"}


def numbered_limbs(rig: Skeleton) -> dict[str, str]:
    """Return parts of a person's limbs, such as "left_elbow", to their joints in `numbered`."""
    return {
        f"{side.lower()}_{part}": f"Joint{rig.index(side + joint)}"
        for side in ("Left", "Right")
        for part, joint in _LIMBS.items()
    }


def nameless(motion: Motion) -> tuple[Motion, dict[str, str]]:
    """Return a motion of a person with joints named by number, without end sites; and its parts."""
    rig = motion.skeleton
    return replace(motion, skeleton=replace(numbered(rig), end_sites={})), numbered_limbs(rig)


def prefixed(motion: Motion, prefix: str = "mixamorig:") -> Motion:
    """Return a motion whose joints' names have a prefix, as those of other programs have."""
    rig = motion.skeleton
    names = tuple(prefix + name for name in rig.names)
    end_sites = {prefix + name: sites for name, sites in rig.end_sites.items()}
    return replace(motion, skeleton=replace(rig, names=names, end_sites=end_sites))


def without_joints(motion: Motion, *words: str) -> Motion:
    """The motion on its rig without the joints whose names contain one of the words."""
    rig = motion.skeleton
    kept = [k for k, name in enumerate(rig.names) if not any(word in name for word in words)]
    parents = [-1 if rig.parents[k] < 0 else kept.index(rig.parents[k]) for k in kept]
    names = tuple(rig.names[k] for k in kept)
    cut = Skeleton(names, tuple(parents), rig.offsets[kept])
    return Motion(cut, motion.rotations[:, kept], motion.translation, motion.fps)
