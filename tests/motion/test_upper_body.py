"""Rigs without legs: arms, head and spine are found, and what needs legs copes."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from recordings import BANDAI, ZEGGS
from rigs import at_rest
from scipy.spatial.transform import Rotation

from gesturekit.errors import MotionError
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.contacts import contact_labels, foot_points
from gesturekit.motion.parts import (
    body_joints,
    find_legs,
    find_parts,
    leg_length,
    part_labels,
    unidentified,
    upper_body,
)
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.body_frames import BodyFrames
from gesturekit.postprocess import lock_feet

LEGS = ("UpLeg", "Leg", "Foot", "Toe", "hip", "knee", "ankle", "left_foot", "right_foot")


def without(motion: Motion, endings: Iterable[str] = LEGS) -> Motion:
    """The motion without the joints whose names have one of `endings` in them."""
    kept = [n for n in motion.skeleton.names if not any(word in n for word in endings)]
    return motion.keep(kept)


def bust(skeleton: Skeleton, endings: Iterable[str] = LEGS) -> Skeleton:
    return without(at_rest(skeleton, 2), endings).skeleton


@pytest.fixture(scope="module")
def zeggs(shared_data) -> Motion:
    return Motion.load(shared_data / ZEGGS)[:300]


def test_all_parts_but_the_legs_are_those_of_the_whole_rig(mixamo, person, zeggs, shared_data):
    bandai = Motion.load(shared_data / BANDAI).skeleton
    for whole in (mixamo, person, zeggs.skeleton, bandai, smpl_skeleton(55)):
        rig = bust(whole)
        found, expected = find_parts(rig), find_parts(whole)
        ends = tuple(name for name in expected.ends if name in rig.names)
        assert found == replace(expected, legs={}, ends=ends)
        assert (unidentified(rig), find_legs(rig)) == ("", None)
        labels, usual = part_labels(rig), part_labels(whole)
        assert labels == {name: usual[name] for name in rig.names}
        legs = set(whole.names) - set(rig.names)
        assert set(body_joints(rig)) == set(body_joints(whole)) - legs
        assert upper_body(rig) == upper_body(whole)


def test_functions_that_need_feet_report_missing_legs(zeggs):
    motion = without(zeggs)
    assert foot_points(motion.skeleton) == () and contact_labels(motion).shape == (300, 0)
    assert lock_feet(motion) is motion
    with pytest.raises(MotionError, match="legs"):
        leg_length(motion.skeleton)


def arms_of(motion: Motion) -> np.ndarray:
    """Unit vectors (T, 4, 3) along upper arms and forearms."""
    parts, places = find_parts(motion.skeleton), motion.positions()
    bones = []
    for arm in parts.arms.values():
        joints = [motion.skeleton.index(name) for name in (arm.shoulder, arm.elbow, arm.wrist)]
        bones += list(np.moveaxis(np.diff(places[:, joints], axis=1), 1, 0))
    bones = np.stack(bones, axis=1)
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True)


def test_retargeting_to_a_whole_body_stands_it_on_the_floor(zeggs):
    source = without(zeggs)
    source = replace(source, translation=source.translation + [0, 3.0, 0])  # no floor is known
    moved = retarget(source, smpl_skeleton(24))
    assert (arms_of(moved) * arms_of(source)).sum(axis=-1).min() > 0.7
    places, rig = moved.positions(), moved.skeleton
    legs = find_parts(rig).legs
    feet = [rig.index(name) for leg in legs.values() for name in (leg.ankle, leg.toe)]
    lowest = places[:, feet, 1].min(axis=1)
    assert np.median(lowest) == pytest.approx(0, abs=0.02) and np.ptp(lowest) < 0.15
    for leg in legs.values():  # straight below the hips, whatever the pelvis leans
        bone = places[:, rig.index(leg.ankle)] - places[:, rig.index(leg.hip)]
        assert (-bone[:, 1] / np.linalg.norm(bone, axis=-1)).min() > 0.99


def test_an_upper_body_is_scaled_by_the_legs_it_would_have(person):
    """The hips of the person are 0.82 m over the ankles, and 0.88 m over the toes."""
    rig = bust(person)
    would = BodyFrames(rig, at_rest(rig, 1).rotations[0]).leg_length()
    way = np.stack([np.linspace(0, 1, 31), np.linspace(-0.1, 0.1, 31), np.linspace(0, -2, 31)], 1)
    source = at_rest(rig, 31, [0.3, 1.7, 0.1] + way)
    turn = Rotation.from_euler("y", 0.8) * Rotation.from_euler("x", 0.3)
    source.rotations[:, 0] = turn.as_quat()
    whole = retarget(source, person)
    expected = [0.3, 0.88, 0.1] + 0.82 / would * way
    np.testing.assert_allclose(whole.translation, expected, atol=1e-6)
    # Legs hang straight below a pelvis that leans, and face where it does.
    for name in ("LeftUpLeg", "RightLeg", "LeftFoot", "RightToeBase"):
        world = whole.global_rotations()[:, person.index(name)]
        yaw = Rotation.from_quat(world).as_rotvec()
        np.testing.assert_allclose(yaw, np.tile([0, 0.8, 0], (31, 1)), atol=1e-6)
    source = at_rest(person, 31, [0.3, 1.7, 0.1] + way * [1, 0, 1] * 0.1)
    made = retarget(source, rig).translation
    floor = 1.7 - 0.88
    np.testing.assert_allclose(made[:, 1], floor + 0.88 * would / 0.82, atol=1e-6)
    walked = 0.1 * would / 0.82 * way[:, [0, 2]]
    np.testing.assert_allclose(made[:, [0, 2]], [0.3, 0.1] + walked, atol=1e-6)
