"""Speeds, jerk, feet and joint limits, against numbers worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rigs import without_joints

from gesturekit.errors import MotionError
from gesturekit.evaluation import (
    JointLimits,
    arm_speed,
    arm_speed_ratio,
    floor_penetration,
    foot_skate,
    jerk,
    jerk_ratio,
    joint_limit_share,
    max_speed,
    standing_heights,
)
from gesturekit.evaluation.metrics.physical import low_passed, wrist_speed
from gesturekit.motion import Motion
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


def test_max_speed_finds_a_jump(turning):
    jump = np.zeros((20, 3))
    jump[10:, 1] = 1.0
    assert max_speed(moved(turning({"LeftArm": np.zeros(20)}), jump)) == pytest.approx(25.0)


def test_ratios_compare_with_a_recording(turning):
    slow, fast = turning({"LeftArm": np.ones(20)}), turning({"LeftArm": 2 * np.ones(20)})
    assert arm_speed_ratio(fast, slow) == pytest.approx(2.0)
    assert jerk_ratio(fast, slow) == pytest.approx(8.0, rel=0.01)


def test_nothing_to_compare_with_and_too_few_frames_are_errors(turning):
    still, moving = turning({"LeftArm": np.zeros(20)}), turning({"LeftArm": np.ones(20)})
    with pytest.raises(MotionError, match="arm speed is zero"):
        arm_speed_ratio(moving, still)
    with pytest.raises(MotionError, match="resample"):
        jerk_ratio(moving, turning({"LeftArm": np.ones(20)}, 30.0))
    with pytest.raises(MotionError, match="has 3 frames; at least 4"):
        jerk(turning({"LeftArm": np.ones(3)}))


def test_the_first_and_the_last_frame_have_the_step_beside_them(turning):
    motion = turning({"LeftArm": np.array([1.0, 2.0, 4.0, 0.0])})
    assert arm_speed(motion) == pytest.approx([1.0, 1.5, 3.0, 4.0])


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


def test_frame_rate_does_not_change_foot_skate(standing):
    glide = moved(standing, np.outer(np.sin(standing.times), [1.0, 0.0, 0.0]))
    heights = standing_heights(standing)
    assert foot_skate(glide.resample(25.0), heights) == pytest.approx(
        foot_skate(glide, heights), rel=0.01
    )


def test_penetration_is_the_depth_below_the_standing_height(standing):
    heights = standing_heights(standing)
    assert floor_penetration(moved(standing, np.array([0, -0.03, 0])), heights) == pytest.approx(
        0.03
    )
    assert floor_penetration(moved(standing, np.array([0, 0.2, 0])), heights) == 0.0


def test_one_frame_has_no_speed(standing):
    with pytest.raises(MotionError, match="has 1 frame"):
        foot_skate(standing[:1])


def test_joints_beyond_recorded_limits_are_counted_per_frame(turning):
    def elbow(speed: float) -> Motion:
        return turning({"LeftForeArm": np.full(101, speed)}, 50.0)

    limits = JointLimits.fit([elbow(0.5)], ("LeftForeArm", "RightForeArm"))
    assert joint_limit_share(elbow(0.5), limits) == 0.0
    # Recorded: 0 to 1 rad. Twice as fast it is beyond 1 rad plus 5° (0.0873 rad) after 54.4 of
    # 101 frames; of the two joints only one is: 46 / 101 / 2.
    assert joint_limit_share(elbow(1.0), limits) == pytest.approx(46 / 202)
    with pytest.raises(MotionError, match="no recording"):
        JointLimits.fit([], ("LeftForeArm",))


def test_the_standing_height_is_the_median_while_standing(standing):
    low = standing_heights(standing)
    # A fifth of the time it stands a step higher.
    step = np.zeros((standing.n_frames, 3))
    step[80:, 1] = 0.2
    np.testing.assert_allclose(standing_heights(moved(standing, step)), low, atol=1e-9)


def test_rates_up_to_a_thousandth_apart_are_one_rate(turning):
    motion = turning({"LeftArm": np.ones(20)})
    for rate, same in ((25.02, True), (25.03, False), (24.98, True), (24.97, False)):
        other = replace(motion, fps=rate)
        if same:
            assert jerk_ratio(other, motion) == pytest.approx((rate / 25) ** 3)
        else:
            with pytest.raises(MotionError, match="resample"):
                jerk_ratio(other, motion)


def test_wrist_speed_needs_wrists(turning):
    motion = turning({"LeftForeArm": np.full(20, 2.0)})
    # 2 rad/s at 0.25 m on one side, over frames of 0.08 rad; nothing on the other.
    step = 2 * 0.25 * np.sin(0.04) * 25
    assert wrist_speed(motion) == pytest.approx(np.full(19, step / 2))
    with pytest.raises(MotionError, match="no wrist joints"):
        wrist_speed(without_joints(motion, "Hand"))


def test_low_passed_paths_are_in_time_and_lose_what_is_faster():
    time = np.arange(200) / 50.0
    slow, fast = np.sin(2 * np.pi * time), np.sin(2 * np.pi * 20 * time)
    assert low_passed(slow, 50.0, 6.0)[20:-20] == pytest.approx(slow[20:-20], abs=0.01)
    assert np.abs(low_passed(fast, 50.0, 6.0)[20:-20]).max() < 0.02
    assert low_passed(slow, 50.0, 24.9).shape == (200,)
    for cutoff in (0.0, 25.0, 30.0):
        with pytest.raises(MotionError, match="between 0 and 25 Hz"):
            low_passed(slow, 50.0, cutoff)
