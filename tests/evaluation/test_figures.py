"""The figures of a report are those of the public functions, and are pooled as the docs say."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

import gesturekit.evaluation as ev
from audio_features import Wave
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints
from gesturekit.motion.parts.body_size import body_scale


def values(model) -> dict[str, float]:
    return {key: result.interval.value for key, result in model.metrics.items()}


@pytest.fixture(scope="module")
def folders(tmp_path_factory, gesture, write_speech) -> Path:
    """Two samples of each of two recordings of 10.5 s with sound."""
    root = tmp_path_factory.mktemp("figures")
    for r in range(2):
        gesture(10.5, 12.5, seed=r).save(root / "recordings" / f"c{r}.npz")
        write_speech(root / "sound" / f"c{r}.wav", 10.5)
        for k in (1, 2):
            gesture(10.5, 12.5, seed=10 * r + 10 + k).save(root / "made" / f"c{r}_s{k}.npz")
    return root


@pytest.fixture(scope="module")
def model(folders):
    (found,) = ev.evaluate(
        folders / "made", folders / "recordings", audio=folders / "sound", seed=4
    ).models
    return found


@pytest.fixture(scope="module")
def motions(model) -> tuple[list[Motion], list[Motion]]:
    """The clips in the order of the report, and the recording of each."""
    pairs = [clip.pair for clip in model.clips]
    return [p.generated.load_motion() for p in pairs], [p.reference.load_motion() for p in pairs]


def test_figures_of_clips(model, motions, folders):
    made, recorded = motions
    joints = body_joints(recorded[0].skeleton)
    limits = ev.JointLimits.fit(recorded[::2], joints[1:])
    for clip, motion, own in zip(model.clips, made, recorded, strict=True):
        wave = Wave.load(folders / "sound" / f"{clip.pair.stem}.wav")
        timing = ev.sync(motion, wave)
        poses = [ev.root_relative(m, joints).reshape(m.n_frames, -1) for m in (motion, own)]
        speeds = [ev.joint_speed(m, joints) / body_scale(own.skeleton) for m in (motion, own)]
        histograms = [ev.SpeedHistogram.of([speed.ravel()]) for speed in speeds]
        expected = {
            "arm_speed": ev.arm_speed(motion).mean(),
            "wrist_speed": ev.wrist_speed(motion).mean(),
            "foot_skate": ev.foot_skate(motion, ev.standing_heights(own)),
            "joint_limits": 100 * ev.joint_limit_share(motion, limits),
            "sync": timing.r, "sync_chance": timing.chance_mean, "sync_z": timing.z,
            "in_time": timing.r - timing.chance_mean,
            "bas": ev.beat_alignment(motion, ev.music_beats(wave)).score,
            "hellinger": ev.hellinger(*histograms), "cca": ev.cca(*poses),
            "l1_diversity": ev.l1_diversity(motion, joints),
        }  # fmt: skip
        for key, value in expected.items():
            assert clip.metrics[key] == pytest.approx(value, rel=1e-4, abs=1e-6), key


def test_figures_of_sets(model, motions):
    made, recorded = motions
    found, own = values(model), recorded[::2]
    joints = ev.upper_joints(own[0].skeleton)
    for key, measure in (
        ("raw_fgd", ev.raw_fgd),
        ("fid_k", ev.fid),
        ("fid_g", partial(ev.fid, kind="geometric")),
    ):
        assert found[key] == pytest.approx(measure(made, own).value, rel=1e-4), key
    assert found["div_k"] == pytest.approx(ev.clip_diversity(made, own), rel=1e-4)
    assert model.metrics["div_k"].recording == pytest.approx(ev.clip_diversity(own), rel=1e-4)
    ours, theirs = ev.motion_windows(made, joints), ev.motion_windows(own, joints)
    assert found["one_nn"] == pytest.approx(ev.two_sample_accuracy(ours, theirs, seed=4))
    assert found["within_reach"] == pytest.approx(100 * ev.within_reach(ours, theirs, seed=4))
    hands, recorded_hands = ev.hand_movement(made), ev.hand_movement(own)
    for key, name, factor in (
        ("hand_q10", "q10", 1), ("hand_q50", "q50", 1), ("hand_q90", "q90", 1),
        ("rest", "rest", 100), ("near_still", "near_still", 100), ("reach", "reach", 1),
        ("speed_range", "range", 1),
    ):  # fmt: skip
        assert found[key] == pytest.approx(factor * getattr(hands, name)), key
        theirs = factor * getattr(recorded_hands, name)
        assert model.metrics[key].recording == pytest.approx(theirs), key
    calm = ev.calm_and_lively(own, [made[k : k + 2] for k in (0, 2)])
    assert (found["calm_lively_r"], found["calm_lively_slope"]) == pytest.approx(
        (calm.r, calm.slope)
    )
    assert str(calm.n) in model.metrics["calm_lively_r"].note
    samples = [ev.patch_features(m, joints=body_joints(m.skeleton)) for m in made]
    apart = [ev.inter_diversity(samples[k : k + 2]) for k in (0, 2)]
    assert found["inter_diversity"] == pytest.approx(np.mean(apart), rel=1e-4)
    poses = [np.concatenate([ev.root_relative(m, body_joints(m.skeleton)) for m in side])
             for side in (made, recorded)]  # fmt: skip
    whole = ev.cca(*(side.reshape(len(side), -1) for side in poses))
    assert found["cca_global"] == pytest.approx(whole, abs=1e-4)
    speeds = np.concatenate([
        (ev.joint_speed(m, body_joints(m.skeleton)) / body_scale(one.skeleton)).ravel()
        for m, one in zip(made, recorded)
    ])  # fmt: skip
    beyond = 100.0 * (speeds >= 0.49).mean()
    assert 0.1 < beyond < 99.9 and f"{beyond:.1f} %" in model.metrics["hellinger"].note


def test_windows_of_a_clip_are_told_apart_as_often_as_those_of_the_set(model):
    """Each recording has as many clips: the set's share is the mean of the clips' shares."""
    shares = [clip.metrics["one_nn"] for clip in model.clips]
    assert 0.5 < np.mean(shares) == pytest.approx(values(model)["one_nn"], abs=0.02)
