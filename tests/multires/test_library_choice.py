"""Choice of the parts of a long corpus that a model can recall."""

from __future__ import annotations

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

    def run(recordings, minutes=2.0):
        paired = []
        for i, (motion, speaker) in enumerate(recordings):
            speech = torch.zeros(data.n_speech, motion.shape[1])
            own = PairedSequence.make(f"r{i}", motion, speech, 6, 0, sigma=torch.ones(6))
            paired.append(replace(own, speaker=speaker, take=f"r{i}"))
        recall = replace(config.recall, minutes=minutes)
        return chosen_parts(replace(data, paired=tuple(paired)), replace(config, recall=recall))

    run.width = data.representation.n_features
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
