from __future__ import annotations

import numpy as np
import pytest

from gesturekit.errors import MotionError
from gesturekit.evaluation import arm_speed, arm_speed_ratio, jerk, jerk_ratio, max_speed
from gesturekit.motion import Motion


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


def moved(motion: Motion, height: np.ndarray) -> Motion:
    translation = np.stack([np.zeros_like(height), height, np.zeros_like(height)], axis=1)
    return Motion(motion.skeleton, motion.rotations, translation, motion.fps)


def test_jerk_of_a_cubic_path_is_its_third_derivative(turning):
    time = np.arange(20) / 25.0
    rising = moved(turning({"LeftArm": np.zeros(20)}), 0.5 * time**3)
    assert jerk(rising) == pytest.approx(3.0, rel=1e-6)


def test_max_speed_finds_a_jump(turning):
    height = np.zeros(20)
    height[10:] = 1.0
    assert max_speed(moved(turning({"LeftArm": np.zeros(20)}), height)) == pytest.approx(25.0)


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
