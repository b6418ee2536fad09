from dataclasses import replace

import numpy as np
import pytest
from hinges import bent_backwards
from recordings import BANDAI, RECORDED, ZEGGS
from rigs import at_rest, below_a_root, renamed, with_offsets, with_rest_turned
from scipy.spatial.transform import Rotation

from gesturekit.errors import MotionError
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.contacts import contact_labels, foot_positions
from gesturekit.motion.face import smplx_face
from gesturekit.motion.parts import SIDES, find_parts
from gesturekit.motion.retarget import Transfer, retarget
from gesturekit.motion.retarget.body_frames import standing_pose
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotation_angles

UPRIGHT = np.array([0.0, 0.9, 0.0])


@pytest.fixture(scope="module")
def zeggs(shared_data) -> Motion:
    return Motion.load(shared_data / ZEGGS)[:200]


def directions(motion: Motion) -> dict[str, np.ndarray]:
    """Unit vectors (T, 3) along upper arms, forearms, thighs and shanks."""
    parts, positions = find_parts(motion.skeleton), motion.positions()
    found = {}
    for side in SIDES:
        arm, leg = parts.arms[side], parts.legs[side]
        bones = {"upper arm": (arm.shoulder, arm.elbow), "forearm": (arm.elbow, arm.wrist)}
        bones |= {"thigh": (leg.hip, leg.knee), "shank": (leg.knee, leg.ankle)}
        for name, (start, end) in bones.items():
            if end is None:
                continue
            bone = np.subtract(*(positions[:, motion.skeleton.index(n)] for n in (end, start)))
            found[f"{side} {name}"] = bone / np.linalg.norm(bone, axis=1, keepdims=True)
    return found


def degrees_apart(a: Motion, b: Motion) -> dict[str, float]:
    """Mean angle between the bones of two motions."""
    one, other = directions(a), directions(b)
    return {
        name: float(np.degrees(np.arccos(np.clip((one[name] * other[name]).sum(-1), -1, 1))).mean())
        for name in one.keys() & other.keys()
    }


def skate(motion: Motion, labels: np.ndarray) -> float:
    """Mean speed of foot points in m/s, over the frames in which `labels` has them stand."""
    feet = foot_positions(motion)
    speed = np.linalg.norm(np.diff(feet, axis=0, prepend=feet[:1]), axis=-1) * motion.fps
    return float(speed[labels > 0].mean())


@pytest.mark.parametrize("file", RECORDED)
def test_onto_itself_is_the_identity(shared_data, file):
    motion = Motion.load(shared_data / file)[:100]
    same = retarget(motion, motion.skeleton)
    assert np.abs(same.positions() - motion.positions()).max() < 1e-6
    assert rotation_angles(same.rotations, motion.rotations).max() < 0.01


def test_the_same_joints_in_another_rest_pose_are_another_rig(moving_person):
    """At rest one arm points up and one down; sizes of a performer are no other rest pose."""
    for degrees in (25.0, 90.0):
        half = np.deg2rad(degrees / 2)
        turn = np.array([0.0, 0.0, -np.sin(half), np.cos(half)])
        raised = with_rest_turned(moving_person, turn, "LeftArm", "RightArm")
        np.testing.assert_allclose(raised.positions(), moving_person.positions(), atol=1e-9)
        back = retarget(raised, moving_person.skeleton)
        np.testing.assert_allclose(back.positions(), moving_person.positions(), atol=1e-3)


def test_size_scales_steps_and_heights(moving_person):
    large = retarget(moving_person, moving_person.skeleton.scaled(1.3))
    np.testing.assert_allclose(large.rotations, moving_person.rotations, atol=1e-6)
    walked = np.diff(moving_person.translation, axis=0)
    np.testing.assert_allclose(np.diff(large.translation, axis=0), 1.3 * walked, atol=1e-6)
    hips = [moving_person.skeleton.index(f"{side}UpLeg") for side in ("Left", "Right")]
    first, own = (motion.positions()[0, hips].mean(axis=0) for motion in (large, moving_person))
    np.testing.assert_allclose(first[[0, 2]], own[[0, 2]], atol=1e-6)


def test_parts_of_a_stream_go_on_from_one_another(moving_person, mixamo):
    """Each part alone would have its own floor and lean, and begin where it is on the source."""
    whole = replace(moving_person, translation=moving_person.translation + [0.0, 0.3, 0.0])
    transfer = Transfer(mixamo, feet=False)
    expected = transfer(whole).positions()
    parts = [transfer(whole[k : k + 7]).positions() for k in range(0, 60, 7)]
    np.testing.assert_allclose(np.concatenate(parts), expected, atol=1e-3)


def test_faces_are_kept_on_any_rig(moving_person, mixamo):
    faces = np.random.default_rng(0).normal(size=(moving_person.n_frames, 3))
    smiling = replace(moving_person, face=smplx_face(faces))
    for rig in (moving_person.skeleton.scaled(1.2), mixamo):
        np.testing.assert_array_equal(retarget(smiling, rig).face.values, faces)


def test_joints_that_move_scale_with_the_body(moving_person):
    person = moving_person.skeleton
    nod = person.offsets[person.index("Head")] + 0.05 * np.sin(moving_person.times)[:, None]
    nodding = replace(moving_person, joint_translations={"Head": nod})
    large = retarget(nodding, person.scaled(2.0))
    head, neck = (person.index(name) for name in ("Head", "Neck"))
    ways = [m.positions()[:, head] - m.positions()[:, neck] for m in (large, nodding)]
    np.testing.assert_allclose(ways[0], 2 * ways[1], atol=1e-6)


def on_wide_hips(person: Skeleton) -> Skeleton:
    return with_offsets(person, LeftUpLeg=(0.2, 0.0, 0.0), RightUpLeg=(-0.2, 0.0, 0.0))


@pytest.mark.parametrize("yaw", [0.0, 1.0])
def test_hips_come_down_where_legs_have_to_reach_aside(person, yaw):
    """Feet 0.1 m to either side, hips 0.2 m, straight legs of 0.82 m: sqrt(0.82^2 - 0.1^2) =
    0.81388 m of them is upright, 0.00612 m less than on the source.
    """
    motion = at_rest(person, 30, [0.3, 0.9, 0.1])
    motion.rotations[:, 0] = quaternion_from_rotation_vector(np.array([0.0, yaw, 0.0]))
    made = retarget(motion, on_wide_hips(person))
    lowered = motion.positions()[:, 0] - made.positions()[:, 0]
    np.testing.assert_allclose(lowered, np.tile([0, 0.00612, 0], (30, 1)), atol=1e-5)
    feet = [foot_positions(m) for m in (motion, made)]
    np.testing.assert_allclose(feet[1], feet[0], atol=1e-6)


@pytest.mark.parametrize("feet", [True, False])
def test_hips_stand_on_the_legs_and_ankles_of_the_other_rig(person, feet):
    """Legs are half as long again, and ankles 0.1 m above the balls of feet as long as before.

    The balls are 0.21 m ahead of where the hips were, ankles and hips 0.07 m.
    """
    other = renamed(person, {"Hips": "Pelvis"})
    for side, x in (("Left", 0.15), ("Right", -0.15)):
        legs = {"UpLeg": (x, 0, 0), "Leg": (0, -0.63, 0), "Foot": (0, -0.6, 0)}
        legs["ToeBase"] = (0.0, -0.1, 0.14)
        other = with_offsets(other, **{f"{side}{bone}": place for bone, place in legs.items()})
    motion = at_rest(person, 30, [0.3, 0.9, 0.1])
    angles = np.linspace(0.5, 2, 30)
    motion.rotations[:, 0] = quaternion_from_rotation_vector(np.outer(angles, [0.0, 1.0, 0.0]))
    made = retarget(motion, other, feet=feet)
    ahead = 0.07 * np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
    np.testing.assert_allclose(made.positions()[:, 0], ahead + [0.3, 1.35, 0.1], atol=1e-5)
    for name, height in (("LeftFoot", 0.12), ("RightFoot", 0.12), ("LeftToeBase", 0.02)):
        assert made.positions()[:, other.index(name), 1] == pytest.approx(height, abs=1e-5)


@pytest.mark.parametrize(("height", "is_marker"), [(0.15, False), (0.3, True)])
def test_a_root_a_quarter_leg_below_the_hips_is_a_still_marker(moving_person, height, is_marker):
    """The legs are 0.82 m long. At a hundred times the size all is the same."""
    rooted = below_a_root(moving_person.skeleton, height)
    made = retarget(moving_person, rooted)
    assert (np.ptp(made.translation, axis=0).max() == 0) == is_marker
    assert set(made.joint_translations) == ({"Hips"} if is_marker else set())
    for motion, rig in ((moving_person, rooted), (made, moving_person.skeleton)):
        own = retarget(motion, rig)
        large = retarget(motion.scaled(100.0), rig.scaled(100.0))
        np.testing.assert_allclose(large.positions() / 100, own.positions(), atol=1e-6)


def test_offsets_of_hips_that_move_are_no_rest_pose(moving_person):
    """Files whose hips move below a marker may have any place of them as the offset."""
    person, turns = moving_person.skeleton, moving_person.rotations
    head, jaw = person.index("Head"), np.array([[0.0, 0.05, 0.05]])
    jawed = Skeleton((*person.names, "Jaw"), (*person.parents, head),
                     np.concatenate([person.offsets, jaw]), person.end_sites)  # fmt: skip
    rooted = below_a_root(jawed, 0.9)
    still = np.broadcast_to([0.0, 0.0, 0.0, 1.0], turns[:, :1].shape)
    rotations = np.concatenate([still, turns, turns[:, head : head + 1]], axis=1)
    moving = {"Hips": moving_person.translation}
    motion = Motion(rooted, rotations, np.zeros((60, 3)), 30.0, moving)
    other = with_offsets(rooted, Hips=(2.0, 0.9, 0.3))
    np.testing.assert_allclose(retarget(motion, other).rotations, rotations, atol=1e-6)


def test_a_root_above_the_hips_turns_with_the_body(moving_person):
    """As of rigs whose first joint carries the hips: programs read the heading from it."""
    rooted = below_a_root(moving_person.skeleton, 0.05)
    yaw = quaternion_from_rotation_vector(np.outer(np.linspace(0, 3, 60), [0.0, 1.0, 0.0]))
    rotations = moving_person.rotations.copy()
    rotations[:, 0] = yaw
    made = retarget(replace(moving_person, rotations=rotations), rooted)
    for joint in ("Reference", "Hips"):
        world = made.global_rotations()[:, rooted.index(joint)]
        assert rotation_angles(world, yaw).max() < 0.01, joint


def test_hands_in_front_of_the_body_are_placed_and_hands_aside_are_not(person):
    """Upper arms hang, forearms point ahead and go from inward to outward; the target's shoulders
    are 0.4 m apart.

    Shoulders 0.3 m apart and arms of 0.54 and 0.53 m have the span 0.685 m, the target 0.735 m.
    Before the middle of the body a hand is placed there, scaled by the spans; beside it arms only
    point as the source's. Between them nothing jumps.
    """
    inward = np.linspace(0.6, -0.6, 61)
    theta = np.arccos(-inward)
    motion = at_rest(person, 61, UPRIGHT)
    chest = Rotation.from_rotvec([0, 1.2, 0])  # "in front" turns with it
    motion.rotations[:, person.index("Chest")] = chest.as_quat()
    for side, sign in (("Left", -1.0), ("Right", 1.0)):
        upper = Rotation.from_rotvec([0, 0, sign * np.pi / 2])
        fore = upper.inv() * Rotation.from_rotvec(np.outer(theta, [0, sign, 0]))
        motion.rotations[:, person.index(f"{side}Arm")] = upper.as_quat()
        motion.rotations[:, person.index(f"{side}ForeArm")] = fore.as_quat()
    wide = with_offsets(person, LeftArm=(0.2, 0.05, 0.0), RightArm=(-0.2, 0.05, 0.0))
    made = retarget(motion, wide)
    places = made.positions()
    middle = (places[:, person.index("LeftArm")] + places[:, person.index("RightArm")]) / 2
    for side, sign, down in (("Left", 1, -0.29), ("Right", -1, -0.28)):
        hand = person.index(f"{side}Hand")
        # 0.15 m from the middle to the shoulder; 0.25 m of forearm go 0.15 m aside and 0.2 m ahead.
        placed = 0.735 / 0.685 * np.array([0, down, 0.2])
        pointing = np.array([sign * (0.3 + 0.05), down, 0.2])
        found = chest.inv().apply(places[:, hand] - middle)
        np.testing.assert_allclose(found[[0, -1]], [placed, pointing], atol=1e-6)
        steps, usual = (np.diff(m.positions()[:, hand], axis=0) for m in (made, motion))
        assert np.abs(steps).max() < 2 * np.abs(usual).max(), "no jump"
        turned, own = (m.global_rotations()[:, hand] for m in (made, motion))
        assert rotation_angles(turned, own).max() < 1e-6, "the hand keeps its orientation"


def yaws(motion: Motion, *names: str) -> list[float]:
    """World rotations about the vertical in the first frame, degrees."""
    world = motion.global_rotations()[0]
    turns = (world[motion.skeleton.index(name)] for name in names)
    return [float(np.degrees(2 * np.arctan2(q[1], q[3]))) for q in turns]


def looking_aside(rig: Skeleton, **degrees: float) -> Motion:
    """A rig at rest, some of whose joints are turned about the vertical against their parents."""
    motion = at_rest(rig, 10, UPRIGHT)
    for name, angle in degrees.items():
        turn = np.array([0.0, np.radians(angle), 0.0])
        motion.rotations[:, rig.index(name)] = quaternion_from_rotation_vector(turn)
    return motion


def test_spines_are_matched_along_their_length(person, mixamo):
    """The middles of the person's bones are 0.1 and 0.25 m up, 0.4 and 1 of the last one's height.

    Those of Mixamo are 0.0585, 0.184 and 0.326 m up, so that the second one, at 0.5644, is
    (0.5644 - 0.4) / 0.6 = 0.274 of the way from Spine to Chest: 10 + 0.274 * 40 degrees.
    """
    made = retarget(looking_aside(person, Spine=10.0, Chest=40.0, Head=-20.0), mixamo)
    names = [f"mixamorig:{name}" for name in ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head")]
    assert yaws(made, *names) == pytest.approx([0, 10, 21, 50, 50, 30], abs=3)


def test_rigs_without_a_body_are_refused_by_the_bone(moving_person):
    rig = renamed(moving_person.skeleton, {"Hips": "Pelvis"})
    rig = with_offsets(rig, LeftForeArm=(0.0, 0.0, 0.0), RightForeArm=(0.0, 0.0, 0.0))
    with pytest.raises(MotionError, match="left arm"):
        retarget(moving_person, rig)


def test_zeggs_onto_bandai(zeggs, shared_data):
    """A rig that is a heap of bones at rest, under a root that stands still on the floor."""
    bandai = Motion.load(shared_data / BANDAI)
    made = retarget(zeggs, bandai.skeleton, pose=standing_pose(bandai))
    # Hips half as wide over feet as far apart: only the legs point elsewhere.
    apart = degrees_apart(zeggs, made)
    assert max(apart.values()) < 10 and max(apart[f"{side} forearm"] for side in SIDES) < 2
    assert np.ptp(made.translation, axis=0).max() == 0 and list(made.joint_translations) == ["Hips"]
    labels = contact_labels(zeggs)
    assert skate(made, labels) < 1.3 * skate(zeggs, labels) + 0.002
    assert all(share.mean() == 0 for share in bent_backwards(made).values())
    # No forearm is wrung, and knees are hinges: how far they turn about their bones, along x.
    for name, most in (("LowerArm_L", 120), ("LowerArm_R", 120), ("LowerLeg_L", 5)):
        x, _, _, w = made.rotations[:, bandai.skeleton.index(name)].T
        assert np.degrees(2 * np.arctan(np.abs(x / w))).max() < most, name
    # Without a motion to learn its frames from, places are the same and turns are a guess.
    guessed = retarget(zeggs, bandai.skeleton)
    assert max(degrees_apart(made, guessed).values()) < 3


def test_hands_keep_their_roll(mixamo):
    """Palms up in the source are palms up on a rig without fingers, too."""
    motion = at_rest(mixamo, 20, mixamo.offsets[0])
    roll = np.linspace(0, 2.5, 20)
    turns = quaternion_from_rotation_vector(roll[:, None] * [1.0, 0.0, 0.0])
    motion.rotations[:, mixamo.index("mixamorig:LeftHand")] = turns
    made = retarget(motion, smpl_skeleton(22))
    wrist = made.global_rotations()[:, made.skeleton.index("left_wrist")]
    np.testing.assert_allclose(rotation_angles(wrist[0], wrist), roll, atol=0.01)
