from __future__ import annotations

import numpy as np
import pytest
from hinges import bent_backwards
from rigs import at_rest

from gesturekit.motion.ik.two_bone import reachable, two_bone_ik
from gesturekit.motion.kinematics import forward_kinematics, global_rotations
from gesturekit.motion.rotations import (
    multiply_quaternions,
    normalize_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_angles,
)
from gesturekit.motion.skeleton import Skeleton

# A leg on a pelvis, with a helper joint between hip and knee.
LEG = Skeleton(
    ("pelvis", "hip", "twist", "knee", "ankle"),
    (-1, 0, 1, 2, 3),
    np.array([[0, 1.0, 0], [0.1, 0, 0], [0, -0.2, 0.01], [0.01, -0.2, 0], [0, -0.42, 0]]),
)
CHAIN = [1, 3, 4]


def solve(rotations: np.ndarray, target: np.ndarray, **options) -> tuple[np.ndarray, np.ndarray]:
    """Positions and local rotations of the leg after its ankle was sent to a target."""
    at = np.zeros((len(rotations), 3))
    positions = forward_kinematics(rotations, at, LEG)
    above = global_rotations(rotations, LEG)[:, [0, 2]]
    solved = rotations.copy()
    solved[:, [1, 3]] = two_bone_ik(
        positions[:, CHAIN], target, rotations[:, [1, 3]], above, **options
    )
    return forward_kinematics(solved, at, LEG), solved


def bent(n: int, seed: int = 0) -> np.ndarray:
    """(n, 5, 4) random poses with a well bent knee."""
    rng = np.random.default_rng(seed)
    rotations = normalize_quaternions(rng.normal(size=(n, 5, 4)))
    rotations[:, 2] = [0, 0, 0, 1]
    knee = np.stack([rng.uniform(0.5, 2.0, n), np.zeros(n), np.zeros(n)], axis=-1)
    rotations[:, 3] = quaternion_from_rotation_vector(knee)
    rotations[:, 4] = [0, 0, 0, 1]
    return rotations


def straight(n: int) -> np.ndarray:
    return at_rest(LEG, n).rotations


def test_the_ankle_reaches_its_target_and_bones_keep_their_lengths():
    rotations = bent(200)
    start = forward_kinematics(rotations, np.zeros((200, 3)), LEG)
    rng = np.random.default_rng(1)
    way = rng.normal(size=(200, 3))
    way *= rng.uniform(0.15, 0.78, (200, 1)) / np.linalg.norm(way, axis=1, keepdims=True)
    target = start[:, 1] + way
    positions, solved = solve(rotations, target)
    np.testing.assert_allclose(positions[:, 4], target, atol=1e-9)
    for a, b in ((1, 3), (3, 4)):
        before, after = (np.linalg.norm(p[:, a] - p[:, b], axis=1) for p in (start, positions))
        np.testing.assert_allclose(after, before, atol=1e-9)
    np.testing.assert_array_equal(solved[:, [0, 2, 4]], rotations[:, [0, 2, 4]])


@pytest.mark.parametrize("reach", [0.25, 0.3, 0.45])
def test_a_shank_longer_than_the_thigh_folds_past_the_hip(reach):
    """The angle at the hip, between 0.3 and 0.5 m, is obtuse below a reach of 0.4 m (3-4-5).

    At 0.3 m the cosine is (0.3^2 + 0.3^2 - 0.5^2) / (2 * 0.3 * 0.3) = -7 / 18.
    """
    hip, knee, ankle = np.array([[0.0, 1.0, 0.0], [0.0, 0.7, 0.0], [0.0, 0.2, 0.0]])
    target = hip - [0.0, reach, 0.0]
    still = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    pole = np.array([0.0, 0.0, 1.0])
    first, second = two_bone_ik(np.stack([hip, knee, ankle]), target, still, still, pole=pole)
    thigh = rotate_vectors(first, knee - hip)
    shank = rotate_vectors(multiply_quaternions(first, second), ankle - knee)
    np.testing.assert_allclose(hip + thigh + shank, target, atol=1e-9)
    assert thigh[2] > 0.2, "the knee bends towards the pole"
    expected = {0.25: -13 / 20, 0.3: -7 / 18, 0.45: 17 / 108}
    assert -thigh[1] / 0.3 == pytest.approx(expected[reach])


@pytest.mark.parametrize("way", [(0.0, -1.0, 0.0), (0.3, -0.9, 0.4), (-0.8, 0.2, 0.1)])
def test_a_straight_leg_without_a_pole_bends_somewhere(way):
    """All its frames are straight, so that no frame has a direction for the knee."""
    way = np.array(way) / np.linalg.norm(way)
    leg = np.array([[0.0, 0.0, 0.0], 0.4 * way, 0.82 * way])
    still = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    first, second = two_bone_ik(leg, 0.5 * way, still, still)
    thigh = rotate_vectors(first, leg[1])
    shank = rotate_vectors(multiply_quaternions(first, second), leg[2] - leg[1])
    np.testing.assert_allclose(thigh + shank, 0.5 * way, atol=1e-9)


@pytest.mark.parametrize("size", [1.0, 0.01])
def test_knees_bend_forward_and_elbows_backward_within_five_degrees(person, size):
    """The T-pose looks along +Z; a positive turn about X takes a shank back, about Y a left
    forearm back.
    """
    poses = {
        "left_knee": ("LeftLeg", (-6, 0, 0), (-4, 0, 0), (60, 0, 0)),
        "right_knee": ("RightLeg", (-6, 0, 0), (-4, 0, 0), (60, 0, 0)),
        "left_elbow": ("LeftForeArm", (0, 6, 0), (0, 4, 0), (0, -60, 0)),
        "right_elbow": ("RightForeArm", (0, -6, 0), (0, -4, 0), (0, 60, 0)),
    }
    motion = at_rest(person, 1 + 3 * len(poses), [0.0, 0.9, 0.0])
    expected = {part: np.zeros(motion.n_frames, dtype=bool) for part in poses}
    for k, (part, (joint, *turns)) in enumerate(poses.items()):
        turned = quaternion_from_rotation_vector(np.radians(turns))
        motion.rotations[1 + 3 * k : 4 + 3 * k, person.index(joint)] = turned
        expected[part][1 + 3 * k] = True
    found = bent_backwards(motion.scaled(size))
    assert found.keys() == expected.keys()
    for part, frames in expected.items():
        np.testing.assert_array_equal(found[part], frames, err_msg=part)


def test_an_ankle_at_its_target_is_not_moved():
    for rotations in (bent(50), straight(3)):
        there = forward_kinematics(rotations, np.zeros((len(rotations), 3)), LEG)[:, 4]
        _, solved = solve(rotations, there)
        assert rotation_angles(solved, rotations).max() < 1e-6


def test_the_knee_keeps_its_direction():
    rotations = bent(100)
    start = forward_kinematics(rotations, np.zeros((100, 3)), LEG)
    hip, knee, ankle = start[:, 1], start[:, 3], start[:, 4]
    for shorter in (0.95, 0.7):
        positions, _ = solve(rotations, hip + shorter * (ankle - hip))
        old, new = np.cross(knee - hip, ankle - hip), np.cross(positions[:, 3] - hip, ankle - hip)
        old, new = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (old, new))
        np.testing.assert_allclose((old * new).sum(axis=1), 1, atol=1e-4)  # within a degree


@pytest.mark.parametrize("pole", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_a_straight_leg_bends_along_the_pole(pole):
    lift = np.linspace(0, 0.3, 40)
    target = [0.11, -0.82, 0.01] + lift[:, None] * [0.0, 1.0, 0.0]
    positions, _ = solve(straight(40), target, pole=np.tile(pole, (40, 1)))
    middle = (positions[:, 1] + positions[:, 4]) / 2
    out = (positions[:, 3] - middle) @ np.array(pole)
    assert out[-1] > 0.2 and (np.diff(out) > -1e-9).all()


def test_no_pop_at_full_extension():
    """The target goes steadily from near to out of reach; the knee straightens ever more slowly."""
    n = 400
    reach = np.linspace(0.6, 1.1, n)
    target = np.stack([np.full(n, 0.1), -reach, np.zeros(n)], axis=-1)
    pose = straight(n)
    pose[:, 3] = quaternion_from_rotation_vector(np.array([1.2, 0.0, 0.0]))
    positions, solved = solve(pose, target)
    got = np.linalg.norm(positions[:, 4] - positions[:, 1], axis=1)
    length = sum(np.linalg.norm(positions[0, a] - positions[0, b]) for a, b in ((1, 3), (3, 4)))
    assert got.max() < length
    assert np.abs(np.diff(got)).max() <= np.diff(reach)[0] + 1e-9
    hard = np.minimum(reach, length)
    steps = rotation_angles(solved[1:, 3], solved[:-1, 3])
    # A hard stop turns the knee by arccos of nearly 1, ever faster, and then not at all.
    knee = np.arccos(np.clip((hard**2 - 2 * (length / 2) ** 2) / (2 * (length / 2) ** 2), -1, 1))
    assert steps.max() < 0.6 * np.abs(np.diff(knee)).max()


def test_reachable_is_smooth_and_bounded():
    distance = np.linspace(0, 3, 3001)
    got = reachable(distance, np.array(1.0), np.array(0.0))
    np.testing.assert_array_equal(got[distance <= 0.97], distance[distance <= 0.97])
    assert got.max() <= 1 and (np.diff(got) >= 0).all()
    assert np.abs(np.diff(got, 2)).max() < 1e-4
    # What is straight already is not bent.
    assert reachable(np.array(0.995), np.array(1.0), np.array(0.995)) == 0.995


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0, 3.0])
def test_a_limb_bends_the_more_along_the_pole_the_straighter_it_was(share):
    """Bones of 1 m, bent by a share of 0.1 m to +Z and then to 0.5 m, with the pole at +X.

    Of the 0.5 m less those before, 1 / (1 + share^2) is added along the pole.
    """
    old = 0.1 * share
    down = np.sqrt(1 - old**2)
    joints = np.array([[0, 0, 0], [0, -down, old], [0, -2 * down, 0.0]])
    target, pole = np.array([0, -np.sqrt(3), 0]), np.array([1.0, 0, 0])
    rest = np.tile([0.0, 0, 0, 1], (2, 1))
    solved = two_bone_ik(joints, target, rest, rest, pole=pole, softness=0.0)
    extra = (0.5 - old) / (1 + share**2)
    side = np.array([extra, 0.0, old]) / np.hypot(extra, old)
    knee = rotate_vectors(solved[0], joints[1])
    np.testing.assert_allclose(knee, 0.5 * side - [0, np.sqrt(3) / 2, 0], atol=1e-6)
    shank = rotate_vectors(multiply_quaternions(solved[0], solved[1]), joints[2] - joints[1])
    np.testing.assert_allclose(knee + shank, target, atol=1e-6)


@pytest.mark.parametrize("place", [(0.0, 1.0, 0.0), (3.0, -2.0, 0.5)])
def test_the_place_of_a_limb_does_not_matter(place):
    """A straight limb of 2 m reaches for 2.5 m, and for what it has; the middle of one is at 0."""
    joints = np.array([[0, 0, 0], [0, -1.0, 0], [0, -2.0, 0]])
    rest = np.tile([0.0, 0, 0, 1], (2, 1))
    pole = np.array([0.0, 0, 1.0])
    for target in ([0, -2.0, 0], [0.3, -1.99, 0], [1.5, -2.0, 0.0]):
        here, there = (
            two_bone_ik(joints + at, target + at, rest, rest, pole=pole)
            for at in (np.zeros(3), np.array(place))
        )
        np.testing.assert_allclose(there, here, atol=1e-7)
    straight = two_bone_ik(joints + place, joints[2] + place, rest, rest, pole=pole)
    np.testing.assert_allclose(np.abs(straight[:, 3]), 1.0, atol=1e-9)
