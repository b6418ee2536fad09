"""Ablations that a line of a configuration makes."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_runs import small_config

import gesturekit as gk
from gesturekit.errors import ConfigError
from gesturekit.multires import MultiresGenerator, train
from gesturekit.multires.backend import VARIABLE
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.networks import LevelGenerator, modulated_blocks
from gesturekit.multires.pyramid import LevelConditions, sample


@pytest.fixture
def lines(quick_corpus, tmp_path):
    """Train with these changes; return the lines of metrics.jsonl on the losses of steps."""

    def run(**changes) -> list[dict]:
        folder = train(small_config(quick_corpus, tmp_path / "run", {"log_every": 1, **changes}))
        assert gk.load(folder).generate(seconds=1.0).n_frames == 30
        text = (tmp_path / "run" / "metrics.jsonl").read_text()
        return [line for line in map(json.loads, text.splitlines()) if "reconstruction" in line]

    return run


def test_levels_of_a_stage(lines):
    """The first stage trains three of four levels, for 6 iterations, the second one, for 4."""
    trained = [line["level"] for line in lines(training={"stage_levels": 3})]
    assert trained == [1] * 6 + [4] * 4


@pytest.mark.parametrize(("which", "has"), [("fine", False), ("all", True)])
def test_levels_that_are_smoothed(lines, which, has):
    """The first level has 0.42 of the full frame rate, the second 0.56."""
    made = lines(training={"stage_levels": 1}, losses={"smooth_levels": which})
    assert [line["level"] for line in made[::4]] == [1, 1, 2, 3, 4]
    assert [("smoothness" in line) for line in made[:6]] == [has] * 6
    assert all("smoothness" in line for line in made[6:])


def test_a_factor_between_levels(lines, tmp_path):
    """A run learns, and its model generates, with half the frames on each coarser level."""
    network = NetworkConfig(levels=4, factor=2.0)
    assert network.lengths(75) == [9, 19, 38, 75] and network.margin == 16
    made = lines(network={"factor": 2.0}, training={"window": 2.5})
    assert made[-1]["level"] == 3 and all(np.isfinite(line["reconstruction"]) for line in made)
    model = gk.load(tmp_path / "run" / "model")
    assert {star.shape[-1] for star in model.noise.z_star.values()} == {
        model.network_config.lengths(sequence.frames)[0]
        for sequence in model.noise.sequences.values()
    }
    assert model.generate(seconds=2.0, levels=1).fps == pytest.approx(model.fps / 8, rel=0.1)
    for factor, levels in ((1.1, 4), (4.0, 14)):  # 4^13 is 67 million, 4^14 over 100 million
        NetworkConfig(levels=levels, factor=factor)
    for factor, levels in ((1.09, 4), (4.5, 4), (4.0, 15)):
        with pytest.raises(ConfigError, match=f"{factor:g}"):
            NetworkConfig(levels=levels, factor=factor)


@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_concatenation_in_place_of_film(gesture, monkeypatch, backend):
    """The embedding is 5 further channels, which 3 numbers of each upper joint see in 5 frames."""
    monkeypatch.setenv(VARIABLE, backend)
    torch.manual_seed(0)
    representation = MultiresRepresentation.fit([gesture(1.0)])
    config = NetworkConfig(levels=2, channels=(3, 2), embedding=5)
    plain, joined = (
        MultiresGenerator(representation, 4, replace(config, film=film)).eval()
        for film in ("input", "concatenate")
    )
    upper = modulated_blocks(representation, config)
    first, usual = (network.levels[1].layers[0] for network in (joined, plain))
    assert first.shape == (usual.shape[0], representation.n_features + 5, 5)
    assert first.weight.numel() - usual.weight.numel() == 5 * 5 * 3 * int(upper.sum())
    assert not any("films" in name for name, _ in joined.named_parameters())
    lengths = config.lengths(40)
    noises = [torch.randn(1, 1, n) for n in lengths]
    speech = torch.randn(1, 4, 40)
    condition = LevelConditions([speech[0].T.numpy()] * 2, lengths, False)
    whole = joined(noises, [condition(i, 0, n) for i, n in enumerate(lengths)], lengths=lengths)[1]
    pieces = sample(joined, noises, lengths, condition, tile=7)
    torch.testing.assert_close(pieces, whole, atol=1e-5, rtol=1e-5)
    # The condition of frame 20 reaches the first layer's channels of the upper body there alone.
    given = torch.zeros(1, representation.n_features + 5, 40)
    given[:, -5:, 20] = 1.0
    changed = (first(given) - first(0 * given)).abs()[0].detach() > 1e-7
    assert changed.any(dim=1).tolist() == np.repeat(upper, 3).tolist()
    assert changed.any(dim=0).nonzero().flatten().tolist() == [18, 19, 20, 21, 22]


def test_a_run_with_concatenation_learns(lines, tmp_path):
    """Its folder has as many weights as its settings say, and its motion depends on the sound."""
    made = lines(network={"film": "concatenate"})
    assert all(np.isfinite(line["reconstruction"]) for line in made)
    model, rng = gk.load(tmp_path / "run" / "model"), np.random.default_rng(0)
    sounds = (np.zeros(16000), 0.3 * rng.standard_normal(16000))
    silent, loud = (model.generate(sound, 16000, raw=True) for sound in sounds)
    assert np.abs(silent.rotations - loud.rotations).max() > 1e-4


def test_a_generator_without_residual(gesture):
    """Layers of zero leave nothing but the coarser motion, or nothing at all."""
    representation = MultiresRepresentation.fit([gesture(1.0)])
    config = NetworkConfig(levels=2, channels=(2, 2), embedding=4)
    up, noise = torch.ones(1, representation.n_features, 8), torch.zeros(1, 1, 8)
    for residual, value in ((True, 1.0), (False, 0.0)):
        generator = LevelGenerator(representation, 0, replace(config, residual=residual))
        for parameter in generator.parameters():
            torch.nn.init.zeros_(parameter)
        assert (generator(up, noise, None) == value).all()
