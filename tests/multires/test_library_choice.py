"""Choice of the parts of a long corpus that a model can recall."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from gesturekit.multires.training.library_choice import chosen_parts
from gesturekit.multires.training.loading import load_training_data
from gesturekit.multires.training.sequences import PairedSequence

FPS = 25


@pytest.fixture
def choose(make_config):
    """choose(recordings, minutes=2): the parts of recordings, each (motion (D, T), speaker)."""
    config = make_config(recall={"level": 4})
    data = load_training_data(config)

    def run(recordings, minutes=2.0, takes=None):
        paired = []
        for i, (motion, speaker) in enumerate(recordings):
            speech = torch.zeros(data.n_speech, motion.shape[1])
            own = PairedSequence.make(f"r{i}", motion, speech, 6, 0, sigma=torch.ones(6))
            paired.append(replace(own, speaker=speaker, take=takes[i] if takes else f"r{i}"))
        recall = replace(config.recall, minutes=minutes)
        return chosen_parts(replace(data, paired=tuple(paired)), replace(config, recall=recall))

    run.width = data.representation.n_features
    columns = data.representation.joint_columns
    arms = [n for n in data.representation.joints if re.search("Shoulder|Arm|Hand", n)]
    run.arms = np.concatenate([np.arange(run.width)[columns(name)] for name in arms])
    return run


def swinging(width: int, seconds: float, size: float, seed: int, pose: float = 0.0) -> torch.Tensor:
    """Return motion (D, T) about a pose, all channels of one size."""
    rng = torch.Generator().manual_seed(seed)
    n = round(seconds * FPS)
    steps = torch.randn(width, n, generator=rng)
    smooth = torch.nn.functional.avg_pool1d(steps[None], 9, 1, 4)[0]
    return pose + size * smooth / smooth.std()


def seconds_of(parts, recordings, of) -> dict:
    """Return the seconds of the parts by what `of` returns for the index of a recording."""
    found: dict = {}
    for i, start, stop in parts:
        assert 0 <= start < stop <= recordings[i][0].shape[1]
        found[of(i)] = found.get(of(i), 0.0) + (stop - start) / FPS
    return found


def test_a_corpus_that_fits_is_recalled_whole(choose):
    assert choose([(swinging(choose.width, 60, 1.0, 0), None)], minutes=1.0) is None


@pytest.mark.parametrize("length", [9.0, 45.0, 400.0])
def test_a_library_is_as_long_as_it_may_be_and_no_longer(choose, length):
    recordings = [(swinging(choose.width, length, 1.0, i), None) for i in range(int(800 / length))]
    parts = choose(recordings, minutes=3.0)
    total = sum(seconds_of(parts, recordings, lambda i: i).values())
    assert 160 <= total <= 180
    assert len(set(parts)) == len(parts)
    assert parts == choose(recordings, minutes=3.0)


@pytest.mark.parametrize("calm", [0.0, 0.5])
def test_calm_and_lively_recordings_have_their_shares(choose, calm):
    """A third of the corpus is lively, and so is a third of the library."""
    recordings = [
        (swinging(choose.width, 40, 3.0 if i % 3 == 0 else calm, i), None) for i in range(18)
    ]
    found = seconds_of(choose(recordings, 4.0), recordings, lambda i: i % 3 == 0)
    assert found[True] / (found[True] + found[False]) == pytest.approx(1 / 3, abs=0.07)


@pytest.mark.parametrize("minutes", [6.0, 1.0])
def test_each_speaker_has_a_share_and_a_few_seconds_at_least(choose, minutes):
    speakers = ["ann"] * 12 + ["bob"] * 6 + ["cid"]
    recordings = [
        (swinging(choose.width, 40 if who != "cid" else 12, 1.0, i), who)
        for i, who in enumerate(speakers)
    ]
    found = seconds_of(choose(recordings, minutes), recordings, lambda i: speakers[i])
    assert set(found) == {"ann", "bob", "cid"}
    assert found["ann"] / found["bob"] == pytest.approx(2.0, rel=0.35)


def test_takes_are_spread(choose):
    recordings = [(swinging(choose.width, 300, 1.0, i), None) for i in range(5)]
    found = seconds_of(choose(recordings, 4.0), recordings, lambda i: i)
    assert set(found) == set(range(5))


def test_a_rare_pose_is_recalled_beside_usual_ones(choose):
    """One recording in twenty is in another pose; as many at random would miss it mostly."""
    recordings = [
        (swinging(choose.width, 30, 1.0, i, 6.0 if i == 7 else 0.0), None) for i in range(20)
    ]
    hits = [i for i, _, _ in choose(recordings, 2.0)]
    assert 7 in hits and len(hits) <= 5
    assert np.bincount(hits).max() == 1


def greedy(movement, poses, takes, count: int) -> list[int]:
    """Choose parts one after another, as the module says, by loops over all parts."""
    levels = np.array_split(sorted(range(len(movement)), key=lambda k: movement[k]), count)
    level_of = {int(k): number for number, own in enumerate(levels) for k in own}
    apart = np.linalg.norm(poses[:, None] - poses[None], axis=-1)
    chosen, nearest = [], np.full(len(poses), apart.max())
    for _ in range(count):
        best, gain_of_best = -1, -1.0
        for k in range(len(poses)):
            gain = np.maximum(nearest - apart[k], 0).sum()
            gain *= 0.5 if takes[k] in {takes[other] for other in chosen} else 1.0
            if level_of[k] not in {level_of[other] for other in chosen} and gain > gain_of_best:
                best, gain_of_best = k, gain
        chosen.append(best)
        nearest = np.minimum(nearest, apart[best])
    return chosen


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("minutes", "seconds"), [(2.4, 30.0), (0.5, 15.0), (0.15, 6.0)])
def test_parts_are_chosen_by_greedy_facility_location(choose, minutes, seconds, seed):
    """Two speakers share the library: parts are half of it, from 6 to 30 seconds.

    At five frames a second, movement is the mean square of the arms' steps, and a pose the means
    and standard deviations of their channels.
    """
    rng = np.random.default_rng(seed)
    lengths, speakers = (70, 41, 90, 55, 64, 33), ("ann", "bob", "ann", "ann", "bob", "bob")
    takes = [f"take {k}" for k in rng.integers(3, size=6)]
    recordings = []
    for k, (length, who) in enumerate(zip(lengths, speakers, strict=True)):
        motion = swinging(choose.width, length, float(rng.uniform(0.5, 2)), 10 * seed + k)
        slow = np.interp(np.arange(motion.shape[1]), np.arange(0, 2500, 100), rng.normal(size=25))
        recordings.append((motion + torch.from_numpy(slow), who))
    found = choose(recordings, minutes, takes)
    wanted, total = round(60 * minutes * FPS), sum(lengths) * FPS
    expected = []
    for who in ("ann", "bob"):
        cuts = []
        for k, (motion, own) in enumerate(recordings):
            n = motion.shape[1] if own == who else 0
            edges = np.rint(np.linspace(0, n, max(1, round(n / (seconds * FPS))) + 1)).astype(int)
            cuts += [(k, a, b) for a, b in zip(edges, edges[1:], strict=False) if n]
        curves = [recordings[k][0][choose.arms, a:b:5].numpy() for k, a, b in cuts]
        movement = [np.square(np.diff(own)).mean() for own in curves]
        poses = np.stack([np.r_[own.mean(axis=1), own.std(axis=1)] for own in curves])
        frames = np.array([b - a for _, a, b in cuts])
        count = max(1, round(wanted * frames.sum() / total / frames.mean()))
        best = greedy(movement, poses, [takes[k] for k, _, _ in cuts], count)
        expected += [cuts[k] for k in best]
    share = min(1.0, wanted / sum(b - a for _, a, b in expected))
    assert len(expected) > 1
    assert list(found) == [(k, a, a + int(share * (b - a))) for k, a, b in sorted(expected)]
