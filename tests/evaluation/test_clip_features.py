"""Kinetic and geometric features against their definitions, and on poses that one can picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import div_k, fid_k, geometric_features, kinetic_features
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts import body_joints
from gesturekit.motion.rotations import multiply_quaternions, quaternion_from_euler, rotate_vectors


def kinetic_by_definition(places: np.ndarray, dt: float) -> np.ndarray:
    """Three energies of one joint at places (T, 3), written as fairmotion's loops."""
    n = len(places)
    horizontal, vertical, expenditure = [], [], []
    for i in range(1, n):
        steps = [
            places[i + j] - places[i + j - 1] for j in range(-2, 3) if i + j - 1 >= 0 and i + j < n
        ]
        velocity = np.sum(steps, axis=0) / (len(steps) * dt)
        horizontal.append(velocity[0] ** 2 + velocity[2] ** 2)
        vertical.append(velocity[1] ** 2)
        turns = [
            (places[i + j + 1] - 2 * places[i + j] + places[i + j - 1]) / dt**2
            for j in range(-2, 3)
            if i + j - 1 >= 0 and i + j + 1 < n
        ]
        expenditure.append(np.linalg.norm(np.mean(turns, axis=0)))
    return np.array([np.mean(horizontal), np.mean(vertical), np.mean(expenditure)])


@pytest.mark.parametrize("n_frames", [4, 5, 23])
def test_kinetic_features_equal_their_definition(gesture, skeleton, n_frames):
    motion = gesture(1.0).slice(0, n_frames)
    joints = body_joints(skeleton)
    features = kinetic_features(motion).reshape(len(joints), 3)
    positions = motion.positions()
    for name, found in zip(joints, features):
        expected = kinetic_by_definition(positions[:, skeleton.index(name)], 1 / 30)
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-12)


def standing(skeleton: Skeleton, degrees: dict[str, tuple[float, float, float]], n=12) -> Motion:
    """A pose held for n frames at 30 fps: XYZ Euler angles of some joints."""
    rotations = np.zeros((n, skeleton.n_joints, 4))
    rotations[..., 3] = 1.0
    for name, angles in degrees.items():
        rotations[:, skeleton.index(name)] = quaternion_from_euler(np.array(angles), "XYZ")
    return Motion(skeleton, rotations, np.tile([0.0, 0.95, 0.0], (n, 1)), 30.0)


# Numbers of the features, from 0.
HIGH_RIGHT, HIGH_LEFT, BENT_RIGHT, BENT_LEFT = 2, 3, 6, 7
APART, FAST_RIGHT, FAST_LEFT, KNEE_RIGHT, LIES = 8, 12, 13, 19, 28
LOW_RIGHT, LOW_LEFT, FAST_ROOT = 29, 30, 31


def test_features_of_simple_poses(skeleton):
    def features(**degrees):
        return geometric_features(standing(skeleton, degrees))

    t_pose = features()
    assert not t_pose[[HIGH_RIGHT, HIGH_LEFT, BENT_RIGHT, BENT_LEFT, KNEE_RIGHT, LIES]].any()
    assert t_pose[APART] == 1.0  # 2.5 shoulder widths of 0.34 m, hands 1.4 m apart
    raised = features(RightArm=(0, 0, -60), LeftArm=(0, 0, 0))  # right arms turn up about -z
    assert (raised[HIGH_RIGHT], raised[HIGH_LEFT]) == (1.0, 0.0)
    bent = features(LeftForeArm=(0, -90, 0), RightLeg=(100, 0, 0))
    assert (bent[BENT_LEFT], bent[BENT_RIGHT], bent[KNEE_RIGHT]) == (1.0, 0.0, 1.0)
    assert features(Hips=(90, 0, 0))[LIES] == 1.0
    kneeling = features(LeftArm=(0, 0, -80), RightUpLeg=(-90, 0, 0), LeftUpLeg=(-90, 0, 0))
    assert (kneeling[LOW_LEFT], kneeling[LOW_RIGHT]) == (1.0, 0.0)


def test_speeds_count_in_upper_arms_a_second(skeleton):
    # Upper arms of 0.28 m: the root is fast from 2.3 · 0.28 = 0.644 m/s, hands from 0.7 m/s.
    still = standing(skeleton, {}, 60)
    for speed, root, hands in ((0.6, 0.0, 0.0), (0.66, 1.0, 0.0), (0.75, 1.0, 1.0)):
        glide = still.translation + np.outer(still.times, [0.0, 0.0, speed])
        found = geometric_features(replace(still, translation=glide))
        assert found[[FAST_ROOT, FAST_LEFT, FAST_RIGHT]].tolist() == [root, hands, hands]
        kinetic = kinetic_features(replace(still, translation=glide)).reshape(-1, 3)
        assert kinetic == pytest.approx(np.tile([speed**2, 0, 0], (len(kinetic), 1)), abs=1e-9)


def test_neither_frame_rate_nor_place_matters_much(gesture):
    motion = gesture(10.0, fps=30.0)
    kinetic, geometric = kinetic_features(motion), geometric_features(motion)
    turn = quaternion_from_euler(np.array([0.0, 120.0, 0.0]), "XYZ")
    rotations = motion.rotations.copy()
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    elsewhere = replace(
        motion,
        rotations=rotations,
        translation=rotate_vectors(turn, motion.translation) + [3.0, 0.0, 1.0],
    )
    assert kinetic_features(elsewhere) == pytest.approx(kinetic, rel=1e-6, abs=1e-9)
    assert geometric_features(elsewhere) == pytest.approx(geometric, abs=0.01)
    energies = kinetic.reshape(-1, 3)[:, :2]
    for fps in (25.0, 60.0):
        again = gesture(10.0, fps=fps)
        found = kinetic_features(again).reshape(-1, 3)[:, :2]
        assert found == pytest.approx(energies, rel=0.05, abs=1e-4)
        assert geometric_features(again) == pytest.approx(geometric, abs=0.05)


def test_rigs_that_differ_and_short_motions(gesture, skeleton):
    motion = gesture(8.0)
    names = tuple("Left_Arm" if name == "LeftArm" else name for name in skeleton.names)
    other = replace(motion, skeleton=replace(skeleton, names=names))
    with pytest.raises(EvaluationError, match="has no joint LeftArm, which the other motions"):
        fid_k([other], [motion], seconds=4.0)
    with pytest.raises(EvaluationError, match="1 frames at 30 fps; clip features need 4"):
        kinetic_features(motion.slice(0, 1))
    with pytest.raises(EvaluationError, match="diversity needs two clips"):
        div_k([motion], seconds=8.0)
    with pytest.raises(EvaluationError, match="clips of 0.0 s"):
        div_k([motion], seconds=0.0)
