"""Rigs without legs: arms, head and spine are found, and what needs legs copes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hinges import bent_backwards
from recordings import BANDAI, IDLE, ZEGGS
from rigs import Bones, at_rest, below_a_root, numbered, renamed, rig_of, turned_at_root
from scipy.spatial.transform import Rotation

from gesturekit.errors import MotionError
from gesturekit.formats.axes import file_axes, rotation_to_y_up, turn_axes
from gesturekit.formats.plausibility import guess_unit
from gesturekit.formats.smpl.skeleton import smpl_skeleton
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.contacts import contact_labels, foot_points
from gesturekit.motion.heading import heading, side_axis
from gesturekit.motion.parts import (
    SIDES,
    body_joints,
    find_legs,
    find_parts,
    leg_length,
    part_labels,
    unidentified,
    upper_body,
)
from gesturekit.motion.parts.body_size import body_height, body_size
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.standing_pose import standing_pose
from gesturekit.motion.rotations import invert_quaternions, quaternion_from_rotation_vector
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


def test_thighs_without_knees_are_no_legs(mixamo):
    rig = bust(mixamo, ("LeftLeg", "RightLeg", "Foot", "Toe"))
    assert np.linalg.norm(rig.end_sites["mixamorig:LeftUpLeg"]) > 0.3
    assert {"mixamorig:LeftUpLeg", "mixamorig:RightUpLeg"} <= set(rig.names)
    assert find_parts(rig).legs == {} and part_labels(rig)["mixamorig:LeftUpLeg"] == "other"


def test_legs_that_are_not_recognised_are_not_called_absent(mixamo):
    names = [name for name in mixamo.names if any(word in name for word in LEGS)]
    shaped = renamed(mixamo, {name: f"Bone{n}" for n, name in enumerate(names)})
    assert find_parts(shaped).legs["left"].hip == "Bone0"  # the shape of the rig shows them
    no_feet = bust(shaped, [f"Bone{n}" for n, name in enumerate(names) if "Toe" in name])
    no_feet = replace(no_feet, end_sites={})
    one_leg = bust(shaped, [f"Bone{n}" for n, name in enumerate(names) if "Right" in name])
    for rig in (no_feet, one_leg):
        with pytest.raises(MotionError, match="legs, which may begin at Bone0.*--part"):
            find_parts(rig)
    # Legs that are cut at the ankle are known by name, and still no reason to ignore them.
    with pytest.raises(MotionError, match=r"cannot identify the legs.*--part left_ankle=JOINT"):
        find_parts(bust(mixamo, ("Foot", "Toe")))


def test_legs_below_a_root_at_the_chest_are_not_called_absent():
    """A tree whose root carries the arms, and its spine downwards to the legs."""
    bones: Bones = {
        "Top": (None, (0, 0, 0)),
        "Chest": ("Top", (0, -0.1, 0)),
        "Head": ("Chest", (0, 0.4, 0)),
        "Waist": ("Chest", (0, -0.4, 0)),
    }
    for side, x in (("Left", 1), ("Right", -1)):
        bones[f"{side}Arm"] = ("Chest", (0.2 * x, 0, 0))
        bones[f"{side}ForeArm"] = (f"{side}Arm", (0.28 * x, 0, 0))
        bones[f"{side}Thigh"] = ("Waist", (0.1 * x, 0, 0))
        bones[f"{side}Foot"] = (f"{side}Thigh", (0, -0.9, 0))
    rig = rig_of(bones)
    with pytest.raises(MotionError, match="which may begin at Waist"):
        find_parts(rig)
    assert find_parts(bust(rig, ("Thigh", "Foot"))).head == "Head"


def test_arms_named_by_hand_are_enough(mixamo):
    rig = bust(mixamo)
    plain = numbered(rig)
    with pytest.raises(MotionError, match=r"arms and legs.*--part left_elbow=JOINT"):
        find_parts(plain)
    known = find_parts(rig).arms
    parts = {
        f"{side}_{part}": plain.names[rig.index(getattr(known[side], part))]
        for side in SIDES
        for part in ("shoulder", "elbow", "wrist")
    }
    found = find_parts(plain, parts)
    assert (found.pelvis, found.legs, len(found.spine)) == ("Joint0", {}, 3)
    assert found.arms["right"].wrist == parts["right_wrist"]


@pytest.mark.parametrize(
    ("names", "pelvis"),
    [
        (("Scene", "Hips", "Spine", "Chest"), "Hips"),
        (("Scene", "Lift", "Pelvis", "Chest"), "Pelvis"),
        (("Scene", "Hips", "LowerHips", "Chest"), "LowerHips"),
        (("Scene", "BodyRoot", "Spine", "Chest"), "BodyRoot"),
        (("Scene", "BodyRoot", "Hips", "Chest"), "Hips"),
        (("Scene", "Lift", "Spine", "Chest"), "Scene"),
        (("Hips", "Lift", "Spine", "Chest"), "Hips"),
        (("Hips", "BodyRoot", "Spine", "Chest"), "Hips"),
    ],
)
def test_the_pelvis_of_a_body_without_legs_is_named_or_the_root(person, names, pelvis):
    rig = below_a_root(bust(person), 0.9)
    usual = ("Reference", "Hips", "Spine", "Chest")
    assert find_parts(renamed(rig, dict(zip(usual, names, strict=True)))).pelvis == pelvis


def test_arms_on_the_root_are_an_error(mixamo):
    rig = bust(mixamo, (*LEGS, "Spine1", "Spine2"))
    rig = bust(rig, ("Spine",))
    says = "the arms hang on 'mixamorig:Hips': the rig has no spine"
    with pytest.raises(MotionError, match=says):
        find_parts(rig)


def test_size_and_unit_are_those_of_the_whole_person(mixamo, zeggs, shared_data):
    bandai = Motion.load(shared_data / BANDAI).skeleton
    idle = Motion.load(shared_data / IDLE).skeleton  # no wrists
    for whole in (mixamo, zeggs.skeleton, bandai, smpl_skeleton(24), idle):
        endings = (*LEGS, "shin", "thigh", "foot")
        rig = bust(whole, endings)
        assert body_height(rig) == pytest.approx(body_height(whole), rel=0.09)
        assert body_size(rig.scaled(3)) == pytest.approx(3 * body_size(rig))
        rest = at_rest(rig, 1).rotations[0]
        for unit, factor in (("m", 1.0), ("cm", 100.0), ("mm", 1000.0)):
            assert guess_unit(rig.scaled(factor), rest) == (unit, True)


def test_functions_that_need_feet_report_missing_legs(zeggs):
    motion = without(zeggs)
    assert foot_points(motion.skeleton) == () and contact_labels(motion).shape == (300, 0)
    assert lock_feet(motion) is motion
    with pytest.raises(MotionError, match="the rig has no legs"):
        leg_length(motion.skeleton)
    hinges = bent_backwards(motion)
    assert set(hinges) == {"left_elbow", "right_elbow"}
    whole = bent_backwards(zeggs)
    for side in SIDES:
        assert (hinges[f"{side}_elbow"] == whole[f"{side}_elbow"]).mean() > 0.95


def test_shoulders_give_the_heading(zeggs):
    turn = quaternion_from_rotation_vector(np.array([0.0, 1.2, 0.0]))
    for motion, expected in ((zeggs, 0.0), (turned_at_root(zeggs, turn), 1.2)):
        assert heading(without(motion)) == pytest.approx(heading(motion), abs=0.1)
        assert heading(without(motion)) == pytest.approx(expected, abs=0.2)
    assert side_axis([without(zeggs)], 0) @ side_axis([zeggs], 0) > 0.99


@pytest.mark.parametrize("axes", [("y", "z"), ("z", "-y"), ("z", "x"), ("-y", "-z")])
def test_axes_are_seen_at_spine_neck_and_shoulders(zeggs, axes):
    back = invert_quaternions(rotation_to_y_up(*axes))
    found = file_axes(turn_axes(without(zeggs), back, back))
    assert ((found.up, found.forward), found.guessed) == (axes, ())


def test_axes_of_a_rig_without_a_plausible_rest_pose_are_detected_from_motion(shared_data):
    whole = Motion.load(shared_data / BANDAI)
    found = file_axes(without(whole))
    assert (found.up, found.guessed) == ("y", ("forward",)) == (file_axes(whole).up, ("forward",))
    pose = standing_pose(without(whole))
    assert not np.allclose(pose, [0, 0, 0, 1])


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
    """Arms of 0.29 + 0.25 and 0.28 + 0.25 m: a stature of 2.75 times 0.535 m, 0.57 of it legs.

    The hips of the person are 0.82 m over the ankles, and 0.88 m over the toes.
    """
    would = 0.57 * 2.75 * 0.535
    way = np.stack([np.linspace(0, 1, 31), np.linspace(-0.1, 0.1, 31), np.linspace(0, -2, 31)], 1)
    source = at_rest(bust(person), 31, [0.3, 1.7, 0.1] + way)
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
    made = retarget(source, bust(person)).translation
    floor = 1.7 - 0.88
    np.testing.assert_allclose(made[:, 1], floor + 0.88 * would / 0.82, atol=1e-6)
    walked = 0.1 * would / 0.82 * way[:, [0, 2]]
    np.testing.assert_allclose(made[:, [0, 2]], [0.3, 0.1] + walked, atol=1e-6)


def test_retargeting_from_and_to_an_upper_body(zeggs, mixamo):
    source = without(zeggs)
    again = retarget(source, source.skeleton)
    np.testing.assert_allclose(again.positions(), source.positions(), atol=1e-6)
    on_bust = retarget(zeggs, bust(mixamo))
    assert (arms_of(on_bust) * arms_of(zeggs)).sum(axis=-1).min() > 0.7
    scale = leg_length(mixamo) / leg_length(zeggs.skeleton)
    hips = np.median(zeggs.positions()[:, 0, 1]) * scale
    assert np.median(on_bust.positions()[:, 0, 1]) == pytest.approx(hips, rel=0.05)


def test_a_rig_of_ten_joints_as_in_corpora_of_talks():
    bones: Bones = {
        "spine": (None, (0, 0, 0)),
        "neck": ("spine", (0, 0.45, 0)),
        "nose": ("neck", (0, 0.1, 0.08)),
        "head": ("nose", (0, 0.12, -0.04)),
    }
    for side, x in (("r", -1), ("l", 1)):
        bones[f"{side}_shoulder"] = ("neck", (0.18 * x, -0.02, 0))
        bones[f"{side}_elbow"] = (f"{side}_shoulder", (0.04 * x, -0.28, 0))
        bones[f"{side}_wrist"] = (f"{side}_elbow", (0, -0.05, 0.24))
    rig = rig_of(bones)
    parts = find_parts(rig)
    assert (parts.pelvis, parts.spine, parts.head, parts.legs) == ("spine", ("neck",), "head", {})
    assert parts.arms["right"].wrist == "r_wrist"
    assert 1.6 < body_height(rig) < 1.9
