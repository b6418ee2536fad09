"""The SMPL family's joints: names, tree, and a rest pose that needs no body model.

The body models' own rest joints come with files whose licence forbids handing them on, and follow
from `betas`. Without them we place the joints as on an adult of average build, 1.7 m tall,
measured by no model; rotations are exact all the same.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from gesturekit.motion.skeleton import Skeleton

_BODY = (  # name, parent, offset of the left or middle joint (m): x to the left, Y up, +Z forward
    ("pelvis", None, (0.0, 0.93, 0.0)),
    ("left_hip", "pelvis", (0.06, -0.09, -0.005)),
    ("right_hip", "pelvis", None),
    ("spine1", "pelvis", (0.0, 0.11, -0.025)),
    ("left_knee", "left_hip", (0.045, -0.38, 0.0)),
    ("right_knee", "right_hip", None),
    ("spine2", "spine1", (0.0, 0.135, 0.015)),
    ("left_ankle", "left_knee", (-0.015, -0.4, -0.035)),
    ("right_ankle", "right_knee", None),
    ("spine3", "spine2", (0.0, 0.055, 0.02)),
    ("left_foot", "left_ankle", (0.04, -0.06, 0.12)),
    ("right_foot", "right_ankle", None),
    ("neck", "spine3", (0.0, 0.215, -0.045)),
    ("left_collar", "spine3", (0.075, 0.115, -0.025)),
    ("right_collar", "spine3", None),
    ("head", "neck", (0.0, 0.09, 0.05)),
    ("left_shoulder", "left_collar", (0.1, 0.045, -0.015)),
    ("right_shoulder", "right_collar", None),
    ("left_elbow", "left_shoulder", (0.26, -0.015, -0.025)),
    ("right_elbow", "right_shoulder", None),
    ("left_wrist", "left_elbow", (0.25, 0.01, 0.0)),
    ("right_wrist", "right_elbow", None),
)
_HANDS = (("left_hand", "left_wrist", (0.085, -0.01, -0.015)), ("right_hand", "right_wrist", None))
_FACE = (
    ("jaw", "head", (0.0, 0.005, 0.02)),
    ("left_eye_smplhf", "head", (0.032, 0.07, 0.075)),
    ("right_eye_smplhf", "head", None),
)
_FINGERS = {  # place of the first joint and lengths of the next two steps (m)
    "index": ((0.1, 0.0, 0.025), (0.032, 0.022)),
    "middle": ((0.105, 0.005, 0.0), (0.031, 0.024)),
    "pinky": ((0.085, -0.01, -0.04), (0.02, 0.018)),
    "ring": ((0.095, 0.0, -0.022), (0.029, 0.024)),
    "thumb": ((0.03, -0.015, 0.03), (0.03, 0.025)),
}
N_JOINTS = (22, 24, 52, 55)
"""Sizes of rigs: body, SMPL (with hand stubs), SMPL-H (with fingers), SMPL-X (with face too)."""

_MODEL_PELVIS = {22: (0.0, -0.22, 0.03), 24: (0.0, -0.22, 0.03), 52: (0.0, -0.22, 0.03)}
_SMPLX_PELVIS = (0.0, -0.35, 0.01)


def model_pelvis(n_joints: int) -> np.ndarray:
    """(3,) where the unmoved model of that many joints holds its pelvis, metres, to a centimetre.

    The models' origin is in the chest. A file's `trans` is added to this place, whatever the
    root's rotation and the axis that points up.
    """
    return np.array(_MODEL_PELVIS.get(n_joints, _SMPLX_PELVIS))


@cache
def smpl_skeleton(n_joints: int) -> Skeleton:
    """The rig of 22, 24, 52 or 55 joints, in the order of its pose vectors."""
    joints = list(_BODY)
    if n_joints == 24:
        joints += _HANDS
    if n_joints == 55:
        joints += _FACE
    if n_joints >= 52:
        for side in ("left", "right"):
            for finger, (first, steps) in _FINGERS.items():
                offsets = (first, *((step, 0.0, 0.0) for step in steps))
                for n, offset in enumerate(offsets, start=1):
                    parent = f"{side}_{finger}{n - 1}" if n > 1 else f"{side}_wrist"
                    joints.append(
                        (f"{side}_{finger}{n}", parent, offset if side == "left" else None)
                    )
    at = {name: offset for name, _, offset in joints}
    names = [name for name, _, _ in joints]
    mirror = np.array([-1.0, 1.0, 1.0])
    return Skeleton(
        names=tuple(names),
        parents=tuple(-1 if parent is None else names.index(parent) for _, parent, _ in joints),
        offsets=np.array(
            [
                offset if offset is not None else mirror * at[name.replace("right", "left")]
                for name, _, offset in joints
            ]
        ),
    )


def is_smpl(skeleton: Skeleton) -> bool:
    """Whether the joints are those of a rig of the SMPL family, under its own names."""
    n = skeleton.n_joints
    if n not in N_JOINTS:
        return False
    rig = smpl_skeleton(n)
    return (skeleton.names, skeleton.parents) == (rig.names, rig.parents)
