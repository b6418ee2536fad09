"""Noise from pieces of z*: what it is made of, and that models draw it as they were trained."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import gesturekit as gk
from gesturekit.multires.sampling.noise import Recall
from gesturekit.multires.training.trainer import train


def pieces_of(noise: torch.Tensor) -> list[torch.Tensor]:
    """Noise that counts up within a piece, cut where it does not."""
    row = noise[0, 0]
    cuts = torch.nonzero(row.diff() != 1)[:, 0] + 1
    return list(torch.tensor_split(row, cuts))


def test_every_frame_comes_up_once_before_any_comes_again():
    noise = Recall([torch.arange(100.0), 200 + torch.arange(50.0)], [0, 0], 7)
    drawn = noise([0] * 150, torch.Generator().manual_seed(1))
    assert drawn.shape == (1, 1, 150)
    expected = [*range(100), *range(200, 250)]
    assert sorted(drawn[0, 0].int().tolist()) == expected
    assert drawn[0, 0].int().tolist() != expected
    assert max(map(len, pieces_of(drawn))) <= 2 * 7
    again = noise([0] * 300, torch.Generator().manual_seed(1))
    np.testing.assert_array_equal(again[..., :150], drawn)
    second = again[0, 0, 150:]
    assert sorted(second.int().tolist()) == expected
    assert not torch.equal(second, drawn[0, 0]), "cut and laid out anew"


def test_pieces_are_of_the_style_asked_for():
    noise = Recall([torch.zeros(30), torch.ones(30), torch.ones(30)], [0, 1, 1], 5)
    drawn = noise([1] * 40 + [0] * 40, torch.Generator().manual_seed(2))[0, 0]
    assert (drawn[:40] == 1).all()
    assert (drawn[45:] == 0).all(), "a piece that was begun is finished"
    channels = Recall([torch.zeros(6, 30)], [0], 5)([0] * 12, torch.Generator())
    assert channels.shape == (1, 6, 12)


@pytest.mark.parametrize("styles", [None, {}], ids=["single", "labels"])
def test_a_model_recalls_as_it_was_trained(styles, make_config, motions):
    corpus = motions(none=[4.0]) if styles is None else motions(old=[4.0, 3.0], angry=[4.0])
    changes = {"features": None, "training": {"window": None}, "styles": styles}
    config = make_config(corpus=str(corpus), z_star_shuffle=4, eval_every=2, **changes)
    model = gk.load(train(config))
    assert model.z_star_shuffle == 4
    made = model.generate(seconds=5.0, seed=1)
    again = gk.load(config.out / "model").generate(seconds=5.0, seed=1)
    np.testing.assert_array_equal(made.rotations, again.rotations)
    model.z_star_shuffle = 0
    assert np.abs(model.generate(seconds=5.0, seed=1).rotations - made.rotations).max() > 1e-4
