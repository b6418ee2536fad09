"""Rigs that the tests of motion share."""

import numpy as np
import pytest
from rigs import Bones, renamed, rig_of

from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.rotations import normalize_quaternions

PARALLEL: Bones = {  # a small person in a T-pose whose joints' frames are all parallel
    "Hips": (None, (0.0, 0.9, 0.0)),
    "Spine": ("Hips", (0.0, 0.2, 0.0)),
    "Chest": ("Spine", (0.0, 0.2, 0.01)),
    "Neck": ("Chest", (0.0, 0.1, 0.0)),
    "Head": ("Neck", (0.0, 0.1, 0.0)),
    "LeftArm": ("Chest", (0.15, 0.05, 0.0)),
    "LeftForeArm": ("LeftArm", (0.29, 0.0, 0.0)),
    "LeftHand": ("LeftForeArm", (0.25, 0.0, 0.0)),
    "RightArm": ("Chest", (-0.15, 0.05, 0.0)),
    "RightForeArm": ("RightArm", (-0.28, 0.0, 0.0)),
    "RightHand": ("RightForeArm", (-0.25, 0.0, 0.0)),
    "LeftUpLeg": ("Hips", (0.1, 0.0, 0.0)),
    "LeftLeg": ("LeftUpLeg", (0.0, -0.42, 0.0)),
    "LeftFoot": ("LeftLeg", (0.0, -0.4, 0.0)),
    "LeftToeBase": ("LeftFoot", (0.0, -0.06, 0.14)),
    "RightUpLeg": ("Hips", (-0.1, 0.0, 0.0)),
    "RightLeg": ("RightUpLeg", (0.0, -0.42, 0.0)),
    "RightFoot": ("RightLeg", (0.0, -0.4, 0.0)),
    "RightToeBase": ("RightFoot", (0.0, -0.06, 0.14)),
}
FINGERS = {  # knuckle and phalanges of the left hand of MIXAMO, centimetres
    "Thumb": ((3.0, -1.5, 2.6), (3.8, 3.3, 2.7)),
    "Index": ((9.2, -0.1, 2.8), (3.7, 2.9, 2.6)),
    "Middle": ((9.5, -0.1, 0.7), (4.0, 3.2, 3.0)),
    "Ring": ((9.0, -0.1, -1.3), (3.6, 3.0, 2.8)),
    "Pinky": ((8.2, -0.1, -3.3), (3.0, 2.4, 2.3)),
}


@pytest.fixture(scope="session")
def mixamo() -> Skeleton:
    """A Mixamo-like rig: 1.8 m, T-pose, parallel frames, fingers, ends of head and toes."""
    rows: Bones = {
        "Hips": (None, (0.0, 99.8, 0.0)),
        "Spine": ("Hips", (0.0, 9.9, -1.2)),
        "Spine1": ("Spine", (0.0, 11.7, 0.0)),
        "Spine2": ("Spine1", (0.0, 13.4, 0.0)),
        "Neck": ("Spine2", (0.0, 15.0, 0.9)),
        "Head": ("Neck", (0.0, 10.3, 3.1)),
        "HeadTop_End": ("Head", (0.0, 18.5, 6.6)),
    }
    for side, x in (("Left", 1), ("Right", -1)):
        arm = f"{side}Hand"
        rows |= {
            f"{side}Shoulder": ("Spine2", (6.1 * x, 9.1, 0.8)),
            f"{side}Arm": (f"{side}Shoulder", (12.6 * x, 0.0, -1.0)),
            f"{side}ForeArm": (f"{side}Arm", (27.4 * x, 0.0, 0.0)),
            arm: (f"{side}ForeArm", (27.6 * x, 0.0, 0.0)),
        }
        for finger, ((a, b, c), lengths) in FINGERS.items():
            rows[f"{arm}{finger}1"] = (arm, (a * x, b, c))
            for n, length in enumerate(lengths, start=1):
                rows[f"{arm}{finger}{n + 1}"] = (f"{arm}{finger}{n}", (length * x, 0.0, 0.0))
        rows |= {
            f"{side}UpLeg": ("Hips", (9.1 * x, -6.7, 0.0)),
            f"{side}Leg": (f"{side}UpLeg", (0.0, -40.6, 0.0)),
            f"{side}Foot": (f"{side}Leg", (0.0, -42.1, 0.0)),
            f"{side}ToeBase": (f"{side}Foot", (0.0, -10.4, 13.0)),
            f"{side}Toe_End": (f"{side}ToeBase", (0.0, 0.0, 9.9)),
        }
    rig = rig_of(rows).scaled(0.01)
    return renamed(rig, {name: f"mixamorig:{name}" for name in rig.names})


@pytest.fixture(scope="session")
def person() -> Skeleton:
    ends = {"Head": (np.array([0.0, 0.15, 0.02]),), "LeftHand": (np.array([0.1, 0, 0.01]),)}
    return rig_of(PARALLEL, end_sites=ends, rotation_orders=("ZXY",) * len(PARALLEL))


@pytest.fixture
def moving_person(person: Skeleton) -> Motion:
    """Two seconds at 30 fps of smooth random movement."""
    rng = np.random.default_rng(1)
    t = np.linspace(0, 2 * np.pi, 60)[:, None, None]
    phase, size = rng.uniform(0, 6, (2, person.n_joints, 4))
    rotations = 0.06 * size * np.sin(t + phase) + np.array([0.0, 0.0, 0.0, 1.0])
    path = np.array([0.1, 0.9, 0.2]) + 0.1 * np.sin(t[:, 0] + np.arange(3))
    return Motion(person, normalize_quaternions(rotations), path, 30.0)
