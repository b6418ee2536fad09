"""Placement on a person whose `body_scale` is 1. At 24 fps a pose decays within 12 frames."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import PERSON, at_rest, rig_of
from scipy.spatial.transform import Rotation

from gesturekit.motion import Motion
from gesturekit.motion.ik import reach_feet
from gesturekit.motion.root_path import heading
from gesturekit.postprocess import Placement

RIG = rig_of(PERSON).scaled(1.4 / 1.44)
LEG, DEGREE = 0.84 * 1.4 / 1.44, np.pi / 180
FEET = [RIG.index("LeftFoot"), RIG.index("RightFoot")]


def about_y(angles: np.ndarray | float) -> np.ndarray:
    return Rotation.from_rotvec(np.multiply.outer(angles, [0.0, 1.0, 0.0])).as_quat()


def standing(n_frames: int = 60) -> Motion:
    """Knees bent, ankles 0.04 m above the ground below the hips."""
    motion = at_rest(RIG, n_frames, fps=24.0)
    for side in ("Left", "Right"):
        for bone, degrees in (("UpLeg", -20.0), ("Leg", 40.0), ("Foot", -20.0)):
            turn = Rotation.from_euler("x", degrees, degrees=True).as_quat()
            motion.rotations[:, RIG.index(side + bone)] = turn
    motion.translation[:, 1] = 0.04 - motion.positions()[0, FEET[0], 1]
    return motion


def ankles(motion: Motion) -> np.ndarray:
    """(T, 2, 3) positions of the ankles."""
    return motion.positions()[:, FEET]


def stance(motion: Motion, *moved: tuple[float, float, float], yaw: float = 0.0) -> Motion:
    """The first frame with both feet moved, and turned outward by `yaw` radians."""
    turns = about_y(np.array([[yaw, -yaw]]))
    return reach_feet(motion[:1], ankles(motion)[:1] + np.array(moved), turns)


def wide(by: float, **more: float) -> Motion:
    return stance(standing(), (by, 0, 0), (-by, 0, 0), **more)


@pytest.mark.parametrize("first", ["left", "right"])
def test_far_feet_step_one_after_the_other_and_a_raised_one_first(first):
    """Feet 0.15 m too far out."""
    up = 0.02 if first == "right" else 0.0
    pose = stance(standing(), (0.15, 0, 0), (-0.15, up, 0))
    made = ankles(Placement(start=pose).applied(standing())) - ankles(standing())
    order = (0, 1) if first == "left" else (1, 0)
    for foot, begins in zip(order, (0, 12), strict=True):
        out = (0.15, -0.15)[foot]
        assert made[: begins + 1, foot, 0] == pytest.approx(out, abs=1e-9)
        left = made[begins : begins + 13, foot, 0] / out
        assert left[0] == pytest.approx(1) and (np.diff(left) < 0).all()
        assert np.abs(np.diff(left)).max() < 0.3, "smoothly"
        assert 0.02 < made[begins : begins + 13, foot, 1].max() < 0.1, "off the floor"
        # After a third of the 12 frames, x² (3 - 2x) of the 20/27 by which it is not yet lowered.
        assert left[4] == pytest.approx((20 / 27) ** 2 * (3 - 40 / 27))
        np.testing.assert_allclose(made[begins + 12 :, foot], 0, atol=1e-9)


def test_the_end_is_the_beginning_seen_backwards():
    """Without a start pose near feet may be where the end wants them from the first frame on."""
    start = ankles(Placement(start=wide(0.15)).applied(standing()))
    end = ankles(Placement(end=wide(0.15)).applied(standing()))
    np.testing.assert_allclose(end[::-1], start, atol=1e-9)
    alone = ankles(Placement(end=wide(0.05)).applied(standing())) - ankles(standing())
    np.testing.assert_allclose(alone[:, 0], np.tile([0.05, 0, 0], (60, 1)), atol=1e-9)
    both = Placement(start=standing()[:1], end=wide(0.05)).applied(standing())
    left = (ankles(both) - ankles(standing()))[:, 0]
    assert left[[0, 30, 47, 59], 0] == pytest.approx([0, 0, 0, 0.05], abs=1e-9)
    assert 0.01 < left[53, 0] < 0.04 and 0.02 < left[53, 1] < 0.1, "a step"


@pytest.mark.parametrize(("n_frames", "count"), [(60, 12), (20, 5), (5, 1)])
def test_a_pose_decays_within_half_a_second_or_a_quarter_of_the_motion(n_frames, count):
    pose = standing(1)
    arm = RIG.index("LeftArm")
    pose.rotations[:, arm] = Rotation.from_euler("z", 0.8).as_quat()
    turned = Placement(start=pose).applied(standing(n_frames)).rotations[:, arm]
    angles = Rotation.from_quat(turned).as_rotvec()[:, 2]
    assert angles[0] == pytest.approx(0.8) and (np.diff(angles[: count + 1]) < 0).all()
    np.testing.assert_allclose(angles[count:], 0, atol=1e-9)
    if count == 12:  # 1 - x² (3 - 2x) after a third
        assert angles[4] == pytest.approx(0.8 * 20 / 27)


def test_a_pose_of_a_taller_person_is_put_on_the_body_above_its_floor():
    """Hips of a body twice as tall on a floor at 1 m; without a floor it is assumed at 0."""
    small = standing(1)
    tall = small.scaled(2.0)
    raised = replace(tall, translation=tall.translation + [0, 1, 0], info={"floor": 1.0 + 2 * 0.04})
    for pose in (tall, raised):
        made = Placement(start=pose).applied(standing())
        np.testing.assert_allclose(made.positions(), standing().positions(), atol=1e-6)


def wandering(rig_motion: Motion, per_second: float, turn: float) -> Motion:
    """Goes from (1, -2) to +X, and turns from 0.3 rad on, per second."""
    times = np.arange(rig_motion.n_frames) / 24.0
    rotations = rig_motion.rotations.copy()
    rotations[:, 0] = about_y(0.3 + turn * times)
    place = rig_motion.translation + [1.0, 0, -2.0] + per_second * times[:, None] * [1, 0, 0]
    return replace(rig_motion, rotations=rotations, translation=place)


@pytest.mark.parametrize("legs", [True, False])
def test_steady_wandering_is_removed_from_the_first_half_second_on(legs):
    """The body goes at 0.5 m/s, and turns on, for a part of the first half second at most."""
    free = wandering(standing(240), 0.5, 1.0)
    if not legs:
        free = free.keep([n for n in RIG.names if "Leg" not in n and "Foot" not in n])
    made = Placement(in_place=True, foot_lock=False).applied(free)
    place = made.translation[60:180]
    assert np.ptp(place, axis=0).max() < 1e-3 and 1.0 < place[0, 0] < 1.25
    np.testing.assert_allclose(place[0, 1:], [free.translation[0, 1], -2.0], atol=1e-3)
    turned = [heading(made[k : k + 1]) for k in (60, 120, 180)]
    assert np.ptp(turned) < 1e-3 and 0.3 < turned[0] < 0.8
    still = wandering(standing(60), 0.0, 0.0)
    for lock in (False, True):
        same = Placement(in_place=True, foot_lock=lock).applied(still)
        np.testing.assert_allclose(same.positions(), still.positions(), atol=1e-6)
    assert Placement().applied(still) is still
