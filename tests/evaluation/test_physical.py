"""Speeds, jerk, feet and joint limits, against numbers worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import without_joints
from scipy.spatial.transform import Rotation

from gesturekit.errors import MotionError
from gesturekit.evaluation import (
    JointLimits,
    arm_speed,
    arm_speed_ratio,
    derivative,
    floor_penetration,
    foot_skate,
    jerk,
    jerk_ratio,
    joint_limit_share,
    low_passed,
    standing_heights,
    wrist_speed,
)
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts.body_size import body_scale


def test_arm_speed_sums_shoulders_and_elbows_and_nothing_else(turning):
    ones = np.ones(20)
    motion = turning({"LeftArm": 1.0 * ones, "RightForeArm": 2.5 * ones, "Spine": 9.0 * ones})
    assert arm_speed(motion) == pytest.approx(np.full(20, 3.5), abs=1e-9)


def test_arm_speed_is_neither_early_nor_late(turning):
    # It turns only between frames 4 and 5: half of that speed belongs to either frame.
    speed = np.zeros(10)
    speed[4] = 2.0
    expected = np.zeros(10)
    expected[[4, 5]] = 1.0
    assert arm_speed(turning({"LeftArm": speed})) == pytest.approx(expected, abs=1e-9)


def test_arm_speed_does_not_depend_on_the_sign_of_a_quaternion(turning):
    motion = turning({"LeftArm": np.ones(9)})
    flipped = motion.rotations * np.where(np.arange(9) % 2, -1.0, 1.0)[:, None, None]
    other = Motion(motion.skeleton, flipped, motion.translation, motion.fps)
    assert arm_speed(other) == pytest.approx(arm_speed(motion), abs=1e-9)


def test_jerk_of_a_cubic_path_is_its_third_derivative(turning):
    time = np.arange(20) / 25.0
    rising = moved(turning({"LeftArm": np.zeros(20)}), np.outer(0.5 * time**3, [0.0, 1.0, 0.0]))
    assert jerk(rising) == pytest.approx(3.0, rel=1e-6)


def test_nothing_to_compare_with_and_too_few_frames_are_errors(turning):
    still, moving = turning({"LeftArm": np.zeros(20)}), turning({"LeftArm": np.ones(20)})
    with pytest.raises(MotionError, match="arm speed .*zero"):
        arm_speed_ratio(moving, still)
    with pytest.raises(MotionError, match="resample"):
        jerk_ratio(moving, turning({"LeftArm": np.ones(20)}, 30.0))
    with pytest.raises(MotionError, match=r"3 frames.*\b4\b"):
        jerk(turning({"LeftArm": np.ones(3)}))


@pytest.fixture(scope="module")
def swinging() -> np.ndarray:
    """(T, 2, 3) at 50 fps: 10 cm to and fro twice a second along x, half as far along z."""
    wave = 0.1 * np.sin(4 * np.pi * np.arange(200) / 50.0)
    return np.stack([wave, 0 * wave, 0.5 * wave], axis=-1)[:, None].repeat(2, axis=1)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_derivatives_of_a_swing_are_those_of_its_sine(swinging, order):
    """At 2 Hz a low-pass of 20 Hz changes nothing."""
    found = derivative(swinging, 50.0, order, 20.0)
    assert found.shape == swinging.shape
    phase = 4 * np.pi * np.arange(200) / 50.0 + order * np.pi / 2
    expected = 0.1 * (4 * np.pi) ** order * np.sin(phase)
    middle = slice(40, -40)
    largest = 0.1 * (4 * np.pi) ** order
    assert found[middle, 0, 0] == pytest.approx(expected[middle], abs=0.005 * largest)
    assert found[middle, 1, 2] == pytest.approx(expected[middle] / 2, abs=0.005 * largest)


@pytest.fixture
def standing(turning) -> Motion:
    """Two seconds of standing still at 50 fps."""
    return turning({"LeftArm": np.zeros(100)}, 50.0)


def moved(motion: Motion, by: np.ndarray) -> Motion:
    return replace(motion, translation=motion.translation + by)


def test_feet_that_slide_on_the_ground_slide_at_their_speed(standing):
    assert foot_skate(standing) == 0.0
    sliding = moved(standing, np.outer(standing.times, [0.6, 0.0, 0.8]))
    assert foot_skate(sliding, standing_heights(standing)) == pytest.approx(1.0)


@pytest.mark.parametrize(("height", "weight"), [(0.0, 1.0), (0.0125, 2 - 2**0.5), (0.025, 0.0)])
def test_sliding_counts_less_the_higher_the_feet_are(standing, height, weight):
    # 2 - 2^(h/H) with H = 2.5 cm on a body of 1.7 m: 1 on the ground, 0.586 at half of H, 0 from H.
    height *= body_scale(standing.skeleton)
    sliding = moved(standing, np.outer(standing.times, [1.0, 0.0, 0.0]) + [0.0, height, 0.0])
    assert foot_skate(sliding, standing_heights(standing)) == pytest.approx(weight)


def test_penetration_is_the_depth_below_the_standing_height(standing):
    heights = standing_heights(standing)
    assert floor_penetration(moved(standing, np.array([0, -0.03, 0])), heights) == pytest.approx(
        0.03
    )
    assert floor_penetration(moved(standing, np.array([0, 0.2, 0])), heights) == 0.0


def test_feet_need_legs(standing):
    for measure in (foot_skate, floor_penetration, standing_heights):
        with pytest.raises(MotionError, match="legs"):
            measure(without_joints(standing, "Leg", "Foot"))


def test_joints_beyond_recorded_limits_are_counted_per_frame(turning):
    def elbow(speed: float) -> Motion:
        return turning({"LeftForeArm": np.full(101, speed)}, 50.0)

    limits = JointLimits.fit([elbow(0.5)], ("LeftForeArm", "RightForeArm"))
    assert joint_limit_share(elbow(0.5), limits) == 0.0
    # Recorded: 0 to 1 rad. Twice as fast it is beyond 1 rad plus 5° (0.0873 rad) after 54.4 of
    # 101 frames; of the two joints only one is: 46 / 101 / 2.
    assert joint_limit_share(elbow(1.0), limits) == pytest.approx(46 / 202)
    with pytest.raises(MotionError, match="recording"):
        JointLimits.fit([], ("LeftForeArm",))


def nodding(angles: list[tuple[float, float, float]], skeleton: Skeleton) -> Motion:
    """The head, and the left hand the other way round, turned by rotation vectors in degrees."""
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(angles), skeleton.n_joints, 1))
    for name, sign in (("Head", 1.0), ("LeftHand", -1.0)):
        turns = Rotation.from_rotvec(sign * np.deg2rad(angles))
        rotations[:, skeleton.index(name)] = turns.as_quat()
    return Motion(skeleton, rotations, np.tile([0.0, 0.9, 0.0], (len(angles), 1)), 25.0)


def test_limits_are_of_each_joint_and_axis_and_5_degrees_wider(skeleton):
    # About each axis to and fro, so that the mean is no turn at all.
    axes = np.diag([10.0, 20.0, 30.0])
    motion = nodding([*axes, *-axes, (0, 0, 0)], skeleton)
    limits = JointLimits.fit([motion], ("Head", "LeftHand"))
    assert np.degrees(limits.high) == pytest.approx(np.tile([15, 25, 35], (2, 1)), abs=1e-6)
    assert np.degrees(limits.low) == pytest.approx(np.tile([-15, -25, -35], (2, 1)), abs=1e-6)
    lopsided = JointLimits.fit([nodding([(0, 0, 0)] * 2 + [(0, 8, 0), (0, 4, 0)], skeleton)],
                               ("Head", "LeftHand"))  # fmt: skip
    # From the mean of 3 degrees.
    assert np.degrees(lopsided.high)[:, 1] == pytest.approx([10, 8], abs=0.01)
    assert np.degrees(lopsided.low)[:, 1] == pytest.approx([-8, -10], abs=0.01)
    # Beyond one axis is beyond; at the limit is not.
    for turn, share in (((14, 24, 0), 0), ((0, 26, 0), 1), ((-16, 0, 0), 1), ((0, 0, 0), 0)):
        assert joint_limit_share(nodding([turn], skeleton), limits) == share
    exact = JointLimits(("Head",), np.array([[0.0, 0, 0, 1]]), np.zeros((1, 3)), np.zeros((1, 3)))
    assert joint_limit_share(nodding([(0, 0, 0)], skeleton), exact) == 0.0


def test_limits_widen_by_recordings_after_those_of_the_mean(skeleton, monkeypatch):
    monkeypatch.setattr("gesturekit.evaluation.metrics.physical.MEAN_FRAMES", 3)
    still, turned = (nodding([(0, angle, 0)] * 4, skeleton) for angle in (0, 20))
    limits = JointLimits.fit(iter([still, turned, still]), ("Head",))
    assert np.degrees(limits.high) == pytest.approx(np.array([[5, 25, 5]]), abs=1e-6)
    assert np.degrees(limits.low) == pytest.approx(np.array([[-5, -5, -5]]), abs=1e-6)


def test_the_standing_height_is_the_median_while_standing(standing):
    low = standing_heights(standing)
    # A fifth of the time it stands a step higher.
    step = np.zeros((standing.n_frames, 3))
    step[80:, 1] = 0.2
    np.testing.assert_allclose(standing_heights(moved(standing, step)), low, atol=1e-9)
    # Two of five frames at rest stand higher: the median of those at rest alone.
    path = np.outer(np.arange(100) // 20, [0.0, 0.1, 0.0]) + np.outer(
        (np.arange(100) // 20 % 2) * np.arange(100), [1.0, 0.0, 0.0]
    )
    np.testing.assert_allclose(standing_heights(moved(standing, path)), low + 0.2, atol=1e-9)
    # Of a foot that never rests, the height that a tenth of the frames is below.
    flying = np.outer(standing.times, [1.0, 0.5, 0.0])
    rises = standing_heights(moved(standing, flying))
    np.testing.assert_allclose(rises, low + 0.5 * np.quantile(standing.times, 0.1), atol=1e-9)


def test_wrist_speed_needs_wrists(turning):
    motion = turning({"LeftForeArm": np.full(20, 2.0)})
    # 2 rad/s at 0.25 m on one side, over frames of 0.08 rad; nothing on the other.
    step = 2 * 0.25 * np.sin(0.04) * 25
    assert wrist_speed(motion) == pytest.approx(np.full(19, step / 2))
    with pytest.raises(MotionError, match="wrist"):
        wrist_speed(without_joints(motion, "Hand"))


def test_low_passed_paths_are_in_time_and_lose_what_is_faster():
    time = np.arange(200) / 50.0
    slow, fast = np.sin(2 * np.pi * time), np.sin(2 * np.pi * 20 * time)
    assert low_passed(slow, 50.0, 6.0)[20:-20] == pytest.approx(slow[20:-20], abs=0.01)
    assert np.abs(low_passed(fast, 50.0, 6.0)[20:-20]).max() < 0.02
    # Forwards and backwards: a quarter of the power, twice 3 dB, at the cutoff.
    edge = np.sin(2 * np.pi * 6 * time + 0.3)
    assert low_passed(edge, 50.0)[50:-50] == pytest.approx(edge[50:-50] / 2, abs=0.01)
    with pytest.raises(MotionError, match="25 Hz"):
        low_passed(slow, 50.0, 25.0)
