"""Memory of an evaluation does not grow with the corpus: motion of large sets is sampled."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from gesturekit.cli.fit_features import command as fit_features
from gesturekit.evaluation import evaluate
from gesturekit.evaluation.measuring import clips, samples
from gesturekit.evaluation.measuring.samples import MotionSample
from gesturekit.evaluation.metrics import rhythm
from gesturekit.evaluation.metrics.physical import MARGIN, JointLimits, LimitsFit, joint_limit_share
from gesturekit.motion import Motion, Skeleton

RIG = Skeleton(("hips",), (-1,), [[0, 1, 0]])


def numbered(seconds: float, start: float = 0.0) -> Motion:
    """Return a motion at 10 fps whose height is the time in the whole set."""
    n = round(10 * seconds)
    path = np.zeros((n, 3))
    path[:, 1] = start + np.arange(n) / 10
    return Motion(RIG, np.tile([0.0, 0, 0, 1], (n, 1, 1)), path, 10)


def sample_of(count: int, seed: int = 0, most: int = 400_000) -> MotionSample:
    sample = MotionSample(seed, most)
    for k in range(count):
        sample.add(numbered(60.0, 60.0 * k))
    return sample


def test_a_small_set_is_kept_as_it_is():
    motions = [numbered(seconds) for seconds in (3.0, 60.0, 0.2)]
    sample = MotionSample(0)
    for motion in motions:
        sample.add(motion)
    assert sample.is_whole and sample.owners == [0, 1, 2]
    assert all(kept is motion for kept, motion in zip(sample.motions, motions, strict=True))


@pytest.mark.parametrize("count", [30, 300])
def test_memory_does_not_grow_with_the_set(count):
    sample = sample_of(count)
    arrays = [motion.rotations for motion in sample.motions]
    # A slice would keep its whole motion in memory.
    held = sum((a if a.base is None else a.base).nbytes for a in arrays)
    assert 100_000 < held <= 400_000 and not sample.is_whole
    assert sample.count == count and sample.seconds == pytest.approx(60.0 * count)
    assert all(motion.duration >= samples.PIECE_SECONDS for motion in sample.motions)


def test_a_clip_as_short_as_a_piece_is_never_cut():
    sample = MotionSample(0, 100_000)
    for _ in range(200):
        sample.add(numbered(1.5 * samples.PIECE_SECONDS))
    assert not sample.is_whole and len(sample.motions) > 9
    assert {motion.duration for motion in sample.motions} == {1.5 * samples.PIECE_SECONDS}


def test_all_parts_of_a_set_are_drawn_equally_often():
    means, shares = [], np.zeros(6)
    for seed in range(40):
        sample = sample_of(200, seed)
        heights = np.array([motion.translation[:, 1].mean() for motion in sample.motions])
        means.append(heights.mean() / (200 * 60.0))
        shares += np.bincount((heights % 60.0 // 10.0).astype(int), minlength=6) / len(heights)
        assert len(set(sample.owners)) > 0.5 * len(sample.owners)
    # The mean of n uniform numbers is 1/2, with an error of 0.29 / sqrt(n).
    error = 0.29 / np.sqrt(len(heights))
    assert np.mean(means) == pytest.approx(0.5, abs=3 * error / np.sqrt(40))
    assert np.std(means) < 1.5 * error
    assert shares / 40 == pytest.approx(np.full(6, 1 / 6), abs=0.02)


def test_samples_of_clips_and_recordings_have_the_same_pieces():
    one, other = sample_of(100), sample_of(100)
    assert one.owners == other.owners
    for a, b in zip(one.motions, other.motions, strict=True):
        assert np.array_equal(a.translation, b.translation)
    assert sample_of(100, seed=1).owners != one.owners


def test_sampled_metrics_are_close_to_those_of_the_whole_set(gesture, tmp_path, monkeypatch):
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "cache"))
    for k in range(12):
        gesture(20.0, 25.0, seed=k).save(tmp_path / "recordings" / f"{k}.npz")
        gesture(20.0, 25.0, seed=50 + k).save(tmp_path / "made" / f"{k}.npz")
    (whole,) = evaluate(tmp_path / "made", tmp_path / "recordings").models
    size = Motion.load(tmp_path / "made" / "0.npz").rotations.nbytes
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "another"))
    monkeypatch.setattr(MotionSample.__init__, "__defaults__", (8 * size,))
    (sampled,) = evaluate(tmp_path / "made", tmp_path / "recordings").models
    assert sampled.metrics.keys() == whole.metrics.keys()
    for key in ("one_nn", "within_reach", "forward", "copying"):
        value, expected = (m.metrics[key].interval.value for m in (sampled, whole))
        assert value == pytest.approx(expected, rel=0.35), key
    for key in ("hand_q50", "reach", "calm_lively_r", "hellinger"):  # not sampled
        assert sampled.metrics[key].interval == whole.metrics[key].interval, key


def test_recent_files_are_kept_up_to_a_number_of_bytes():
    loaded = []
    cache = clips.ByteCache(250, len)

    def get(key: str, size: int = 100) -> None:
        cache.get(key, lambda: (loaded.append(key), bytes(size))[1])

    for key in "aabacab":
        get(key)
    assert loaded == ["a", "b", "c", "b"]
    get("huge", 300)
    get("huge", 300)
    assert loaded[4:] == ["huge", "huge"]


def test_joint_limits_of_many_recordings_are_those_of_all(monkeypatch):
    rng = np.random.default_rng(0)
    motions = []
    for _ in range(8):
        turns = np.tile([0.0, 0, 0, 1], (50, 1, 1)) + 0.2 * rng.standard_normal((50, 1, 4))
        turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
        motions.append(Motion(RIG, turns, np.zeros((50, 3)), 30))
    whole = JointLimits.fit(motions, ["hips"])
    monkeypatch.setattr("gesturekit.evaluation.metrics.physical.MEAN_FRAMES", 120)
    fit = LimitsFit()
    for motion in motions:
        fit.add(motion, ["hips"])
        assert sum(map(len, fit._waiting)) <= 120
    first = JointLimits.fit(motions[:3], ["hips"])
    found = fit.result()
    assert np.array_equal(found.mean, first.mean)
    # The smallest limits, less their margin, that no frame of any recording exceeds.
    tight = replace(found, low=found.low + MARGIN + 1e-9, high=found.high - MARGIN - 1e-9)
    loose = replace(found, low=found.low + MARGIN - 1e-9, high=found.high - MARGIN + 1e-9)
    assert not any(joint_limit_share(motion, loose) for motion in motions)
    assert sum(joint_limit_share(motion, tight) for motion in motions) > 0
    assert found.low == pytest.approx(whole.low, abs=0.1)


def test_fit_features_takes_a_sample_of_a_large_set(gesture, tmp_path, monkeypatch):
    for k in range(4):
        gesture(20.0, 30.0, seed=k).save(tmp_path / "recordings" / f"{k}.npz")
    arguments = [str(tmp_path / "recordings"), "--steps", "1", "--out"]
    whole = CliRunner().invoke(fit_features, [*arguments, str(tmp_path / "whole")])
    assert "random" not in whole.output
    size = Motion.load(tmp_path / "recordings" / "0.npz").rotations.nbytes
    monkeypatch.setattr(MotionSample.__init__, "__defaults__", (2 * size,))
    sampled = CliRunner().invoke(fit_features, [*arguments, str(tmp_path / "sampled")])
    assert "Fitted on a random" in sampled.output


def test_the_chance_level_of_an_hour_takes_some_of_the_shifts(monkeypatch):
    rng = np.random.default_rng(0)
    beats, pulse = np.sort(rng.uniform(0, 400, (2, 700)))
    tracemalloc.start()
    found = rhythm.alignment(beats, pulse, 400.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60_000_000
    monkeypatch.setattr(rhythm, "MOST_SHIFTS", 10_000)
    whole = rhythm.alignment(beats, pulse, 400.0)
    assert found.score == whole.score
    assert found.chance_mean == pytest.approx(whole.chance_mean, abs=0.1 * whole.chance_sd)
    assert found.chance_sd == pytest.approx(whole.chance_sd, rel=0.1)
    assert found.chance_mean != whole.chance_mean
