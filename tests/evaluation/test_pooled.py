"""Hand movement and the metrics of all clips pooled, on motion whose hands follow known paths."""

import re
from dataclasses import replace

import numpy as np
import pytest
from rigs import without_joints
from scipy.spatial.transform import Rotation

from gesturekit.corpus import Item, Manifest
from gesturekit.errors import MotionError
from gesturekit.evaluation import (
    ModelResult,
    MotionWindows,
    body_centred,
    calm_and_lively,
    copying,
    evaluate,
    hand_movement,
    hand_paths,
    hand_speed,
    motion_windows,
    two_sample_accuracy,
    within_reach,
)
from gesturekit.evaluation.metrics.two_sample import arm_windows, nearest_arm, nearest_training
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts import find_parts

FPS = 25.0


@pytest.fixture
def reaching(skeleton: Skeleton):
    """reaching(left, right): hands (T, 3) metres from a place far below their elbows, on a body
    that stands: such long bones hardly change their length."""

    def make(left: np.ndarray, right: np.ndarray | None = None, fps: float = FPS) -> Motion:
        rotations = np.zeros((len(left), skeleton.n_joints, 4))
        rotations[..., 3] = 1.0
        right = np.zeros_like(left) if right is None else right
        far = np.array([0.0, -9.0, 0.0])
        moving = {"LeftHand": left + far, "RightHand": right + far}
        still = np.tile([0.0, 0.9, 0.0], (len(left), 1))
        return Motion(skeleton, rotations, still, fps, joint_translations=moving)

    return make


def along_x(speed: np.ndarray) -> np.ndarray:
    """(T, 3) path with the given speed (T,) in m/s, to and fro along x."""
    x = np.cumsum(speed * np.where(np.arange(len(speed)) // 250 % 2, -1.0, 1.0)) / FPS
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)


def wandering(n: int, seed: int) -> np.ndarray:
    """(T, 3) smooth random path."""
    from scipy.ndimage import gaussian_filter1d

    noise = np.random.default_rng(seed).standard_normal((n, 3))
    return 0.6 * gaussian_filter1d(noise, 6.0, axis=0)


@pytest.fixture
def talker(reaching):
    """talker(seed, seconds): both hands on their own random paths."""
    return lambda seed, seconds=20.0: reaching(
        wandering(round(seconds * FPS), 2 * seed), wandering(round(seconds * FPS), 2 * seed + 1)
    )


def elsewhere(motion: Motion, seed: int = 0) -> Motion:
    """The same movement of a body that walks about and turns."""
    n = motion.n_frames
    yaw = Rotation.from_rotvec(np.outer(np.linspace(0.3, 7.0, n), [0.0, 1.0, 0.0]))
    rotations = motion.rotations.copy()
    rotations[:, 0] = (yaw * Rotation.from_quat(rotations[:, 0])).as_quat()
    return replace(motion, rotations=rotations, translation=wandering(n, seed) + 3.0)


def test_a_hand_on_a_circle_has_its_speed(turning):
    # 2 rad/s at 0.25 m: 0.5 m/s, less what central differences and smoothing take (0.4 %).
    speed = hand_speed(turning({"LeftForeArm": np.full(100, 2.0)}))
    assert speed[5:-5, 0] == pytest.approx(np.full(90, 0.5), rel=0.01)
    assert speed[:, 1] == pytest.approx(np.zeros(100), abs=1e-9)


def test_walking_and_turning_is_no_hand_movement(talker):
    motion = talker(0)
    assert body_centred(elsewhere(motion)) == pytest.approx(body_centred(motion), abs=1e-9)
    assert hand_movement(elsewhere(motion)).reach == pytest.approx(hand_movement(motion).reach)


def test_body_centred_motion_faces_forward(talker):
    shoulders = body_centred(elsewhere(talker(0)), ["LeftArm", "RightArm", "Hips"])
    assert (shoulders[:, 0] - shoulders[:, 1])[:, 2] == pytest.approx(0.0, abs=1e-9)
    assert np.all(shoulders[:, 0, 0] > 0.1)  # the left one is on the left
    assert shoulders[:, 2] == pytest.approx(0.0, abs=1e-9)


def test_quantiles_and_rests(reaching):
    # The left hand moves at 0.5 m/s for 60 of 100 s, then drifts at 0.05; the right one is still.
    speed = np.where(np.arange(2500) < 1500, 0.5, 0.05)
    found = hand_movement(reaching(along_x(speed)))
    assert found.q10 == pytest.approx(0.0, abs=1e-6)
    assert found.q90 == found.q99 == pytest.approx(0.5, abs=1e-6)
    assert found.rest == pytest.approx(0.7, abs=0.01)
    assert found.near_still == pytest.approx(0.5, abs=0.01)


def test_reach_is_the_size_of_the_covariance(reaching):
    rng = np.random.default_rng(0)
    left = rng.multivariate_normal(np.ones(3), np.diag([0.01, 0.04, 0.09]), 20_000)
    turned = left @ Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix().T
    # (0.1 · 0.2 · 0.3)^(1/3) for either hand.
    both = hand_movement(reaching(left, turned)).reach
    assert both == pytest.approx(2 * 0.006 ** (1 / 3), rel=0.02)
    assert hand_movement(reaching(left)).reach == pytest.approx(both / 2, rel=0.02)


def test_range_is_the_contrast_of_calm_and_lively(reaching):
    # Half of the time 0.2 m/s, half of it 0.6: mean 0.4, standard deviation 0.2.
    path = along_x(np.where(np.arange(20_000) // 5000 % 2, 0.2, 0.6))
    assert hand_movement(reaching(path, path)).range == pytest.approx(0.5, abs=0.02)
    level = along_x(np.full(2000, 0.4))
    assert hand_movement(reaching(level, level)).range < 0.05
    assert np.isnan(hand_movement(reaching(level[:60])).range)
    assert np.isnan(hand_movement(reaching(np.zeros((2000, 3)))).range)


def test_clips_are_pooled_by_frame_and_never_joined(reaching):
    fast, slow = (reaching(along_x(np.full(n, v))) for n, v in ((600, 0.5), (200, 0.05)))
    assert hand_movement([fast, slow]).rest == pytest.approx(5 / 8, abs=0.01)
    jump = reaching(np.full((50, 3), 5.0)), reaching(np.zeros((50, 3)))
    assert hand_movement(jump).q99 == pytest.approx(0.0, abs=1e-9)


def test_thresholds_grow_with_the_body(reaching):
    motion = reaching(0.2 * wandering(500, 0), 0.1 * wandering(500, 1))
    small, giant = hand_movement(motion), hand_movement(motion.scaled(10.0))
    assert 0.05 < small.rest < 0.95
    assert (giant.rest, giant.near_still, giant.range) == pytest.approx(
        (small.rest, small.near_still, small.range)
    )
    assert (giant.q50, giant.reach) == pytest.approx((10 * small.q50, 10 * small.reach))


def test_calm_and_lively_has_the_slope_and_the_sign(reaching):
    speed = 0.4 + 0.3 * np.sin(np.arange(2500) / 200)
    recorded = reaching(along_x(speed), along_x(speed))
    half = reaching(along_x(speed / 2), along_x(speed / 2))
    found = calm_and_lively(recorded, [half])
    assert (found.r, found.slope) == pytest.approx((1.0, 0.5), abs=0.01)
    assert found.n == 39  # (100 - 5) / 2.5 + 1
    opposite = reaching(along_x(0.8 - speed), along_x(0.8 - speed))
    assert calm_and_lively(recorded, [opposite]).r == pytest.approx(-1.0, abs=0.01)
    # Two samples are averaged: half as fast and one and a half times as fast.
    lively = reaching(along_x(1.5 * speed), along_x(1.5 * speed))
    assert calm_and_lively(recorded, [[half, lively]]).slope == pytest.approx(1.0, abs=0.01)
    still = reaching(np.zeros((2500, 3)))
    assert calm_and_lively(recorded, [still]).r == 0.0
    with pytest.raises(MotionError, match=r"(?=.*\b3 windows).*\b2\b"):
        calm_and_lively(recorded[:200], [half])


def test_rigs_without_arms_or_wrists_are_errors(turning, skeleton):
    legs = Skeleton(
        ("Hips", "LeftLeg", "LeftFoot", "RightLeg", "RightFoot"),
        (-1, 0, 1, 0, 3),
        np.array([[0, 0, 0], [0.1, 0, 0], [0, -0.8, 0], [-0.1, 0, 0], [0, -0.8, 0]], float),
    )
    walking = Motion(legs, np.tile([0.0, 0, 0, 1], (50, 5, 1)), np.zeros((50, 3)), FPS)
    with pytest.raises(MotionError, match="arm"):
        hand_movement(walking)
    with pytest.raises(MotionError, match=r"(?=.*\b1 frame).*\b2\b"):
        hand_speed(turning({"LeftArm": np.ones(1)}))
    with pytest.raises(MotionError, match="motion"):
        hand_movement([])


def test_windows_lie_half_a_second_apart(talker):
    windows = motion_windows([talker(0, 3.0), talker(1, 0.8), talker(2, 1.0)])
    assert windows.starts == pytest.approx([0.0, 0.48, 1.0, 1.48, 2.0, 0.0])
    assert windows.clips.tolist() == [0, 0, 0, 0, 0, 2]
    with pytest.raises(MotionError, match=r"window of 1 s"):
        motion_windows(talker(1, 0.8))


def test_the_distance_of_windows_is_in_metres(reaching):
    # One of 2 compared joints is 0.3 m away in every frame: root mean square 0.3 / √2.
    near, far = (reaching(np.full((25, 3), (x, 0.0, 0.0))) for x in (0.0, 0.3))
    a, b = (motion_windows(m, ["LeftHand", "RightHand"]).values for m in (near, far))
    assert np.linalg.norm(a - b) == pytest.approx(0.3 / np.sqrt(2))
    # A constant 1 m/s of both adds 0.2 m of velocity.
    path = np.outer(np.arange(25) / FPS, [1.0, 0.0, 0.0])
    moving = motion_windows(reaching(path, path), ["LeftHand", "RightHand"]).values
    expected = np.sqrt(0.2**2 + np.mean(path[:, 0] ** 2))
    assert np.linalg.norm(moving - a) == pytest.approx(expected)


def test_two_sample_accuracy_is_that_of_scikit_learn(talker):
    from sklearn.model_selection import LeaveOneOut, cross_val_score
    from sklearn.neighbors import KNeighborsClassifier

    one, other = motion_windows(talker(0, 8.0)), motion_windows(talker(1, 8.0))
    values = np.concatenate([one.values, other.values])
    labels = np.repeat([0, 1], [len(one), len(other)])
    expected = cross_val_score(KNeighborsClassifier(1), values, labels, cv=LeaveOneOut()).mean()
    assert two_sample_accuracy(one, other) == pytest.approx(expected)


def test_two_sample_accuracy_of_one_distribution_of_copies_and_of_other_movement(talker):
    recorded = motion_windows(talker(0, 60.0))
    same, copied = motion_windows(talker(1, 60.0)), motion_windows(talker(0, 60.0))
    assert two_sample_accuracy(same, recorded) == pytest.approx(0.5, abs=0.15)
    assert two_sample_accuracy(copied, recorded) < 0.05
    other = motion_windows(talker(1, 60.0).scaled(3.0))
    assert two_sample_accuracy(other, recorded) > 0.95


def test_within_reach_counts_windows_that_have_a_near_one():
    def windows(x: list[float], starts: list[float]) -> MotionWindows:
        first = np.round(25 * np.array(starts)).astype(int)
        frames = np.zeros((first.max() + 25, 1))
        for value, start in zip(x, first):
            frames[start : start + 25] = value / 5  # 25 frames: the root of their sum is x
        return MotionWindows((frames,), np.zeros(len(x), int), first)

    # Nearest more than 3 s away: 0 -> 1.0, 0.1 -> 0.9, 1 -> 0.9, 3 -> 2.0; median 0.95.
    recorded = windows([0.0, 0.1, 1.0, 3.0], [0.0, 1.0, 4.04, 8.04])
    assert within_reach(windows([0.9], [0.0]), recorded) == 3 / 4
    # 0.92 from the last: less than 0.95, but more than the least of the four distances.
    assert within_reach(windows([2.08], [0.0]), recorded) == 1 / 4
    assert within_reach(windows([9.0], [0.0]), recorded) == 0.0
    with pytest.raises(MotionError, match=r"\b3 s\b"):
        within_reach(recorded, windows([0.0, 1.0], [0.0, 3.0]))


def test_the_recordings_value_is_that_of_the_recordings_each_model_has_clips_of(talker, tmp_path):
    for k, name in enumerate("abc"):
        talker(k, 5.0).save(tmp_path / "recordings" / f"{name}.npz")
        talker(5 + k, 5.0).save(tmp_path / "whole" / f"{name}.npz")
        talker(8 + k, 5.0).save(tmp_path / "less" / f"{name}.npz")
    (tmp_path / "less" / "c.npz").write_bytes(b"damaged")
    folders = {name: tmp_path / name for name in ("whole", "less")}
    whole, less = evaluate(folders, tmp_path / "recordings", cheap=True).models
    (alone,) = evaluate({"less": tmp_path / "less"}, tmp_path / "recordings", cheap=True).models
    for key in ("one_nn", "within_reach"):
        own = less.metrics[key].recording
        assert own == pytest.approx(alone.metrics[key].recording), key
    assert whole.metrics["one_nn"].recording != pytest.approx(less.metrics["one_nn"].recording)
    of_clips = np.mean([clip.metrics["one_nn"] for clip in whole.clips])
    assert of_clips == pytest.approx(whole.metrics["one_nn"].interval.value, abs=0.05)


def test_copies_are_found_mirrored_stretched_and_at_any_frame(talker):
    training, held_out = talker(0, 20.0), talker(1, 12.0)
    new = copying(talker(2, 12.0), held_out, training)
    assert 0.8 < new.median_ratio < 1.25
    assert 0.7 < new.low_ratio < 1.4
    cut = training[107:307]
    for copy, far in (
        (cut, 1e-6),
        (cut.mirror(), 1e-6),
        (replace(cut, fps=FPS * 1.1), 0.08),
        (replace(cut.mirror(), fps=FPS / 1.1), 0.08),
    ):
        found = copying(copy, held_out, training)
        assert found.median_ratio < far
        assert found.held_out_median == new.held_out_median
    # One copied second in twenty shows in the 5 % quantile alone.
    mixed = copying([talker(2, 18.0), training[107:207]], held_out, training)
    assert mixed.median_ratio > 0.8
    assert mixed.low_ratio < 0.1


def judged(made: Motion, recorded: Motion, tmp_path) -> ModelResult:
    """Evaluate a motion against one recording."""
    for folder, motion in (("made", made), ("recorded", recorded)):
        motion.save(tmp_path / folder / "talk.npz")
    return evaluate(tmp_path / "made", tmp_path / "recorded", cheap=True).models[0]


@pytest.mark.parametrize(("seconds", "enough"), [(25.0, False), (43.0, True)])
def test_a_few_windows_say_nothing_about_calm_and_lively(talker, tmp_path, seconds, enough):
    """16 windows of 5 s, 2.5 s apart, take 42.5 s."""
    found = judged(talker(1, seconds), talker(0, seconds), tmp_path)
    assert found.metrics["calm_lively_r"].informative == enough
    assert found.metrics["calm_lively_slope"].informative == enough
    assert ("lively" in found.verdict) == enough


def test_the_verdict_of_motion_that_is_frozen_always_or_half_of_the_time(
    talker, reaching, tmp_path
):
    still = judged(reaching(np.zeros((400, 3))), talker(0, 16.0), tmp_path / "still").verdict
    assert "move" in still and "reach" not in still
    half = np.where(np.arange(400) < 200, 1.0, 0.0)[:, None] * wandering(400, 1) + [0.3, 0.0, 0.0]
    frozen = judged(reaching(half, half), talker(0, 16.0), tmp_path / "frozen").verdict
    assert "reach" in frozen.lower() and re.search("frozen.*(49|50) %", frozen)


def test_copies_are_measured_against_the_training_split(talker, tmp_path):
    items = []
    for name, seed in (("day", 0), ("night", 1), ("held", 2)):
        talker(seed, 10.0).save(tmp_path / f"{name}.npz")
        split = "test" if name == "held" else "train"
        motion = tmp_path / f"{name}.npz"
        items.append(Item(id=name, audio=None, motion=motion, duration=10.0, split=split))
    Manifest(items).save(tmp_path / "corpus.jsonl")
    copy = talker(1, 10.0).mirror()
    copy.save(tmp_path / "made" / "held.npz")
    (model,) = evaluate(tmp_path / "made", tmp_path / "corpus.jsonl", cheap=True).models
    found = model.metrics
    held_out, training = talker(2, 10.0), [talker(0, 10.0), talker(1, 10.0)]
    expected = copying(copy, held_out, training)
    assert found["copying"].interval.value == pytest.approx(expected.median, abs=1e-4)
    assert found["copying"].recording == pytest.approx(expected.held_out_median, rel=1e-3)
    own = [motion_windows(motion) for motion in (held_out, training)]
    assert found["one_nn"].recording == pytest.approx(two_sample_accuracy(*own), abs=0.05)
    assert "copied" in model.verdict and "training" in found["copying"].note


def test_an_arm_is_copied_from_another_place_or_mirrored(gesture):
    training, held_out = gesture(20.0, FPS, seed=0), gesture(12.0, FPS, seed=1)
    made, arms = gesture(8.0, FPS, seed=2), find_parts(training.skeleton).arms
    rotations, (donor, mirrored) = made.rotations.copy(), (training[107:307], training.mirror())
    for side, source in (("left", donor), ("right", mirrored)):
        at = [training.skeleton.index(n) for n in (arms[side].shoulder, arms[side].elbow)]
        rotations[:, at] = source.rotations[: len(rotations), at]
    copy = replace(made, rotations=rotations)
    for side in ("left", "right"):
        own, new, copied = (
            np.median(nearest_arm(arm_windows([motion], side), [training], side))
            for motion in (held_out, made, copy)
        )
        assert copied < 0.01 < 0.5 * own < new, side


def test_the_distance_of_arms_is_an_angle(turning):
    """An elbow that is 0.2 rad away, and a shoulder that is not: root mean square .1414."""
    bent = turning({"LeftForeArm": np.zeros(40)})
    away = bent.rotations.copy()
    away[:, bent.skeleton.index("LeftForeArm"), 2:] = np.sin(0.1), np.cos(0.1)
    windows = arm_windows([replace(bent, rotations=away)], "left")
    found = nearest_arm(windows, [bent], "left")
    assert found == pytest.approx(np.degrees(0.2 / np.sqrt(2)), rel=1e-2)


def test_hands_of_a_rig_without_wrists_are_the_ends_of_its_forearms(talker, skeleton):
    motion = elsewhere(replace(talker(0), joint_translations={}))
    whole = skeleton.offsets[[skeleton.index(f"{side}Hand") for side in ("Left", "Right")]]
    bare = without_joints(motion, "Hand")
    ends = {f"{side}ForeArm": (offset,) for side, offset in zip(("Left", "Right"), whole)}
    cut = replace(bare, skeleton=replace(bare.skeleton, end_sites=ends))
    assert hand_paths(cut) == pytest.approx(hand_paths(motion))
    with pytest.raises(MotionError, match="wrist"):
        hand_paths(bare)


def test_hands_that_change_nothing_or_too_little_cannot_be_compared(reaching):
    speed = 0.4 + 0.3 * np.sin(np.arange(2500) / 200)
    lively, level = (reaching(along_x(s), along_x(s)) for s in (speed, 0 * speed))
    with pytest.raises(MotionError, match="mean speed"):
        calm_and_lively(level, [lively])
    # Three windows take 10 s; what one of both lacks is left out.
    assert calm_and_lively(lively[:250], [lively]).n == 3
    with pytest.raises(MotionError, match=r"(?=.*\b3 windows).*\b2\b"):
        calm_and_lively(lively, [lively[:249]])
    two = calm_and_lively([lively[:1000], lively[1000:]], [lively[:900], lively[1000:]])
    assert two.n == 13 + 23 and two.r == pytest.approx(1.0)


def test_distances_to_training_motion_are_the_least_over_its_copies(reaching):
    """A hand that stands 0.1 to the left of where it stood in training, or 0.3 to the right."""

    def standing(x: float, seconds: float = 2.0) -> Motion:
        path = np.tile([x, 0.0, 0.0], (round(seconds * FPS), 1))
        return reaching(path, -path)

    training = [standing(0.0), standing(0.5, 0.9), standing(0.4)]
    windows = motion_windows(standing(0.1), ["LeftHand"])
    found = nearest_training(windows, training, ["LeftHand"])
    assert found == pytest.approx([0.1] * len(windows))
    found = copying(standing(0.1), standing(0.3), training, ["LeftHand"])
    assert (found.median, found.low) == pytest.approx((0.1, 0.1))
    assert (found.held_out_median, found.held_out_low) == pytest.approx((0.1, 0.1))
    # Only both hands together have a mirrored copy.
    swapped = reaching(np.tile([0.2, 0, 0], (50, 1)), np.tile([-0.1, 0, 0], (50, 1)))
    other = reaching(np.tile([0.1, 0, 0], (50, 1)), np.tile([-0.2, 0, 0], (50, 1)))
    both = ["LeftHand", "RightHand"]
    assert copying(swapped, other, [other], both).median == pytest.approx(0.0, abs=1e-9)
    one = copying(swapped, other, [other], ["LeftHand"])
    assert one.median == pytest.approx(0.1) and one.held_out_median == pytest.approx(0.0)


def test_training_items_that_cannot_be_read_are_named(talker, tmp_path):
    items = []
    for k, (name, split) in enumerate((("a", "test"), ("b", "train"), ("c", "train"))):
        talker(k, 6.0).save(tmp_path / f"{name}.npz")
        items.append(Item(id=name, audio=None, motion=tmp_path / f"{name}.npz", duration=6.0,
                          split=split))  # fmt: skip
    talker(9, 6.0).save(tmp_path / "made" / "a.npz")
    Manifest(items).save(tmp_path / "corpus.jsonl")
    (tmp_path / "c.npz").write_bytes(b"damaged")
    (model,) = evaluate(tmp_path / "made", tmp_path / "corpus.jsonl", cheap=True).models
    assert [i.name for i in model.excluded if i.what == "the training split"] == ["c"]
    assert model.metrics["novelty"].interval.value > 0.0


def test_sets_with_a_single_window_and_of_other_joints_are_refused(talker):
    many, single = motion_windows([talker(0, 5.0)]), motion_windows([talker(1, 1.0)])
    for one, other in ((many, single), (single, many)):
        with pytest.raises(MotionError, match="2 or more"):
            two_sample_accuracy(one, other)
    fewer = motion_windows([talker(2, 5.0)], ["LeftArm", "LeftHand"])
    with pytest.raises(MotionError, match="same joints"):
        two_sample_accuracy(many, fewer)
