"""What is drawn for real and for unknown skeletons."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import AITVIEWER, IDLE, ZEGGS
from rigs import at_rest
from scipy.spatial.transform import Rotation

from gesturekit.motion import Motion
from gesturekit.viewer.figure import LEFT, MIDDLE, RIGHT, Figure

RECORDINGS = {
    ZEGGS: (1.5, 1.95),
    AITVIEWER: (1.5, 1.95),
    IDLE: (1.3, 1.95),
    "motion/bandai/dataset-2_wave-both-hands_normal_001.bvh": (1.4, 1.95),
}


@pytest.fixture(scope="module", params=RECORDINGS)
def recording(request: pytest.FixtureRequest, shared_data: Path) -> tuple[Motion, Figure]:
    motion = Motion.load(shared_data / request.param)
    motion = motion[:150]
    figure = Figure.of(motion)
    low, high = RECORDINGS[request.param]
    assert low < figure.height < high
    return motion, figure


def test_a_person_has_a_head_two_sides_and_stands_on_the_floor(recording):
    _, figure = recording
    assert figure.head is not None
    assert {limb.side for limb in figure.limbs} == {LEFT, MIDDLE, RIGHT}
    lowest = figure.points[:, :, 1].min(axis=1)
    assert np.median(np.abs(lowest - figure.floor)) < 0.06


def test_a_person_looks_to_the_front_with_its_left_on_the_left(recording):
    _, figure = recording
    front = np.array([np.sin(figure.front), 0, np.cos(figure.front)])
    left = np.cross([0, 1, 0], front)
    base, _, face = figure.head
    looks = figure.points[:, face] - figure.points[:, base]
    assert np.mean(looks @ front) > 0.5 * figure.head_size
    sides = {
        side: np.mean(
            [figure.points[:, limb.ends[1]] @ left for limb in figure.limbs if limb.side == side]
        )
        for side in (LEFT, RIGHT)
    }
    assert sides[LEFT] > sides[RIGHT]


def test_hand_speed_is_relative_to_the_hips_under_a_still_root(shared_data):
    motion = Motion.load(shared_data / "motion/bandai/dataset-1_bye_old_001.bvh")
    assert list(motion.joint_translations) == ["Hips"]
    still = Figure.of(motion).hand_speed
    walk = np.outer(np.arange(motion.n_frames) / motion.fps, [1.0, 0.0, 0.0])
    hips = motion.joint_translations["Hips"]
    walking = replace(motion, joint_translations={"Hips": hips + walk})
    np.testing.assert_allclose(Figure.of(walking).hand_speed, still, atol=1e-9)


@pytest.mark.parametrize("front", [0.0, 1.2, -2.5])
def test_a_quadruped_faces_where_its_head_is(quadruped, front):
    motion = at_rest(quadruped, 5, (0, 0.75, 0))
    # Its shoulders are lower than its hips, as an elephant's are.
    turn = Rotation.from_rotvec([0, front, 0]) * Rotation.from_rotvec([0.2, 0, 0])
    motion.rotations[:, 0] = turn.as_quat()
    figure = Figure.of(motion)
    assert figure.front == pytest.approx(front)
    base, _, face = figure.head
    looks = figure.points[0, face] - figure.points[0, base]
    assert looks @ [np.sin(front), 0, np.cos(front)] > 0.9 * figure.head_size


@pytest.mark.parametrize("factor", [0.1, 1.0, 2.0])
def test_a_view_from_the_waist_up_has_the_hips_and_not_the_knees(skeleton, factor):
    motion = at_rest(skeleton, 5, (0, 0.9, 0)).scaled(factor)
    figure = Figure.of(motion)
    hips, knee = (motion.positions()[0, skeleton.index(name), 1] for name in ("Hips", "LeftLeg"))
    assert knee < figure.floor + figure.below("waist") < hips
    assert figure.below("whole") == 0.0


def test_the_speed_of_hands_is_that_of_both(skeleton):
    """The chest turns by a radian a second from the middle on: each hand, 0.7 m away, at 0.7 m/s.

    The curve is smoothed, so that it has half of it at the start.
    """
    motion = at_rest(skeleton, 101, fps=50.0)
    yaw = np.maximum(motion.times - 1.0, 0.0)
    motion.rotations[:, skeleton.index("Chest")] = Rotation.from_euler("y", yaw[:, None]).as_quat()
    figure = Figure.of(motion)
    found = figure.hand_speed[[0, 50, 80, 100]]
    np.testing.assert_allclose(found, [0, 0.7, 1.4, 1.4], atol=0.03)
    np.testing.assert_array_equal(Figure.of(motion[:1]).hand_speed, [0.0])
    assert Figure.of(motion[60:62]).hand_speed == pytest.approx(1.4, rel=1e-3)
