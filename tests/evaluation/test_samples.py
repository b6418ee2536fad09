"""Memory of an evaluation does not grow with the corpus: motion of large sets is sampled."""

import tracemalloc

import numpy as np
import pytest

from gesturekit.evaluation.measuring.clips import MotionSample
from gesturekit.evaluation.metrics import rhythm
from gesturekit.motion import Motion, Skeleton

RIG = Skeleton(("hips",), (-1,), [[0, 1, 0]])


def numbered(seconds: float, start: float = 0.0) -> Motion:
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
    assert all(motion.duration > 5.0 for motion in sample.motions)


def test_all_parts_of_a_set_are_drawn_equally_often():
    means, shares = [], np.zeros(6)
    for seed in range(12):
        sample = sample_of(150, seed)
        heights = np.array([motion.translation[:, 1].mean() for motion in sample.motions])
        means.append(heights.mean() / (150 * 60.0))
        shares += np.bincount((heights % 60.0 // 10.0).astype(int), minlength=6) / len(heights)
        assert len(set(sample.owners)) > 0.5 * len(sample.owners)
    # The mean of n uniform numbers is 1/2, with an error of 0.29 / sqrt(n).
    error = 0.29 / np.sqrt(len(heights))
    assert np.mean(means) == pytest.approx(0.5, abs=3 * error / np.sqrt(12))
    assert np.std(means) < 2 * error
    assert shares / 12 == pytest.approx(np.full(6, 1 / 6), abs=0.05)


def test_the_chance_level_of_an_hour_takes_bounded_memory():
    rng = np.random.default_rng(0)
    beats, pulse = np.sort(rng.uniform(0, 400, (2, 700)))
    tracemalloc.start()
    found = rhythm.alignment(beats, pulse, 400.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60_000_000
    assert found.chance_sd > 0 and abs(found.z) < 4
