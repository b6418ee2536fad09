from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gesturekit.errors import MotionError
from gesturekit.formats.smpl.skeleton import smpl_skeleton
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.contacts import contact_labels, foot_positions
from gesturekit.motion.ik.joint_limits import bent_backwards
from gesturekit.motion.kinematics import forward_kinematics, global_rotations
from gesturekit.motion.parts import SIDES, find_parts
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.standing_pose import standing_pose
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    normalize_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_angles,
)

ZEGGS = "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh"
BANDAI = "motion/bandai/dataset-1_bye_happy_001.bvh"
IDLE = "motion/reactidle/003_genuine.bvh"
RUN = "smpl/glamr_running_smpl.npz"


@pytest.fixture(scope="module")
def zeggs(shared_data) -> Motion:
    return Motion.load(shared_data / ZEGGS).slice(0, 600)


@pytest.fixture(scope="module")
def bandai(shared_data) -> Motion:
    return Motion.load(shared_data / BANDAI)


def with_rest(skeleton: Skeleton, pose: np.ndarray) -> Skeleton:
    """The rig whose rest pose is `pose`, its joints' frames parallel there."""
    turned = global_rotations(pose, skeleton)
    above = [max(parent, 0) for parent in skeleton.parents]
    offsets = rotate_vectors(turned[above], skeleton.offsets)
    offsets[0] = skeleton.offsets[0]
    return replace(skeleton, offsets=offsets)


def with_frames(skeleton: Skeleton, turned: np.ndarray) -> Skeleton:
    """The rig whose joints' frames are turned by (J, 4): its rest pose is a heap of bones."""
    above = [max(parent, 0) for parent in skeleton.parents]
    offsets = rotate_vectors(invert_quaternions(turned)[above], skeleton.offsets)
    offsets[0] = skeleton.offsets[0]
    return replace(skeleton, offsets=offsets)


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


def hand_distances(motion: Motion) -> np.ndarray:
    """(T, 3) wrist to hips on either side, and wrist to wrist, over the length of the trunk."""
    parts, positions = find_parts(motion.skeleton), motion.positions()
    ends = motion.end_positions()

    def at(name: str) -> np.ndarray:
        return positions[:, motion.skeleton.index(name)]

    hips = sum(at(parts.legs[side].hip) for side in SIDES) / 2
    shoulders = sum(at(parts.arms[side].shoulder) for side in SIDES) / 2
    left, right = (
        at(arm.wrist) if arm.wrist else ends[arm.elbow][:, 0]
        for arm in (parts.arms[side] for side in SIDES)
    )
    trunk = np.linalg.norm(shoulders - hips, axis=-1).mean()
    ways = (left - hips, right - hips, left - right)
    return np.stack([np.linalg.norm(way, axis=-1) for way in ways], axis=-1) / trunk


@pytest.mark.parametrize("file", [ZEGGS, BANDAI, IDLE, RUN, "motion/aitviewer/sample.bvh"])
def test_onto_itself_is_the_identity(shared_data, file):
    motion = Motion.load(shared_data / file)
    same = retarget(motion, motion.skeleton)
    assert np.abs(same.positions() - motion.positions()).max() < 1e-6
    assert rotation_angles(same.rotations, motion.rotations).max() < 0.01


def test_size_scales_steps_and_heights(moving_person):
    large = retarget(moving_person, moving_person.skeleton.scaled(1.3))
    np.testing.assert_allclose(large.rotations, moving_person.rotations, atol=1e-6)
    walked = np.diff(moving_person.translation, axis=0)
    np.testing.assert_allclose(np.diff(large.translation, axis=0), 1.3 * walked, atol=1e-6)


def test_zeggs_onto_mixamo(zeggs, mixamo):
    made = retarget(zeggs, mixamo)
    assert made.skeleton is mixamo and (made.n_frames, made.fps) == (zeggs.n_frames, zeggs.fps)
    apart = degrees_apart(zeggs, made)
    assert max(apart.values()) < 6
    labels = contact_labels(zeggs)
    assert skate(made, labels) < 1.3 * skate(zeggs, labels) + 0.002
    floors = [foot_positions(motion)[:, :, 1].min(axis=1) for motion in (zeggs, made)]
    assert np.abs(np.median(floors[0]) - np.median(floors[1])) < 0.005
    assert floors[1].min() > np.median(floors[1]) - 0.01
    hands, source = hand_distances(made), hand_distances(zeggs)
    assert min(np.corrcoef(hands[:, k], source[:, k])[0, 1] for k in range(3)) > 0.98
    assert hands.min() > 0.9 * source.min()
    assert all(share.mean() == 0 for share in bent_backwards(made).values())
    fingers = [mixamo.index(f"mixamorig:LeftHandIndex{n}") for n in (1, 2, 3)]
    own = [zeggs.skeleton.index(f"LeftHandIndex{n}") for n in (1, 2, 3)]
    curl = [
        rotation_angles(m.global_rotations()[:, j[0]], m.global_rotations()[:, j[2]])
        for m, j in ((made, fingers), (zeggs, own))
    ]
    np.testing.assert_allclose(curl[0], curl[1], atol=np.radians(5))


def test_zeggs_onto_bandai(zeggs, bandai):
    """A rig that is a heap of bones at rest, under a root that stands still on the floor."""
    made = retarget(zeggs, bandai.skeleton, pose=standing_pose(bandai))
    # Hips half as wide over feet as far apart: only the legs point elsewhere.
    apart = degrees_apart(zeggs, made)
    assert max(apart.values()) < 10 and max(apart[f"{side} forearm"] for side in SIDES) < 1
    assert np.ptp(made.translation, axis=0).max() == 0 and list(made.joint_translations) == ["Hips"]
    labels = contact_labels(zeggs)
    assert skate(made, labels) < 1.3 * skate(zeggs, labels) + 0.002
    hands, source = hand_distances(made), hand_distances(zeggs)
    assert min(np.corrcoef(hands[:, k], source[:, k])[0, 1] for k in range(3)) > 0.98
    assert all(share.mean() == 0 for share in bent_backwards(made).values())
    # No forearm is wrung, and knees are hinges: how far they turn about their bones, along x.
    for name, most in (("LowerArm_L", 120), ("LowerArm_R", 120), ("LowerLeg_L", 5)):
        x, _, _, w = made.rotations[:, bandai.skeleton.index(name)].T
        assert np.degrees(2 * np.arctan(np.abs(x / w))).max() < most, name
    # Without a motion to learn its frames from, places are the same and turns are a guess.
    guessed = retarget(zeggs, bandai.skeleton)
    assert max(degrees_apart(made, guessed).values()) < 3


@pytest.mark.parametrize("file", [BANDAI, IDLE])
def test_other_rigs_onto_zeggs(shared_data, zeggs, file):
    motion = Motion.load(shared_data / file)
    made = retarget(motion, zeggs.skeleton)
    assert max(degrees_apart(motion, made).values()) < 8
    # A body of another height stands on the same floor (that of the idle clip lies at -0.72).
    heights = [foot_positions(m)[..., 1].min(axis=1) for m in (motion, made)]
    assert abs(np.median(heights[0]) - np.median(heights[1])) < 0.01
    assert skate(made, np.ones(foot_positions(made).shape[:2])) < 0.02
    # Hands that are folded stay so, and pass through neither each other nor the body.
    hands, source = hand_distances(made).min(axis=0), hand_distances(motion).min(axis=0)
    assert (hands > 0.85 * source).all() and (hands < 1.15 * source).all()


def test_a_run_onto_mixamo(shared_data, mixamo):
    motion = Motion.load(shared_data / RUN)
    made = retarget(motion, mixamo)
    assert max(degrees_apart(motion, made).values()) < 6
    ways = [np.linalg.norm(np.ptp(m.positions()[:, 0, [0, 2]], axis=0)) for m in (motion, made)]
    legs = [0.785, 0.827]
    assert ways[1] / ways[0] == pytest.approx(legs[1] / legs[0], rel=0.01)


def bent_pose(skeleton: Skeleton) -> np.ndarray:
    """Turned half round, arms forward with bent elbows, legs apart, toes out."""
    parts = find_parts(skeleton)
    pose = np.tile([0.0, 0.0, 0.0, 1.0], (skeleton.n_joints, 1))

    def turn(name: str, *vector: float) -> None:
        pose[skeleton.index(name)] = quaternion_from_rotation_vector(np.array(vector))

    turn(skeleton.names[0], 0, 2.5, 0)
    for side, x in (("left", 1), ("right", -1)):
        turn(parts.arms[side].shoulder, 0.3, -1.2 * x, -0.5 * x)
        turn(parts.arms[side].elbow, 0, -0.7 * x, 0)
        turn(parts.legs[side].hip, 0, 0, 0.3 * x)
        turn(parts.legs[side].ankle, 0, 0.2 * x, -0.3 * x)
    return pose


def test_a_rest_pose_that_is_neither_t_nor_a(zeggs, mixamo):
    odd = with_rest(mixamo, bent_pose(mixamo))
    usual, made = retarget(zeggs, mixamo), retarget(zeggs, odd)
    assert np.abs(usual.positions() - made.positions()).max() < 0.03
    wrist = mixamo.index("mixamorig:LeftHand")
    # Frames are parallel in either rest pose, so that the same turn means another angle.
    assert rotation_angles(usual.rotations[:, wrist], made.rotations[:, wrist]).mean() > 0.1
    back = retarget(made, zeggs.skeleton)
    assert max(degrees_apart(zeggs, back).values()) < 6


def test_joint_axes_that_lie_anyhow(zeggs, mixamo):
    """The same bones under other axes: with a pose to tell them, the same motion."""
    rng = np.random.default_rng(0)
    turned = normalize_quaternions(rng.normal(size=(mixamo.n_joints, 4)))
    heap = with_frames(mixamo, turned)
    above = np.array([max(p, 0) for p in mixamo.parents])
    stands = multiply_quaternions(invert_quaternions(turned[above]), turned)
    stands[0] = turned[0]
    np.testing.assert_allclose(
        forward_kinematics(stands, np.zeros(3), heap),
        forward_kinematics(np.tile([0.0, 0, 0, 1], (mixamo.n_joints, 1)), np.zeros(3), mixamo),
        atol=1e-9,
    )
    usual, made = retarget(zeggs, mixamo), retarget(zeggs, heap, pose=stands)
    np.testing.assert_allclose(made.positions(), usual.positions(), atol=1e-6)
    turns = multiply_quaternions(usual.global_rotations(), turned)
    assert rotation_angles(made.global_rotations(), turns).max() < 1e-5


def test_hands_keep_their_roll(mixamo):
    """Palms up in the source are palms up on a rig without fingers, too."""
    n = 20
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (n, mixamo.n_joints, 1))
    roll = np.zeros((n, 3))
    roll[:, 0] = np.linspace(0, 2.5, n)
    rotations[:, mixamo.index("mixamorig:LeftHand")] = quaternion_from_rotation_vector(roll)
    motion = Motion(mixamo, rotations, np.tile(mixamo.offsets[0], (n, 1)), 30.0)
    made = retarget(motion, smpl_skeleton(22))
    wrist = made.global_rotations()[:, made.skeleton.index("left_wrist")]
    turned = rotation_angles(wrist[0], wrist)
    np.testing.assert_allclose(turned, roll[:, 0], atol=0.01)


def test_extra_joints_rest_and_missing_ones_do_not_matter(moving_person, mixamo):
    made = retarget(moving_person, mixamo)
    for name in ("mixamorig:LeftHandIndex2", "mixamorig:HeadTop_End", "mixamorig:RightToe_End"):
        still = made.rotations[:, mixamo.index(name)]
        np.testing.assert_allclose(np.abs(still[:, 3]), 1, atol=1e-9)
    back = retarget(made, moving_person.skeleton)
    assert max(degrees_apart(moving_person, back).values()) < 8


def test_parts_named_by_hand(moving_person, mixamo):
    heap = with_rest(mixamo, bent_pose(mixamo))
    names = tuple(f"bone_{j}" for j in range(mixamo.n_joints))
    nameless = Skeleton(names, mixamo.parents, heap.offsets * [1, 1, 0.2])
    with pytest.raises(MotionError, match="left_elbow"):
        retarget(moving_person, nameless)
    parts = find_parts(mixamo)
    by_hand = {
        f"{side}_{part}": names[mixamo.index(name)]
        for side in SIDES
        for limb in (parts.arms[side], parts.legs[side])
        for part, name in vars(limb).items()
    } | {"head": names[mixamo.index(parts.head)]}
    made = retarget(moving_person, nameless, target_parts=by_hand)
    assert made.n_frames == moving_person.n_frames


def test_a_body_that_never_stands_is_refused(moving_person):
    person = moving_person.skeleton
    folded = np.tile([0.0, 0.0, 0.0, 1.0], (10, person.n_joints, 1))
    for name in ("LeftUpLeg", "RightUpLeg"):
        folded[:, person.index(name)] = quaternion_from_rotation_vector(np.array([-2.6, 0.0, 0.0]))
    offsets = person.offsets.copy()
    offsets[[person.index(name) for name in ("LeftLeg", "RightLeg")]] *= -1
    heap = replace(person, offsets=offsets)
    lying = Motion(heap, np.tile([0.0, 0, 0, 1], (10, 19, 1)), np.zeros((10, 3)), 30.0)
    with pytest.raises(MotionError, match="stands upright neither at rest nor in any frame"):
        retarget(lying, person)


def test_a_motion_in_place_of_its_skeleton_is_refused_with_what_to_give(moving_person):
    with pytest.raises(MotionError, match="skeleton is a Motion, and must be a Skeleton; give its"):
        retarget(moving_person, moving_person)
    with pytest.raises(MotionError, match="skeleton is a str, and must be a Skeleton$"):
        retarget(moving_person, "avatar.bvh")
