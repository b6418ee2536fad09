"""Ablations that a line of a configuration makes."""

import json
from dataclasses import replace

import pytest
import torch
from small_runs import small_config

import gesturekit as gk
from gesturekit.multires import train
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.networks import LevelGenerator


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
    """Of four levels the first stage trains three, for 6 iterations, and the second one, for 4."""
    trained = [line["level"] for line in lines(training={"stage_levels": 3})]
    assert trained == [1] * 6 + [4] * 4


@pytest.mark.parametrize(("which", "has"), [("fine", False), ("all", True)])
def test_levels_that_are_smoothed(lines, which, has):
    """The first level has 0.42 of the full frame rate, the second 0.56."""
    made = lines(training={"stage_levels": 1}, losses={"smooth_levels": which})
    assert [line["level"] for line in made[::4]] == [1, 1, 2, 3, 4]
    assert [("smoothness" in line) for line in made[:6]] == [has] * 6
    assert all("smoothness" in line for line in made[6:])


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
