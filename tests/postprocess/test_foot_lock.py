"""Feet stay where they stand, everything else stays as it was, and nothing gets worse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gesturekit import Motion, Skeleton
from gesturekit.errors import MotionError
from gesturekit.evaluation import standing_heights
from gesturekit.motion.contacts import contact_labels, foot_positions
from gesturekit.motion.rotations import quaternion_from_euler
from gesturekit.postprocess import lock_feet

TOE = {
    "LeftToeBase": ("LeftFoot", (0.0, -0.05, 0.14)),
    "LeftToe_End": ("LeftToeBase", (0.0, 0.0, 0.06)),
    "RightToeBase": ("RightFoot", (0.0, -0.05, 0.14)),
    "RightToe_End": ("RightToeBase", (0.0, 0.0, 0.06)),
}


@pytest.fixture(scope="module")
def with_toes(skeleton) -> Skeleton:
    names = [*skeleton.names, *TOE]
    return Skeleton(
        names=tuple(names),
        parents=(*skeleton.parents, *(names.index(parent) for parent, _ in TOE.values())),
        offsets=np.concatenate([skeleton.offsets, [offset for _, offset in TOE.values()]]),
    )


def standing(rig: Skeleton, seconds: float = 6.0, fps: float = 30.0) -> Motion:
    """Knees a little bent, feet flat on the floor, the body still."""
    n = round(seconds * fps)
    angles = np.zeros((n, rig.n_joints, 3))
    for side in ("Left", "Right"):
        for part, pitch in (("UpLeg", -15.0), ("Leg", 30.0), ("Foot", -15.0)):
            angles[:, rig.index(side + part), 0] = pitch
    return Motion(rig, quaternion_from_euler(angles, "XYZ"), np.tile([0.0, 0.92, 0.0], (n, 1)), fps)


def moved(motion: Motion, by: np.ndarray) -> Motion:
    return replace(motion, translation=motion.translation + by)


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
    with pytest.raises(MotionError, match=r"\(30, 3\).*\(30, 4\)"):
        lock_feet(motion, np.ones((30, 3)))


def test_the_ball_stays_while_the_heel_lifts(with_toes):
    motion = standing(with_toes)
    rotations = motion.rotations.copy()
    foot, toe = (motion.skeleton.index(name) for name in ("LeftFoot", "LeftToeBase"))
    lift = 25 * np.sin(np.pi * np.clip(motion.times - 2, 0, 2) / 2)
    pitch = np.stack([lift, 0 * lift, 0 * lift], axis=-1)
    rotations[:, foot] = quaternion_from_euler(pitch - [15, 0, 0], "XYZ")
    rotations[:, toe] = quaternion_from_euler(-pitch, "XYZ")
    lifted = replace(motion, rotations=rotations)
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
    rotations = motion.rotations.copy()
    swing = np.sin(np.pi * np.clip((motion.times - 3) / 0.4, 0, 1)) ** 2
    for name, pitch in (("LeftUpLeg", -30.0), ("LeftLeg", 60.0)):
        bend = np.stack([pitch * swing, 0 * swing, 0 * swing], axis=-1)
        own = quaternion_from_euler(bend + [{-30.0: -15, 60.0: 30}[pitch], 0, 0], "XYZ")
        rotations[:, motion.skeleton.index(name)] = own
    stepping = swaying(replace(motion, rotations=rotations))
    before, after = (foot_positions(m)[:, 0] for m in (stepping, lock_feet(stepping)))
    assert before[95, 1] - before[80, 1] > 0.1
    assert np.abs(after - before)[93:99].max() < 0.06, "the swing is the model's"
    assert speed(after, 30.0)[:80].mean() < 0.005 and speed(after, 30.0)[115:].mean() < 0.005


def test_corrections_come_and_go_slowly(with_toes):
    motion = swaying(standing(with_toes))
    labels = np.zeros((motion.n_frames, 4))
    labels[40:70], labels[74:110], labels[150:] = 1, 1, 1
    correction = foot_positions(lock_feet(motion, labels)) - foot_positions(motion)
    sway = speed(foot_positions(motion), 30.0).max()
    assert speed(correction, 30.0).max() < 0.35 + sway


def test_a_straight_leg_does_not_flip_its_knee(with_toes):
    motion = standing(with_toes)
    angles = np.zeros((motion.n_frames, 3))
    angles[:, 0] = 4 * np.sin(2 * np.pi * 0.7 * motion.times)  # to both sides of straight
    rotations = motion.rotations.copy()
    for side in ("Left", "Right"):
        for part, share in (("UpLeg", -0.5), ("Leg", 1.0), ("Foot", -0.5)):
            joint = motion.skeleton.index(side + part)
            rotations[:, joint] = quaternion_from_euler(share * angles, "XYZ")
    locked = lock_feet(swaying(replace(motion, rotations=rotations)))
    knee = locked.positions()[:, motion.skeleton.index("LeftLeg")]
    assert speed(knee, 30.0).max() < 0.8


def test_joints_that_carry_the_body_may_hang_below_a_still_root(with_toes):
    names = ("Marker", *with_toes.names)
    rig = Skeleton(
        names=names,
        parents=(-1, *(parent + 1 for parent in with_toes.parents)),
        offsets=np.concatenate([np.zeros((1, 3)), with_toes.offsets]),
    )
    plain = standing(with_toes)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (plain.n_frames, 1, 1))
    place = plain.translation + plain.times[:, None] * [0.1, 0.0, 0.0]
    motion = Motion(
        rig,
        np.concatenate([still, plain.rotations], axis=1),
        np.zeros((plain.n_frames, 3)),
        30.0,
        {"Hips": place},
    )
    locked = lock_feet(motion)
    assert (locked.translation == 0).all()
    assert speed(foot_positions(locked), 30.0).mean() < 0.002


def test_one_frame_and_two(with_toes):
    motion = standing(with_toes)
    for n in (1, 2, 5):
        assert lock_feet(motion.slice(0, n)).n_frames == n


def deeper(before: Motion, after: Motion) -> float:
    floor = standing_heights(before)
    one, other = (np.maximum(floor - foot_positions(m)[..., 1], 0) for m in (before, after))
    return float((other - one).max())


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh", 0.75),
        ("motion/bandai/dataset-1_bow_happy_001.bvh", 0.5),
        ("motion/bandai/dataset-1_bye_feminine_001.bvh", 0.5),
        ("motion/reactidle/003_genuine.bvh", 0.5),
        ("motion/aitviewer/sample.bvh", 0.5),
    ],
)
def test_recordings_slide_less_and_sink_no_deeper(shared_data, name, most):
    motion = Motion.load(shared_data / name)
    motion = motion.slice(2, motion.n_frames)  # one of them begins with another pose
    locked = lock_feet(motion)
    labels = contact_labels(motion)[1:] > 0
    before, after = (speed(foot_positions(m), m.fps)[labels] for m in (motion, locked))
    assert after.mean() <= most * before.mean()
    assert deeper(motion, locked) < 5e-4
    correction = foot_positions(locked) - foot_positions(motion)
    assert speed(correction, motion.fps).max() < 0.5


def test_a_recording_that_drifts_stands_again(shared_data):
    path = shared_data / "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh"
    recorded = Motion.load(path).slice(0, 600)
    drifting = moved(recorded, recorded.times[:, None] * [0.1, 0.0, 0.0])
    labels = contact_labels(recorded)
    for contacts in (labels, None):
        slid = speed(foot_positions(lock_feet(drifting, contacts)), 30.0)[labels[1:] > 0]
        assert slid.mean() < 0.01


def test_foot_lock_does_not_change_running(shared_data):
    motion = Motion.load(shared_data / "smpl/glamr_running_smpl.npz")
    assert np.abs(lock_feet(motion).positions() - motion.positions()).max() < 0.02
