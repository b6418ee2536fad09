"""Sampling in pieces: no seam, any length, bounded memory."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import audio_features as af
import gesturekit as gk
from gesturekit.evaluation import arm_speed
from gesturekit.multires import MultiresGenerator, MultiresRepresentation, NetworkConfig
from gesturekit.multires.backend import VARIABLE
from gesturekit.multires.pyramid import LevelConditions, condition_levels, sample

LEVELS, FEATURES = 4, 3


@pytest.fixture(scope="module")
def network(gesture) -> MultiresGenerator:
    """A pyramid that listens."""
    torch.manual_seed(0)
    config = NetworkConfig(levels=LEVELS, channels=(3, 2), embedding=4)
    network = MultiresGenerator(MultiresRepresentation.fit([gesture(1.0)]), FEATURES, config)
    for level in network.levels:
        for film in level.films:
            torch.nn.init.normal_(film.gain.weight, std=0.3)
            torch.nn.init.normal_(film.shift.weight, std=0.3)
    return network.eval()


def draw(n_frames: int, seed: int) -> tuple[np.ndarray, list[int], list[torch.Tensor | None]]:
    """Speech (T, S), lengths, and noise at the first and the last level."""
    rng = np.random.default_rng(seed)
    lengths = af.level_lengths(n_frames, LEVELS)
    noises: list[torch.Tensor | None] = [None] * LEVELS
    for level in (0, LEVELS - 1):
        noises[level] = torch.from_numpy(rng.normal(size=(1, 1, lengths[level]))).float()
    return rng.normal(size=(n_frames, FEATURES)).astype(np.float32), lengths, noises


@settings(max_examples=12, deadline=None)
@given(
    n_frames=st.integers(1, 200),
    tile=st.integers(1, 120),
    residual=st.booleans(),
    listening=st.booleans(),
    backend=st.sampled_from(["numba", "torch"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_pieces_are_the_whole(network, n_frames, tile, residual, listening, backend, seed):
    speech, lengths, noises = draw(n_frames, seed)
    conditions = condition_levels(torch.from_numpy(speech.T.copy())[None], lengths, residual)
    # With gradients the layers run as in training: one dense convolution each.
    whole = network(noises, conditions if listening else None, lengths=lengths)[-1].detach()
    condition = LevelConditions([speech] * len(lengths), lengths, residual) if listening else None
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, backend)
        pieces = sample(network, noises, lengths, condition, tile=tile)
    assert pieces.shape == whole.shape
    torch.testing.assert_close(pieces, whole, rtol=0, atol=1e-5)


def test_changed_weights_take_effect(network):
    """Layers keep their weights as they are multiplied; new ones take their place."""
    _, lengths, noises = draw(50, 0)
    before = sample(network, noises, lengths, None)
    weight = network.levels[-1].layers[0].weight
    with torch.no_grad():
        weight.mul_(2)
    changed = sample(network, noises, lengths, None)
    with torch.no_grad():
        weight.div_(2)
    assert (changed - before).abs().max() > 1e-3
    assert torch.equal(sample(network, noises, lengths, None), before)


@pytest.mark.stress
def test_the_ends_move_as_the_middle_does():
    """Idle, where no speech makes one second differ from another."""
    model = gk.load("demo")
    ten = round(0.1 * model.fps)
    speeds = np.array([arm_speed(model.generate(seconds=4.0, seed=seed)) for seed in range(40)])
    middle = speeds[:, 10 * ten : -10 * ten].mean()
    for end in (speeds[:, 1 : 1 + 2 * ten], speeds[:, -2 * ten :]):
        assert 0.7 * middle < end.mean() < 1.25 * middle
