"""Anatomical frames of a rig at rest, worked out by hand: feet, hands and lengths of limbs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rigs import at_rest, with_offsets
from scipy.spatial.transform import Rotation

from gesturekit.motion import Skeleton
from gesturekit.motion.parts import SIDES, find_parts
from gesturekit.motion.retarget.body_frames import BodyFrames, body_frames
from gesturekit.motion.retarget.feet import FootMotion

FOOT = 0.15


def frames_of(rig: Skeleton) -> BodyFrames:
    return body_frames(rig, find_parts(rig), at_rest(rig, 1).rotations[0])


def with_feet(rig: Skeleton, bone: tuple[float, float, float]) -> Skeleton:
    return with_offsets(rig, LeftToeBase=bone, RightToeBase=bone)


def with_soles(rig: Skeleton, bone: tuple[float, float, float]) -> Skeleton:
    """The rig whose feet end in an end site instead of a toe joint."""
    kept = at_rest(rig, 1).keep([name for name in rig.names if "Toe" not in name]).skeleton
    ends = dict.fromkeys(("LeftFoot", "RightFoot"), (np.array(bone),))
    return replace(kept, end_sites=ends)


def test_a_body_in_a_t_pose_that_faces_z_has_the_axes_of_the_world(person):
    frames = frames_of(replace(person, end_sites={}))
    assert len(frames.joints) == person.n_joints
    for segment, turn in frames.world(at_rest(person, 1).rotations[0]).items():
        np.testing.assert_allclose(turn, [0, 0, 0, 1], atol=1e-9, err_msg=segment)
    ends = {segment: person.names[joint] for segment, (joint, _) in frames.bones.items()}
    bones = {"shoulder": "ForeArm", "elbow": "Hand", "hip": "Leg", "knee": "Foot"}
    expected = {f"{s}_{part}": f"{s.title()}{end}" for s in SIDES for part, end in bones.items()}
    assert ends == expected


def test_joints_of_spine_and_neck_are_numbered_from_below(person):
    names = [*person.names, "UpperNeck"]
    neck, head = person.index("Neck"), person.index("Head")
    parents = [*person.parents, neck]
    parents[head] = len(names) - 1
    order = [*range(head), len(names) - 1, *range(head, len(names) - 1)]
    rig = Skeleton(
        tuple(names[j] for j in order),
        tuple(-1 if parents[j] < 0 else order.index(parents[j]) for j in order),
        np.concatenate([person.offsets, [[0.0, 0.05, 0.0]]])[order],
    )
    frames = frames_of(rig)
    found = {name: rig.names[frames.joints[name]] for name in frames.chain("spine")}
    assert found == {"spine0": "Spine", "spine1": "Chest"}
    found = {name: rig.names[frames.joints[name]] for name in frames.chain("neck")}
    assert found == {"neck0": "Neck", "neck1": "UpperNeck"}


@pytest.mark.parametrize("size", [1.0, 30.0])
@pytest.mark.parametrize("build", [with_feet, with_soles])
@pytest.mark.parametrize(
    ("pitch", "level"), [(-5, 27), (0, 27), (9, 27), (11, 11), (59, 59), (61, 27), (80, 27)]
)
def test_a_foot_drawn_level_or_pointing_down_stands_as_most_do(person, build, pitch, level, size):
    """Between 10 and 60 degrees from ankle to toes it is level as drawn, else at 27 degrees."""
    slope = np.radians(pitch)
    rig = build(person, (0.0, -FOOT * np.sin(slope), FOOT * np.cos(slope))).scaled(size)
    for side in ("left", "right"):
        found = frames_of(rig).foot_heights(side)
        assert found == pytest.approx((size * FOOT * np.sin(np.radians(level)), 0.0))


def test_a_foot_whose_toes_are_higher_than_its_ankle_stands_on_its_ankle(person):
    """As on a rig that stands on its heels: measured in a motion, not drawn."""
    frames = frames_of(with_feet(person, (0.0, -0.06, 0.14)))
    motion = at_rest(frames.skeleton, 9, (0.0, 0.9, 0.0))
    up = Rotation.from_euler("x", -40, degrees=True)
    motion.rotations[:, person.index("LeftFoot")] = up.as_quat()
    level = frames.levelled(motion, {"left": np.ones(9, bool), "right": np.zeros(9, bool)})
    raised = up.apply([0.0, -0.06, 0.14])[1]
    assert raised > 0.04 and level.foot_heights("left") == pytest.approx((0.0, raised))
    assert level.foot_heights("right") == pytest.approx((0.06, 0.0))


@pytest.mark.parametrize(
    ("bone", "yaw"),
    [((0.1, -0.05, 0.1), 45.0), ((-0.1, -0.05, 0.0), -90.0), ((0.0, -0.1, 0.005), 0)],
)
def test_a_level_foot_faces_where_its_bone_does(person, bone, yaw):
    """And where the body does if the bone goes straight down."""
    rig = with_feet(person, bone)
    toe = frames_of(rig).world(at_rest(rig, 1).rotations[0])["left_toe"]
    expected = Rotation.from_euler("y", yaw, degrees=True)
    assert (Rotation.from_quat(toe) * expected.inv()).magnitude() == pytest.approx(0, abs=1e-6)


def test_ends_shorter_than_a_centimetre_are_none(person):
    """0.01 m on a reference body of 1.4 m from ankle to head; the person has 1.42 m."""
    for length, found in ((0.0101, False), (0.0102, True)):
        sole = with_soles(person, (0.0, -length * 0.6, length * 0.8))
        assert set(frames_of(sole).toes) == ({"left", "right"} if found else set())
        assert frames_of(sole).foot_heights("left")[0] == pytest.approx(0.6 * length * found)
        arms = at_rest(person, 1).keep([n for n in person.names if "Hand" not in n]).skeleton
        ends = {
            "LeftForeArm": (np.array([length, 0, 0]),),
            "RightForeArm": (np.array([-0.2, 0, 0]),),
        }
        hands = frames_of(replace(arms, end_sites=ends)).hands
        assert set(hands) == ({"left", "right"} if found else {"right"})
    joint, offset = hands["right"]
    assert (arms.names[joint], offset.tolist()) == ("RightForeArm", [-0.2, 0, 0])


def test_legs_are_measured_along_their_bones_and_estimated_without(person):
    uneven = with_offsets(person, LeftLeg=(0.0, -0.32, 0.24), RightFoot=(0.0, -0.4, 0.0))
    frames = frames_of(uneven)
    assert frames.leg_lengths() == pytest.approx({"left": 0.8, "right": 0.82})
    assert frames.leg_length() == pytest.approx(0.81)
    legs = ("Leg", "Foot", "Toe")
    bust = [name for name in person.names if not any(word in name for word in legs)]
    # Arms of 0.29 + 0.25 and 0.28 + 0.25 m: a stature of 2.75 times 0.535 m, 0.57 of it legs.
    frames = frames_of(at_rest(person, 1).keep(bust).skeleton)
    assert frames.leg_length() == pytest.approx(0.57 * 2.75 * 0.535)


def test_directions_of_bones_come_from_positions_where_given(person):
    """A forearm that is moved to point up, though no joint turns."""
    motion, hand = at_rest(person, 2), person.index("LeftHand")
    positions = motion.positions()
    elbow = positions[:, person.index("LeftForeArm")]
    positions[:, hand] = elbow + [0.0, 0.25, 0.0]
    found = frames_of(person).world(motion.global_rotations(), positions)
    up = Rotation.from_quat(found["left_elbow"]).apply([1.0, 0, 0])
    np.testing.assert_allclose(up, np.tile([0, 1, 0], (2, 1)), atol=1e-9)
    positions[:, hand] = elbow  # no direction: that of the rotation
    found = frames_of(person).world(motion.global_rotations(), positions)
    np.testing.assert_allclose(found["left_elbow"], np.tile([0, 0, 0, 1], (2, 1)), atol=1e-9)


def test_feet_that_stand_for_five_frames_give_their_heights(person):
    """The left foot stands with raised toes at first; four frames of it are too few."""
    frames = frames_of(person)
    for count in (5, 4):
        motion = at_rest(person, 30, (0.0, 0.9, 0.0))
        swing = Rotation.from_rotvec(np.outer(0.3 * np.arange(30), [1.0, 0, 0])).as_quat()
        motion.rotations[count:, person.index("LeftUpLeg")] = swing[count:]
        motion.rotations[:count, person.index("LeftFoot")] = Rotation.from_rotvec(
            [0.2, 0, 0]
        ).as_quat()
        feet = FootMotion.measure(motion, frames, motion.positions(), motion.global_rotations())
        assert feet.standing["left"].sum() == count and feet.standing["right"].all()
        assert feet.floor == pytest.approx(0.02, abs=1e-9)
        own, target = feet.heights(frames, frames_of(person.scaled(2.0)), False, 2.0)["left"]
        assert target == pytest.approx((0.12, 0.0))
        tip = Rotation.from_rotvec([0.2, 0, 0]).apply([0, -0.06, 0.14])[1]
        measured = (0.06, 0.06 + tip) if count == 5 else (0.06, 0.0)
        assert own == pytest.approx(measured)
        same = feet.heights(frames, frames, True, 2.0)["left"]
        np.testing.assert_allclose(same, [measured, 2 * np.array(measured)], atol=1e-9)
