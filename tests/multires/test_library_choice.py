"""Choice of the parts of a long corpus that a model can recall."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gesturekit.multires import PairedSequence, load_training_data
from gesturekit.multires.training.library_choice import chosen_parts

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
    return run


def swinging(width: int, seconds: float, size: float, seed: int, pose: float = 0.0) -> torch.Tensor:
    """Return motion (D, T) about a pose, all channels of one size."""
    rng = torch.Generator().manual_seed(seed)
    n = round(seconds * FPS)
    steps = torch.randn(width, n, generator=rng)
    smooth = torch.nn.functional.avg_pool1d(steps[None], 9, 1, 4)[0]
    return pose + size * smooth / smooth.std()


SIZES = np.linspace(0.5, 2.0, 8)


@pytest.mark.parametrize(
    ("poses", "other", "expected"),
    [
        ((0, 0, 0, 9, 0, 0, 0, 0), 0, {0, 3}),
        ((0, 0, 0, 9, 0, 0, 0, 0), 1, {1, 3}),
        ((0, 9, 18, 27, 0, 0, 0, 0), 0, set()),
    ],
)
def test_parts_differ_in_movement_pose_and_take(choose, poses, other, expected):
    """Half of eight recordings of half a minute: one of each two that move alike; of these the one
    in another pose goes before, and the one of another take."""
    takes = ["b" if k == other else "a" for k in range(8)]
    recordings = [
        (swinging(choose.width, 30, size, 5, pose), "ann")
        for size, pose in zip(SIZES, poses, strict=True)
    ]
    found = choose(recordings, 2.0, takes)
    assert [number // 2 for number, _, _ in found] == [0, 1, 2, 3]
    assert expected <= {number for number, _, _ in found}
    assert all((start, stop) == (0, 30 * FPS) for _, start, stop in found)


@pytest.mark.parametrize(("minutes", "n_parts"), [(2.0, 8), (1.0, 4)])
def test_speakers_share_a_library_of_the_length_that_was_asked_for(choose, minutes, n_parts):
    recordings = [
        (swinging(choose.width, 30, size, k), "ann" if k % 2 else "bob")
        for k, size in enumerate(SIZES)
    ]
    found = choose(recordings, minutes)
    frames = [
        sum(stop - start for number, start, stop in found if number % 2 == own) for own in (0, 1)
    ]
    assert frames == pytest.approx([minutes * 30 * FPS] * 2, abs=n_parts)
    assert list(found) == sorted(found)
    assert choose(recordings, 4.0) is None, "all of them fit"
