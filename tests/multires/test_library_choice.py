"""Choice of the parts of a long corpus that a model can recall."""

import re
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


@pytest.mark.parametrize("seed", range(2))
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
    assert len(expected) > 1 and choose(recordings, sum(lengths) / 60, takes) is None
    assert list(found) == [(k, a, a + int(share * (b - a))) for k, a, b in sorted(expected)]
