import numpy as np
import pytest
from rigs import at_rest

from gesturekit.motion import Motion
from gesturekit.motion.contacts import contact_labels, floor_height, foot_points, foot_positions


def still(person, n_frames=10, speed=0.0, fps=30.0):
    path = speed * np.arange(n_frames)[:, None] / fps * [0.0, 0.0, 1.0]
    return at_rest(person, n_frames, person.offsets[0] + path, fps)


def test_points_are_heels_and_toes(person):
    points = foot_points(person)
    assert [p.joint for p in points] == ["LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase"]
    places = foot_positions(still(person))[0]
    np.testing.assert_allclose(places[0], [0.1, 0.08, 0.0], atol=1e-12)
    np.testing.assert_allclose(places[1], [0.1, 0.02, 0.14], atol=1e-12)


def test_a_foot_without_toe_joint_has_its_toe_at_the_end_site(shared_data):
    motion = Motion.load(shared_data / "motion/reactidle/003_genuine.bvh")
    points = foot_points(motion.skeleton)
    assert [p.joint for p in points] == ["foot.L", "foot.L", "foot.R", "foot.R"]
    assert 0.1 < np.linalg.norm(points[1].offset) < 0.2  # metres: a foot's length


def test_the_floor_is_the_lowest_joint_but_for_a_few_frames(person):
    """Toes are 0.88 m below the hips, which fall through the floor for 2 frames of 100."""
    heights = np.where(np.arange(100) // 2 == 20, 0.5, 0.9)
    motion = at_rest(person, 100, heights[:, None] * [0.0, 1.0, 0.0])
    assert floor_height(motion) == pytest.approx(0.02)


@pytest.mark.parametrize("fps", [24.0, 120.0])
def test_threshold_is_a_speed(person, fps):
    assert contact_labels(still(person, speed=0.1, fps=fps)).min() == 1
    assert contact_labels(still(person, speed=0.4, fps=fps)).max() == 0
    assert contact_labels(still(person, speed=0.4, fps=fps), threshold=0.6).min() == 1
