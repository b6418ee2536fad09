"""Feet stay where they stand, everything else stays as it was, and nothing gets worse."""

from dataclasses import replace

import numpy as np
import pytest
from hinges import bent_backwards
from recordings import AITVIEWER, IDLE, RUN, ZEGGS
from rigs import PERSON, Bones, at_rest, below_a_root, rig_of, turned_at_root

from gesturekit import Motion, Skeleton
from gesturekit.errors import MotionError
from gesturekit.evaluation import standing_heights
from gesturekit.motion.contacts import contact_labels, foot_positions
from gesturekit.motion.rotations import (
    quaternion_from_euler,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_angles,
)
from gesturekit.postprocess import lock_feet

TOES: Bones = {
    "LeftToeBase": ("LeftFoot", (0.0, -0.05, 0.14)),
    "LeftToe_End": ("LeftToeBase", (0.0, 0.0, 0.06)),
    "RightToeBase": ("RightFoot", (0.0, -0.05, 0.14)),
    "RightToe_End": ("RightToeBase", (0.0, 0.0, 0.06)),
}


@pytest.fixture(scope="module")
def with_toes() -> Skeleton:
    return rig_of(PERSON | TOES)


def standing(rig: Skeleton, seconds: float = 6.0, fps: float = 30.0) -> Motion:
    """Knees a little bent, feet flat on the floor, the body still."""
    n = round(seconds * fps)
    bend = {"UpLeg": -15.0, "Leg": 30.0, "Foot": -15.0}
    turns = {s + part: np.full(n, by) for s in ("Left", "Right") for part, by in bend.items()}
    return pitched(at_rest(rig, n, [0.0, 0.92, 0.0], fps), turns)


def moved(motion: Motion, by: np.ndarray) -> Motion:
    return replace(motion, translation=motion.translation + by)


def straightened(motion: Motion) -> Motion:
    return replace(motion, rotations=at_rest(motion.skeleton, motion.n_frames).rotations)


def pitched(motion: Motion, turns: dict[str, np.ndarray]) -> Motion:
    """The motion in which joints have no rotation but about x, (T,) degrees."""
    rotations = motion.rotations.copy()
    for name, degrees in turns.items():
        angles = np.stack([degrees, 0 * degrees, 0 * degrees], axis=-1)
        rotations[:, motion.skeleton.index(name)] = quaternion_from_euler(angles, "XYZ")
    return replace(motion, rotations=rotations)


def swaying(motion: Motion) -> Motion:
    """The body goes to and fro by 3 cm, and up and down by 1 cm, feet and all."""
    phase = 2 * np.pi * 0.4 * motion.times[:, None]
    return moved(motion, np.sin(phase) * [0.03, 0.0, 0.01] + np.sin(1.7 * phase) * [0, 0.01, 0])


def speed(places: np.ndarray, fps: float) -> np.ndarray:
    return np.linalg.norm(np.diff(places, axis=0), axis=-1) * fps


def rigs(skeleton: Skeleton, with_toes: Skeleton) -> dict[str, Skeleton]:
    bare = replace(skeleton, end_sites={})
    return {"toes": with_toes, "ends": skeleton, "ankles": bare}


@pytest.mark.parametrize("kind", ["toes", "ends", "ankles"])
def test_swaying_feet_stand_still_and_the_body_still_sways(kind, skeleton, with_toes):
    motion = swaying(standing(rigs(skeleton, with_toes)[kind]))
    locked = lock_feet(motion)
    before, after = (speed(foot_positions(m), m.fps) for m in (motion, locked))
    assert before.mean() > 0.03 and after.mean() < 0.05 * before.mean()
    chest = motion.skeleton.index("Chest")
    assert np.ptp(locked.positions()[:, chest, 0]) > 0.03
    arms = [motion.skeleton.index(name) for name in ("Spine", "LeftArm", "RightForeArm", "Head")]
    assert (locked.rotations[:, arms] == motion.rotations[:, arms]).all()


def test_a_drifting_body_stays_where_its_feet_are(with_toes):
    still = standing(with_toes, 10.0)
    drifting = moved(still, still.times[:, None] * [0.1, 0.0, 0.05])
    locked = lock_feet(drifting)
    assert speed(foot_positions(locked), 30.0).mean() < 0.002
    assert np.ptp(locked.translation, axis=0).max() < 0.05, "the hips do not leave the feet"
    kept = lock_feet(drifting, keep_path=True)
    assert np.abs(kept.translation[:, [0, 2]] - drifting.translation[:, [0, 2]]).max() < 1e-9


def test_predicted_labels_decide_what_stands(with_toes):
    motion = swaying(standing(with_toes))
    n_points = foot_positions(motion).shape[1]
    assert lock_feet(motion, np.zeros((motion.n_frames, n_points))) is motion
    left = np.tile([0.9, 0.9, 0.1, 0.1], (motion.n_frames, 1))
    locked = speed(foot_positions(lock_feet(motion, left, keep_path=True)), motion.fps)
    before = speed(foot_positions(motion), motion.fps)
    assert locked[:, :2].mean() < 0.05 * before[:, :2].mean()
    assert locked[:, 2:].mean() == pytest.approx(before[:, 2:].mean(), rel=0.2)


def test_contact_labels_of_a_moving_foot_are_ignored(with_toes):
    motion = standing(with_toes)
    running = moved(motion, motion.times[:, None] * [0.0, 0.0, 3.0])
    assert lock_feet(running, np.ones((motion.n_frames, 4))) is running


def test_labels_of_another_shape_are_refused(with_toes):
    motion = standing(with_toes, 1.0)
    with pytest.raises(MotionError, match=r"(?=.*\(30, 3\)).*\(30, 4\)"):
        lock_feet(motion, np.ones((30, 3)))


def test_the_ball_stays_while_the_heel_lifts(with_toes):
    motion = standing(with_toes)
    lift = 25 * np.sin(np.pi * np.clip(motion.times - 2, 0, 2) / 2)
    lifted = pitched(motion, {"LeftFoot": lift - 15, "LeftToeBase": -lift})
    # The hip holds the ankle, so that the ball goes up and down: put it on the floor by the labels.
    drop = foot_positions(lifted)[:, 1] - foot_positions(motion)[:, 1]
    assert np.ptp(drop[:, 1]) > 0.03
    rolling = swaying(moved(lifted, -drop))
    before, after = foot_positions(rolling), foot_positions(lock_feet(rolling))
    standing_still = np.s_[60:120]
    slides = [speed(feet[:, 1], 30.0)[standing_still].mean() for feet in (before, after)]
    assert slides[1] < 0.5 * slides[0]
    heels = before[:, 0, 1] - before[:, 1, 1], after[:, 0, 1] - after[:, 1, 1]
    assert heels[0].max() - heels[0].min() > 0.04
    assert np.abs(heels[0] - heels[1])[standing_still].max() < 0.02, "the heel still lifts"


def test_a_step_is_taken_and_both_standing_places_are_kept(with_toes):
    motion = standing(with_toes)
    swing = np.sin(np.pi * np.clip((motion.times - 3) / 0.4, 0, 1)) ** 2
    bent = {"LeftUpLeg": -15 - 30 * swing, "LeftLeg": 30 + 60 * swing}
    stepping = swaying(pitched(motion, bent))
    before, after = (foot_positions(m)[:, 0] for m in (stepping, lock_feet(stepping)))
    assert before[95, 1] - before[80, 1] > 0.1
    assert np.abs(after - before)[93:99].max() < 0.06, "the swing is the model's"
    assert speed(after, 30.0)[:80].mean() < 0.005 and speed(after, 30.0)[115:].mean() < 0.005


def test_legs_bend_forward_between_the_hip_and_a_foot_at_rest(with_toes):
    """The leg swings like a pendulum over its foot, worked out by hand.

    Thigh and shank are 0.42 m, so that over a distance d from hip to ankle the knee is
    sqrt(0.42^2 - d^2 / 4) before their middle. The model's knees are nearly straight, and bend
    backwards by up to 4 degrees now and then.
    """
    motion = standing(with_toes)
    bend = 4 + 8 * np.sin(2 * np.pi * 0.7 * motion.times)
    shares = {"UpLeg": -0.5, "Leg": 1.0, "Foot": -0.5}
    turns = {side + part: s * bend for side in ("Left", "Right") for part, s in shares.items()}
    sway = 0.03 * np.sin(2 * np.pi * 0.8 * motion.times)[:, None] * [0.0, 0.0, 1.0]
    locked = lock_feet(moved(pitched(motion, turns), sway))
    positions = locked.positions()
    for side in ("Left", "Right"):
        limb = [motion.skeleton.index(side + part) for part in ("UpLeg", "Leg", "Foot")]
        hip, knee, ankle = (positions[:, joint] for joint in limb)
        assert np.ptp(ankle, axis=0)[[0, 2]].max() < 1e-6 and np.ptp(hip[:, 2]) > 0.05
        along = ankle - hip
        distance = np.linalg.norm(along, axis=1, keepdims=True)
        forward = np.stack([0 * along[:, 0], along[:, 2], -along[:, 1]], axis=1) / distance
        height = np.sqrt(0.42**2 - distance**2 / 4)
        np.testing.assert_allclose(knee, (hip + ankle) / 2 + height * forward, atol=2e-4)
    assert not any(frames.any() for frames in bent_backwards(locked).values())


def test_hips_come_down_to_feet_that_they_would_lift(with_toes):
    """Straight legs, and hips that bob up by 2 cm: feet stay on the floor, and hips come down."""
    motion = standing(with_toes)
    bob = 0.02 * np.exp(-(((motion.times - 3) / 0.15) ** 2))[:, None] * [0.0, 1.0, 0.0]
    bobbing = moved(straightened(motion), bob)
    locked = lock_feet(bobbing, np.ones((motion.n_frames, 4)))
    lifted = foot_positions(bobbing)[..., 1] - foot_positions(bobbing)[0, :, 1]
    kept = foot_positions(locked)[..., 1] - foot_positions(locked)[0, :, 1]
    assert lifted.max() > 0.019 and np.abs(kept).max() < 0.003
    drop = bobbing.translation[:, 1] - locked.translation[:, 1]
    assert drop[90] == pytest.approx(0.02, abs=0.003) and drop.min() > -1e-3
    assert np.abs(np.diff(drop)).max() * 30 < 0.3, "smoothly"
    assert drop[:60].max() < 2e-3 and drop[120:].max() < 2e-3


def strolling(rig: Skeleton) -> Motion:
    """Four seconds at 60 fps: sway and drift, a heel that lifts, a foot that steps and turns."""
    motion = standing(rig, 4.0, 60.0)
    rotations = motion.rotations.copy()
    swing = np.sin(np.pi * np.clip((motion.times - 2.4) / 0.5, 0, 1)) ** 2
    lift = 25 * np.sin(np.pi * np.clip(motion.times - 0.4, 0, 1)) ** 2
    for name, pitch, yaw in (
        ("LeftUpLeg", -15 - 30 * swing, 0.0),
        ("LeftLeg", 30 + 60 * swing, 0.0),
        ("RightFoot", lift - 15, 9 * np.sin(1.5 * motion.times)),
        ("RightToeBase", -lift, 0.0),
    ):
        angles = np.stack([pitch, yaw + 0 * pitch, 0 * pitch], axis=-1)
        rotations[:, rig.index(name)] = quaternion_from_euler(angles, "XYZ")
    drift = motion.times[:, None] * [0.02, 0.0, 0.03]
    return swaying(moved(replace(motion, rotations=rotations), drift))


def turned(motion: Motion) -> Motion:
    """The whole motion turned by 2 rad about the vertical, on a floor 0.4 m lower, elsewhere."""
    turn = quaternion_from_rotation_vector(np.array([0.0, 2.0, 0.0]))
    place = rotate_vectors(turn, motion.translation) + [3.0, -0.4, 1.0]
    return replace(turned_at_root(motion, turn), translation=place)


@pytest.mark.parametrize(
    "change",
    [turned, Motion.mirror, lambda motion: motion.scaled(2.5)],
    ids=["turned", "mirrored", "scaled"],
)
@pytest.mark.parametrize("labelled", [False, True])
def test_feet_are_locked_alike_in_any_direction_and_side_at_any_size(with_toes, change, labelled):
    motion = strolling(with_toes)
    contacts = contact_labels(motion, 0.3) if labelled else None
    other = None
    if labelled:
        other = contacts[:, [2, 3, 0, 1]] if change is Motion.mirror else contacts
    locked = lock_feet(motion, contacts)
    assert np.abs(locked.positions() - motion.positions()).max() > 0.01
    expected, found = change(locked), lock_feet(change(motion), other)
    np.testing.assert_allclose(found.positions(), expected.positions(), atol=1e-6)
    apart = rotation_angles(found.global_rotations(), expected.global_rotations())
    np.testing.assert_allclose(apart, 0, atol=1e-5)


def test_feet_and_toes_keep_their_orientation_in_the_world(with_toes):
    motion = swaying(standing(with_toes))
    locked = lock_feet(motion)
    for name in ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase"):
        own = [m.global_rotations()[:, motion.skeleton.index(name)] for m in (motion, locked)]
        assert np.degrees(rotation_angles(*own)).max() < 0.01


@pytest.mark.parametrize("marker_turn", [0.0, 1.2])
def test_joints_that_carry_the_body_may_hang_below_a_still_root(with_toes, marker_turn):
    plain = standing(with_toes)
    place = plain.translation + plain.times[:, None] * [0.1, 0.0, 0.0]
    motion = at_rest(below_a_root(with_toes, 0.0), plain.n_frames)
    motion.rotations[:, 0] = quaternion_from_rotation_vector(np.array([0.0, marker_turn, 0.0]))
    motion.rotations[:, 1:] = plain.rotations
    locked = lock_feet(replace(motion, joint_translations={"Hips": place}))
    assert (locked.translation == 0).all()
    assert speed(foot_positions(locked), 30.0).mean() < 0.002


def test_one_frame_and_two(with_toes):
    motion = standing(with_toes)
    for n in (1, 2, 5):
        locked = lock_feet(motion[:n]).positions()
        np.testing.assert_allclose(locked, motion[:n].positions(), atol=1e-3)


@pytest.mark.parametrize(
    ("name", "most"),
    [
        (ZEGGS, 0.75),
        ("motion/bandai/dataset-1_bow_happy_001.bvh", 0.5),
        ("motion/bandai/dataset-1_bye_feminine_001.bvh", 0.5),
        (IDLE, 0.5),
        (AITVIEWER, 0.5),
    ],
)
def test_recordings_slide_less_and_sink_no_deeper(shared_data, name, most):
    motion = Motion.load(shared_data / name)
    motion = motion[2:602]  # one of them begins with another pose
    locked = lock_feet(motion)
    labels = contact_labels(motion)[1:] > 0
    before, after = (speed(foot_positions(m), m.fps)[labels] for m in (motion, locked))
    assert after.mean() <= most * before.mean()
    floor = standing_heights(motion)
    sunk = [np.maximum(floor - foot_positions(m)[..., 1], 0) for m in (motion, locked)]
    assert (sunk[1] - sunk[0]).max() < 5e-4
    correction = foot_positions(locked) - foot_positions(motion)
    assert speed(correction, motion.fps).max() < 0.5


def test_a_recording_that_drifts_stands_again(shared_data):
    recorded = Motion.load(shared_data / ZEGGS)[:600]
    drifting = moved(recorded, recorded.times[:, None] * [0.1, 0.0, 0.0])
    labels = contact_labels(recorded)
    for contacts in (labels, None):
        slid = speed(foot_positions(lock_feet(drifting, contacts)), 30.0)[labels[1:] > 0]
        assert slid.mean() < 0.01


def test_foot_lock_does_not_change_running(shared_data):
    motion = Motion.load(shared_data / RUN)
    assert np.abs(lock_feet(motion).positions() - motion.positions()).max() < 0.02
