"""Noise from z* patches: its parts, and models that draw it as in training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import gesturekit as gk
from gesturekit.multires.sampling.trained_model import ZStarPatches
from gesturekit.multires.training.trainer import train


def test_every_frame_comes_up_once_before_any_comes_again():
    noise = ZStarPatches([torch.arange(100.0), 200 + torch.arange(50.0)], [0, 0], 7)
    drawn = noise.draw([0] * 150, torch.Generator().manual_seed(1))
    assert drawn.shape == (1, 1, 150)
    expected = [*range(100), *range(200, 250)]
    assert sorted(drawn[0, 0].int().tolist()) == expected
    assert drawn[0, 0].int().tolist() != expected
    # Within a patch, frames count up.
    cuts = torch.nonzero(drawn[0, 0].diff() != 1)[:, 0] + 1
    assert max(map(len, torch.tensor_split(drawn[0, 0], cuts))) <= 2 * 7
    again = noise.draw([0] * 300, torch.Generator().manual_seed(1))
    np.testing.assert_array_equal(again[..., :150], drawn)
    second = again[0, 0, 150:]
    assert sorted(second.int().tolist()) == expected
    assert not torch.equal(second, drawn[0, 0]), "cut and shuffled again"


def test_patches_have_the_style_of_their_first_frame():
    noise = ZStarPatches([torch.zeros(30), torch.ones(30), torch.ones(30)], [0, 1, 1], 5)
    drawn = noise.draw([1] * 40 + [0] * 40, torch.Generator().manual_seed(2))[0, 0]
    assert (drawn[:40] == 1).all()
    assert (drawn[45:] == 0).all(), "a patch is not cut off"
    channels = ZStarPatches([torch.zeros(6, 30)], [0], 5).draw([0] * 12, torch.Generator())
    assert channels.shape == (1, 6, 12)


@pytest.mark.parametrize("styles", [None, {}], ids=["single", "labels"])
def test_a_model_shuffles_z_star_as_in_training(styles, make_config, motions):
    corpus = motions(none=[4.0]) if styles is None else motions(old=[4.0, 3.0], angry=[4.0])
    changes = {"features": None, "training": {"window": None}, "styles": styles}
    config = make_config(corpus=str(corpus), z_star_shuffle=4, eval_every=2, **changes)
    model = gk.load(train(config))
    assert model.noise.z_star_shuffle == 4
    made = model.generate(seconds=5.0, seed=1)
    again = gk.load(config.out / "model").generate(seconds=5.0, seed=1)
    np.testing.assert_array_equal(made.rotations, again.rotations)
    plain = replace(model, noise=replace(model.noise, z_star_shuffle=0))
    assert np.abs(plain.generate(seconds=5.0, seed=1).rotations - made.rotations).max() > 1e-4
