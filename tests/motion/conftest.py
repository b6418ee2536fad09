"""Rigs that the tests of motion share."""

from __future__ import annotations

import numpy as np
import pytest

from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.rotations import normalize_quaternions

PARALLEL = (  # a small person in a T-pose whose joints' frames are all parallel
    ("Hips", None, (0.0, 0.9, 0.0)),
    ("Spine", "Hips", (0.0, 0.2, 0.0)),
    ("Chest", "Spine", (0.0, 0.2, 0.01)),
    ("Neck", "Chest", (0.0, 0.1, 0.0)),
    ("Head", "Neck", (0.0, 0.1, 0.0)),
    ("LeftArm", "Chest", (0.15, 0.05, 0.0)),
    ("LeftForeArm", "LeftArm", (0.29, 0.0, 0.0)),
    ("LeftHand", "LeftForeArm", (0.25, 0.0, 0.0)),
    ("RightArm", "Chest", (-0.15, 0.05, 0.0)),
    ("RightForeArm", "RightArm", (-0.28, 0.0, 0.0)),
    ("RightHand", "RightForeArm", (-0.25, 0.0, 0.0)),
    ("LeftUpLeg", "Hips", (0.1, 0.0, 0.0)),
    ("LeftLeg", "LeftUpLeg", (0.0, -0.42, 0.0)),
    ("LeftFoot", "LeftLeg", (0.0, -0.4, 0.0)),
    ("LeftToeBase", "LeftFoot", (0.0, -0.06, 0.14)),
    ("RightUpLeg", "Hips", (-0.1, 0.0, 0.0)),
    ("RightLeg", "RightUpLeg", (0.0, -0.42, 0.0)),
    ("RightFoot", "RightLeg", (0.0, -0.4, 0.0)),
    ("RightToeBase", "RightFoot", (0.0, -0.06, 0.14)),
)


@pytest.fixture(scope="session")
def person() -> Skeleton:
    names = [name for name, _, _ in PARALLEL]
    return Skeleton(
        names=tuple(names),
        parents=tuple(-1 if p is None else names.index(p) for _, p, _ in PARALLEL),
        offsets=np.array([offset for _, _, offset in PARALLEL]),
        end_sites={"Head": (np.array([0.0, 0.15, 0.02]),), "LeftHand": (np.array([0.1, 0, 0.01]),)},
        rotation_orders=("ZXY",) * len(names),
    )


@pytest.fixture
def moving_person(person: Skeleton) -> Motion:
    """Two seconds at 30 fps of smooth random movement."""
    rng = np.random.default_rng(1)
    n_frames = 60
    t = np.linspace(0, 2 * np.pi, n_frames)[:, None, None]
    phase, size = rng.uniform(0, 6, (2, person.n_joints, 4))
    rotations = 0.06 * size * np.sin(t + phase) + np.array([0.0, 0.0, 0.0, 1.0])
    return Motion(
        skeleton=person,
        rotations=normalize_quaternions(rotations),
        translation=np.array([0.1, 0.9, 0.2]) + 0.1 * np.sin(t[:, 0] + np.arange(3)),
        fps=30.0,
    )
