"""Feet stay where they stand, everything else stays as it was, and nothing gets worse."""

from __future__ import annotations

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
    multiply_quaternions,
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
    with pytest.raises(MotionError, match=r"\(30, 3\).*\(30, 4\)"):
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


def test_corrections_come_and_go_slowly(with_toes):
    motion = swaying(standing(with_toes))
    labels = np.zeros((motion.n_frames, 4))
    labels[40:70], labels[74:110], labels[150:] = 1, 1, 1
    correction = foot_positions(lock_feet(motion, labels)) - foot_positions(motion)
    sway = speed(foot_positions(motion), 30.0).max()
    assert speed(correction, 30.0).max() < 0.35 + sway


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


@pytest.mark.parametrize("points", [(1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])
def test_a_foot_is_moved_by_a_tenth_of_the_leg_at_most(with_toes, points):
    """A labelled foot slides by 0.165 m in ten frames: the pin is 0.0825 m away at either end.

    The leg is 0.84 m long. Above 3/4 of 0.084 m corrections are compressed, to
    0.063 + 0.021 (1 - exp(-(0.0825 - 0.063) / 0.021)) = 0.0757 m. If only heel or ball is
    labelled, the whole foot is moved. It takes 0.379 s to fade at 0.3 m/s, 11 frames: 6 frames from
    either end, half of it is left.
    """
    motion = standing(with_toes)
    frames = np.clip(np.arange(motion.n_frames) - 90, 0, 9)
    sliding = moved(motion, 0.55 / 30 * frames[:, None] * [1.0, 0.0, 0.0])
    labels = np.zeros((motion.n_frames, 4))
    labels[90:100, :2] = points
    locked = lock_feet(sliding, labels, keep_path=True)
    correction = foot_positions(locked) - foot_positions(sliding)
    found = correction[[78, 90, 99, 111], :2, 0]
    expected = np.array([0.0, 0.0757, -0.0757, 0.0])
    np.testing.assert_allclose(found, np.stack([expected] * 2, axis=1), atol=2e-4)
    if sum(points) == 1:
        halfway = [[0.0757 / 2] * 2, [-0.0757 / 2] * 2]
        np.testing.assert_allclose(correction[[84, 105], :2, 0], halfway, atol=2e-4)
    np.testing.assert_allclose(correction[:, 2:], 0, atol=1e-7)


def test_frames_far_from_contact_keep_their_pose_bit_for_bit(with_toes):
    motion = strolling(with_toes)
    labels = np.zeros((motion.n_frames, 4))
    labels[100:130] = 1.0
    locked = lock_feet(motion, labels, keep_path=True)
    far = np.r_[:60, 170 : motion.n_frames]
    assert (locked.rotations[far] == motion.rotations[far]).all()
    assert (locked.translation[far] == motion.translation[far]).all()
    assert (locked.rotations[100:130] != motion.rotations[100:130]).any(axis=(1, 2)).all()


def test_a_foot_stands_from_its_landing_to_its_leaving(with_toes):
    """It arrives at 0.6 m/s, and slides at 0.35 m/s for the last 0.1 s; and leaves the same way."""
    motion = standing(with_toes)
    steps = np.zeros(motion.n_frames)
    steps[:58], steps[58:61], steps[120:123], steps[123:] = 0.6, 0.35, 0.35, 0.6
    sliding = moved(motion, np.cumsum(steps)[:, None] / 30 * [0.0, 0.0, 1.0])
    after = foot_positions(lock_feet(sliding, keep_path=True))
    assert speed(after[58:122], 30.0).max() < 1e-6


@pytest.mark.parametrize(
    "labels", [(1.0, 0.0, 1.0, 0.0), (0.0, 1.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)]
)
def test_a_body_that_drifts_on_some_points_of_its_feet_is_moved_back(with_toes, labels):
    still = standing(with_toes, 10.0)
    drifting = moved(still, still.times[:, None] * [0.1, 0.0, 0.05])
    locked = lock_feet(drifting, np.tile(labels, (still.n_frames, 1)))
    assert np.ptp(locked.translation, axis=0).max() < 0.01


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


def test_a_body_that_floats_slowly_comes_down_as_a_whole(with_toes):
    """Smoothing over 1 s keeps exp(-(2 pi 0.05)^2 / 2) = 0.952 of a period of 20 s."""
    still = standing(with_toes, 40.0)
    float_ = 0.01 * np.sin(2 * np.pi * 0.05 * still.times)
    floating = moved(still, float_[:, None] * [0.0, 1.0, 0.0])
    locked = lock_feet(floating, np.ones((still.n_frames, 4)))
    left = locked.translation[:, 1] - still.translation[:, 1]
    np.testing.assert_allclose(left[300:-300], 0.048 * float_[300:-300], atol=1e-5)
    assert np.ptp(foot_positions(locked)[..., 1], axis=0).max() < 1e-6


def test_tapping_toes_do_not_lift_the_hips(with_toes):
    """The heels stand, and are labelled; the balls come and go."""
    motion = standing(with_toes, 20.0)
    tap = 8 * (1 - np.cos(2 * np.pi * 0.1 * motion.times))
    tapping = pitched(motion, {"LeftFoot": -15 - tap, "RightFoot": -15 - tap})
    assert np.ptp(foot_positions(tapping)[:, 1, 1]) > 0.03
    locked = lock_feet(tapping, np.tile([1.0, 0.0, 1.0, 0.0], (motion.n_frames, 1)))
    np.testing.assert_allclose(locked.translation[:, 1], motion.translation[:, 1], atol=1e-6)


@pytest.mark.parametrize("way", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_hips_that_sway_over_straight_legs_come_down_in_an_arc(with_toes, way):
    """0.06 m aside, a leg of 0.84 m reaches up to sqrt(0.84^2 - 0.06^2) = 0.83786 m."""
    motion = standing(with_toes)
    sway = 0.06 * np.sin(2 * np.pi * 0.5 * motion.times)[:, None] * way
    swaying = moved(straightened(motion), sway)
    locked = lock_feet(swaying, np.ones((motion.n_frames, 4)), keep_path=True)
    assert np.ptp(foot_positions(locked), axis=0).max() < 1e-6
    drop = swaying.translation[:, 1] - locked.translation[:, 1]
    assert drop.max() == pytest.approx(0.84 - 0.83786, abs=2e-5)


def test_a_heel_that_is_lifted_while_labelled_stays_lifted(with_toes):
    """The heel is lifted by 0.025 m for a third of the time.

    What is above the noise of 0.01 m is kept: 0.025^3 / (0.025^2 + 0.01^2) = 0.02155 m. The lifted
    heel is 0.1284 m behind the ball instead of 0.14 m, in the mean 0.1361 m, and is pinned there:
    the foot of 0.1487 m gets a slope of atan(0.07155 / 0.1361), which lifts it by 0.0192 m.
    """
    motion = standing(with_toes)
    length = np.hypot(0.05, 0.14)
    steep = np.degrees(np.arcsin((0.05 + 0.025) / length) - np.arcsin(0.05 / length))
    lift = steep * ((motion.times >= 2) & (motion.times < 4))
    lifted = pitched(motion, {"LeftFoot": lift - 15, "LeftToeBase": -lift})
    raised = foot_positions(motion)[:, 1, 1] - foot_positions(lifted)[:, 1, 1]
    on_ball = moved(lifted, raised[:, None] * [0.0, 1.0, 0.0])
    labels = np.tile([1.0, 1.0, 0.0, 0.0], (motion.n_frames, 1))
    feet = foot_positions(lock_feet(on_ball, labels, keep_path=True))
    floors = foot_positions(motion)[0, :2, 1]
    assert (feet[75:105, 0, 1] - floors[0]) == pytest.approx(0.0192, abs=1e-4)
    assert (feet[:, 1, 1] - floors[1]) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(("kind", "lowest"), [("toes", "ball"), ("toes", "tip"), ("ends", "ball")])
def test_a_heel_is_not_lowered_if_the_toes_would_sink(skeleton, with_toes, kind, lowest):
    """Only the heel is labelled; it is 0.02 m too high while the ball or the tip of the toes is on
    the floor. Half a centimetre of that is above the toes, and is taken away.
    """
    motion = standing(rigs(skeleton, with_toes)[kind])
    high = ((motion.times >= 2) & (motion.times < 4))[:, None]
    rotations = motion.rotations.copy()
    if lowest == "ball":
        # The sole rises by 0.065 m from ball to heel instead of by 0.05 m.
        ahead = 0.14 if kind == "toes" else 0.15
        steep = np.arcsin(0.065 / np.hypot(0.05, ahead)) - np.arctan2(0.05, ahead)
        turns = {"LeftFoot": steep, "LeftToeBase": -steep}
    else:
        turns = {"LeftToeBase": np.arcsin(0.015 / 0.06)}
    for name, turn in turns.items():
        if name in motion.skeleton.names:
            own = quaternion_from_rotation_vector(turn * high * [1.0, 0.0, 0.0])
            j = motion.skeleton.index(name)
            rotations[:, j] = multiply_quaternions(rotations[:, j], own)
    raised = moved(replace(motion, rotations=rotations), 0.02 * high * [0.0, 1.0, 0.0])
    labels = np.tile([1.0, 0.0, 0.0, 0.0], (motion.n_frames, 1))
    locked = lock_feet(raised, labels, keep_path=True)
    down = (raised.positions() - locked.positions())[75:105, motion.skeleton.index("LeftFoot"), 1]
    np.testing.assert_allclose(down, 0.005, atol=1e-4)


def test_large_drops_of_the_hips_are_compressed(with_toes):
    """Above half of a twentieth of the leg (0.021 m of 0.84), a drop of 0.029 m becomes
    0.021 + 0.021 (1 - exp(-(0.029 - 0.021) / 0.021)) = 0.02765 m.
    """
    motion = standing(with_toes)
    high = 0.029 * (np.abs(motion.times - 3) < 0.5)[:, None] * [0.0, 1.0, 0.0]
    labels = np.ones((motion.n_frames, 4))
    raised = moved(straightened(motion), high)
    locked = lock_feet(raised, labels, keep_path=True)
    assert (locked.rotations[:60] == raised.rotations[:60]).all()
    drop = (raised.translation - locked.translation)[:, 1]
    assert drop[90] == pytest.approx(0.02765, abs=1e-4) and drop.max() < 0.0277
    assert drop[:60].max() == 0 and drop[120:].max() == 0


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


@pytest.mark.parametrize(("degrees", "heel_slides"), [(4.0, 1e-4), (8.0, 4e-3)])
def test_heel_and_ball_of_a_flat_foot_stay_while_it_turns(with_toes, degrees, heel_slides):
    """A foot that turns by 4 degrees to either side is turned back, sole level, with its toes.

    8 degrees are more than the limit of a turn, so that the ball stays and the heel slides.
    """
    motion = standing(with_toes)
    yaw = np.radians(degrees) * np.sin(2 * np.pi * 0.5 * motion.times)
    rotations = motion.rotations.copy()
    foot = motion.skeleton.index("LeftFoot")
    world = quaternion_from_rotation_vector(yaw[:, None] * [0.0, 1.0, 0.0])
    rotations[:, foot] = multiply_quaternions(motion.rotations[:, foot], world)
    turning = replace(motion, rotations=rotations)
    before, after = foot_positions(turning), foot_positions(lock_feet(turning))
    slides = np.ptp(after, axis=0).max(axis=1)
    assert np.ptp(before[:, 1, 0]) > 0.004 * degrees and slides[1] < 1e-4
    assert slides[0] < heel_slides and (slides[0] > 1e-3) == (degrees > 4)
    np.testing.assert_allclose(after[:, 1, 1], before[:, 1, 1], atol=1e-4)
    # 0.14 m times sin(8 degrees) is 0.0195 m, compressed to 0.0189 m: 0.24 degrees are left.
    pointing = np.degrees(np.arctan2(*(after[:, 1] - after[:, 0])[:, [0, 2]].T))
    left = 0.24 if degrees > 4 else 0.0
    assert pointing[np.argmax(yaw)] == pytest.approx(left, abs=0.03)
    assert pointing[np.argmin(yaw)] == pytest.approx(-left, abs=0.03)
    toe = lock_feet(turning).global_rotations()[:, motion.skeleton.index("LeftToeBase")]
    assert np.degrees(rotation_angles(toe, np.array([0.0, 0.0, 0.0, 1.0]))).max() < 0.2 * degrees


@pytest.mark.parametrize(("degrees", "turns_back"), [(20.0, False), (14.0, True)])
def test_a_foot_that_has_turned_stands_in_its_new_direction(with_toes, degrees, turns_back):
    """It turns within half a second. Its tip is sin(10 degrees) = 0.174 of the foot's length from
    the middle at either end, more than the 0.15 that a pin turns it; sin(7 degrees) is 0.122.
    """
    motion = standing(with_toes)
    share = np.clip((motion.times - 2.75) / 0.5, 0, 1)
    yaw = np.radians(degrees) * share**2 * (3 - 2 * share)
    world = quaternion_from_rotation_vector(yaw[:, None] * [0.0, 1.0, 0.0])
    rotations = motion.rotations.copy()
    foot = motion.skeleton.index("LeftFoot")
    rotations[:, foot] = multiply_quaternions(world, motion.rotations[:, foot])
    # About the vertical: the leg above it leans by nothing in sum.
    feet = foot_positions(lock_feet(replace(motion, rotations=rotations), keep_path=True))
    pointing = np.degrees(np.arctan2(*(feet[:, 1] - feet[:, 0])[:, [0, 2]].T))
    apart = pointing[-60:].mean() - pointing[:60].mean()
    assert np.ptp(pointing[:60]) < 0.01 and np.ptp(pointing[-60:]) < 0.01
    assert (apart < 3.0) if turns_back else (apart > 19.0), apart


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
        assert lock_feet(motion[:n]).n_frames == n


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
    motion = motion[2:]  # one of them begins with another pose
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
