from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gesturekit.errors import MotionError
from gesturekit.evaluation import (
    JointLimits,
    floor_penetration,
    foot_skate,
    joint_limit_share,
    standing_heights,
)
from gesturekit.motion import Motion
from gesturekit.motion.parts.body_size import body_scale


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
        foot_skate(standing.slice(0, 1))


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
