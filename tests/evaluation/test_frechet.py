"""Fréchet distances against closed forms, and clip features against their definitions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rigs import without_joints
from scipy.linalg import sqrtm

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import (
    PoseWindows,
    div_k,
    fid_k,
    frechet_distance,
    frechet_result,
    geometric_features,
    kinetic_features,
    raw_fgd,
)
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts import body_joints
from gesturekit.motion.rotations import multiply_quaternions, quaternion_from_euler, rotate_vectors


def test_small_cases_by_hand():
    # Means 0 and 2, variances 2 and 8 (divided by n - 1): 2² + 2 + 8 - 2 √(2 · 8) = 6.
    assert frechet_distance([[-1.0], [1.0]], [[0.0], [4.0]]) == pytest.approx(6.0)
    # Each varies along an axis of its own: nothing overlaps, 2 + 8 remain, and |(0, 0) - (1, 0)|².
    ours, theirs = [[-1.0, 0.0], [1.0, 0.0]], [[1.0, -2.0], [1.0, 2.0]]
    assert frechet_distance(ours, theirs) == pytest.approx(11.0)


def test_the_textbook_formula_where_it_can_be_computed():
    rng = np.random.default_rng(0)
    ours = rng.normal(size=(90, 12)) @ rng.normal(size=(12, 12))
    theirs = rng.normal(size=(70, 12)) @ rng.normal(size=(12, 12)) + rng.normal(size=12)
    covariances = np.cov(ours, rowvar=False), np.cov(theirs, rowvar=False)
    root = sqrtm(covariances[0] @ covariances[1]).real
    apart = ours.mean(axis=0) - theirs.mean(axis=0)
    expected = apart @ apart + np.trace(covariances[0] + covariances[1] - 2 * root)
    assert frechet_distance(ours, theirs) == pytest.approx(expected, rel=1e-9)


def test_fewer_samples_than_dimensions():
    rng = np.random.default_rng(1)
    few, others = rng.normal(size=(5, 3)), rng.normal(size=(9, 3))
    # Turned into 200 dimensions, which changes no distance.
    turn = np.linalg.qr(rng.normal(size=(200, 3)))[0].T
    expected = frechet_distance(few, others)
    assert frechet_distance(few @ turn, others @ turn) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("shape", [(400, 32), (20, 300), (2, 1)])
def test_equal_samples_have_distance_zero(shape):
    features = 1e3 + 50 * np.random.default_rng(2).normal(size=shape)
    assert 0 <= frechet_distance(features, features[::-1]) < 1e-12 * features.var(axis=0).sum()


def motions_of(rng, n_motions, each, shift=0.0):
    """Features of motions that differ from each other more than their own windows do."""
    return [shift + rng.normal(size=4) + 0.5 * rng.normal(size=(each, 4)) for _ in range(n_motions)]


def test_the_confidence_interval_narrows_with_more_clips():
    rng = np.random.default_rng(3)
    reference = motions_of(rng, 60, 5)
    many = frechet_result(motions_of(rng, 60, 5, 1.0), reference)
    few = frechet_result(motions_of(rng, 12, 5, 1.0), reference[:12])
    assert many.low < many.value < many.high and few.low < few.value < few.high
    assert many.high - many.low < few.high - few.low
    # Most of further pairs of sets lie in it (they vary as much as these do).
    again = [
        frechet_result(motions_of(rng, 60, 5, 1.0), motions_of(rng, 60, 5), resamples=0).value
        for _ in range(30)
    ]
    assert np.mean([many.low < value < many.high for value in again]) > 0.6
    assert (many.n_generated, many.n_reference, many.dimensions) == (300, 300, 4)
    assert frechet_result(reference, reference[::-1], seed=5) == frechet_result(
        reference, reference[::-1], seed=5
    )


def test_small_samples_are_reported():
    rng = np.random.default_rng(4)
    enough = frechet_result(motions_of(rng, 20, 5), motions_of(rng, 20, 5))
    assert enough.note == "" and "[" in str(enough)
    few = frechet_result(motions_of(rng, 3, 9), motions_of(rng, 30, 9), resamples=20)
    assert "fewer than 40 samples" in few.note and "fewer than 10 motions" in few.note
    assert "fewer than 40 samples" in str(few) and np.isnan(few.low)
    plain = frechet_result(motions_of(rng, 3, 9), motions_of(rng, 30, 9), resamples=0)
    assert np.isnan(plain.low) and "motions" not in plain.note and "[" not in str(plain)


def test_many_dimensions_have_an_interval_too():
    rng = np.random.default_rng(5)
    sets = [[rng.normal(size=(4, 400)) for _ in range(10)] for _ in range(2)]
    result = frechet_result(*sets, resamples=5)
    assert 0 < result.low < result.value < result.high


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: frechet_distance([[1.0, 2.0]], np.ones((3, 2))), "generated: 1 sample"),
        (lambda: frechet_distance(np.ones((3, 2)), np.ones((3, 3))), "2 numbers a feature"),
        (lambda: frechet_distance(np.ones(3), np.ones((3, 3))), r"shape \(3,\)"),
        (lambda: frechet_distance(np.full((3, 2), np.nan), np.ones((3, 2))), "NaN .* sample 0"),
        (lambda: frechet_result([], [np.ones((3, 2))]), "one is empty"),
        (lambda: frechet_result([np.ones((3, 2)), np.ones((3, 1))], []), "one is empty"),
        (
            lambda: frechet_result([np.ones((3, 2)), np.ones((3, 1))], [np.ones((3, 2))]),
            "do not fit",
        ),
    ],
)
def test_bad_input_gets_one_clear_error(call, message):
    with pytest.raises(EvaluationError, match=message):
        call()


def test_wide_windows_are_bounded_from_below_and_close(gesture):
    reference = [gesture(40.0, 30.0, seed=i) for i in range(12)]
    generated = [gesture(40.0, 30.0, seed=20 + i) for i in range(12)]
    windows = PoseWindows.fit(reference)
    assert windows.n_frames * windows.n_features > 1500
    found = raw_fgd(generated, reference, windows)
    exact = frechet_distance(
        *(
            np.concatenate([clip.reshape(len(clip), -1) for clip in windows.cut(motions)])
            for motions in (generated, reference)
        )
    )
    assert 0.9 * exact < found.value <= exact * (1 + 1e-9)
    assert "lower bound" in found.note and found.dimensions > 1500
    assert raw_fgd(reference, reference, windows).value == pytest.approx(0.0, abs=1e-9 * exact)


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
    motion = gesture(1.0)[:n_frames]
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


def renamed(motion: Motion) -> Motion:
    names = tuple(name.replace("LeftArm", "Left_Arm") for name in motion.skeleton.names)
    return replace(motion, skeleton=replace(motion.skeleton, names=names))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: fid_k([m], [m]), "none of 1 motions is as long as a clip of 10 s"),
        (lambda m: fid_k([], [m]), "set of motions is empty"),
        (lambda m: raw_fgd([m[:59]], [m]), "none of 1 motions is as long as a window of 2"),
        (lambda m: raw_fgd([m], []), "no motion to learn poses from"),
        (lambda m: fid_k([renamed(m)], [m], seconds=4.0), "has no joint LeftArm, which the other"),
        (lambda m: kinetic_features(m[:1]), "1 frames at 30 fps; clip features need 4"),
        (lambda m: div_k([m], seconds=8.0), "diversity needs two clips"),
        (lambda m: div_k([m], seconds=0.0), "clips of 0.0 s"),
    ],
)
def test_motions_that_cannot_be_compared(gesture, call, message):
    with pytest.raises(EvaluationError, match=message):
        call(gesture(8.0))


def test_geometric_features_need_legs_and_wrists(gesture):
    motion = gesture(1.0)
    with pytest.raises(EvaluationError, match="has no legs"):
        geometric_features(without_joints(motion, "Leg", "Foot", "Toe"))
    with pytest.raises(EvaluationError, match="has no left wrist"):
        geometric_features(without_joints(motion, "Hand"))
