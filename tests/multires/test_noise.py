"""Noise from z* patches: its parts, and models that draw it as in training."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

import gesturekit as gk
from audio_features import level_lengths
from gesturekit.multires import train
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.pyramid import TrainedNoise, TrainedSequence, ZStarPatches
from gesturekit.multires.training.data import PairedSequence

FOUR = NetworkConfig(levels=4)


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


def test_patches_of_a_model_have_the_styles_of_its_recordings():
    stars = {"b": torch.ones(5), "a": torch.zeros(5)}
    noise = TrainedNoise(
        sigma=torch.tensor([[1.0, 2.0], [3.0, 6.0]]),
        z_star=stars,
        sequences={"a": TrainedSequence(8, "old"), "b": TrainedSequence(9, "angry")},
        z_star_shuffle=3,
        noise_levels=2,
    )
    found, single = noise.random(("angry", "old")), noise.random(())
    assert found.sigma.tolist() == [2.0, 4.0]
    assert found.levels == 2
    ordered = replace(noise, z_star=dict(sorted(stars.items()))).random(())
    first, second = (
        one.shuffled(None, [[0] * 8], torch.Generator().manual_seed(0)) for one in (single, ordered)
    )
    assert torch.equal(first, second), "recordings count in the order of their names"
    plain = replace(noise, z_star_shuffle=0).random(())
    gaussian = torch.randn(2, 1, 5)
    assert plain.patches is None and torch.equal(
        plain.shuffled(gaussian, [[0] * 5] * 2, None), gaussian
    )
    rng = torch.Generator().manual_seed(0)
    drawn = found.shuffled(gaussian, [[0] * 5, [1] * 5], rng)
    assert drawn[:, 0].tolist() == [[1.0] * 5, [0.0] * 5]
    made = plain.gaussian([4000, 9, 7], lambda _: rng, first=0, count=2)
    assert made[0].shape == (2, 1, 4000) and made[1].shape == (2, 1, 9) and made[2] is None
    assert float(made[0].std()) == pytest.approx(2.0, rel=0.05)
    (finer,) = plain.gaussian([4000], lambda _: rng, first=1)
    assert float(finer.std()) == pytest.approx(4.0, rel=0.05)


def test_a_model_shuffles_z_star_as_in_training(make_config, motions):
    corpus = motions(old=[3.0, 2.0], angry=[3.0])
    training = {"window": None, "first_stage": 2, "further_stages": 2}
    changes = {"features": None, "training": training, "styles": {}}
    config = make_config(corpus=str(corpus), z_star_shuffle=4, **changes)
    model = gk.load(train(config))
    assert model.noise.z_star_shuffle == 4
    made = model.generate(seconds=5.0, seed=1)
    again = gk.load(config.out / "model").generate(seconds=5.0, seed=1)
    np.testing.assert_array_equal(made.rotations, again.rotations)
    plain = replace(model, noise=replace(model.noise, z_star_shuffle=0))
    assert np.abs(plain.generate(seconds=5.0, seed=1).rotations - made.rotations).max() > 1e-4


def test_z_star_is_noise_of_the_first_level_for_all_channels_or_each():
    motion = 0.5 * torch.randn(6, 4000, generator=torch.Generator().manual_seed(0))
    make = partial(PairedSequence.make, "a", motion, torch.zeros(3, 4000), FOUR, 0)
    shared, full = make(), make(full_noise=True)
    n_coarsest = level_lengths(4000, 4)[0]
    assert shared.z_star.shape == (n_coarsest,) and full.z_star.shape == (6, n_coarsest)
    assert float(shared.z_star.std()) == pytest.approx(float(shared.sigma[0]), rel=0.05)
    assert float(full.z_star.std()) == pytest.approx(1.0, rel=0.05)
    assert torch.equal(make().z_star, shared.z_star)
    twice = PairedSequence.make("a", 2 * motion, torch.zeros(3, 4000), FOUR, 0)
    torch.testing.assert_close(twice.z_star, 2 * shared.z_star)
    other = PairedSequence.make("b", motion, torch.zeros(3, 4000), FOUR, 0)
    assert not torch.equal(other.z_star, shared.z_star)
    known = torch.tensor([2.0, 0.0, 0.0, 0.0])
    assert float(make(sigma=known).z_star.std()) == pytest.approx(2.0, rel=0.05)


def test_a_window_has_the_part_of_z_star_at_its_place():
    motion = torch.zeros(2, 400)
    sequence = PairedSequence.make("a", motion, motion, FOUR, 0, sigma=torch.ones(4))
    whole = sequence.z_star
    count = len(whole)
    assert torch.equal(sequence.z_star_window(0, count), whole[None])
    assert torch.equal(sequence.z_star_window(200, 30)[0], whole[count // 2 :][:30])
    assert torch.equal(sequence.z_star_window(399, 30)[0], whole[-30:]), "within the recording"
    part = sequence.cut(100, 180)
    assert (part.motion.shape, part.n_frames) == ((2, 80), 80)
    n_coarsest = level_lengths(80, 4)[0]
    assert torch.equal(part.z_star, whole[round(count / 4) :][:n_coarsest])
    assert sequence.passive.shape == (0, 400) and part.passive.shape == (0, 80)
    full = PairedSequence.make("a", motion, motion, FOUR, 0, full_noise=True)
    expected = full.z_star[:, round(count / 4) :][:, :n_coarsest]
    assert torch.equal(full.cut(100, 180).z_star, expected) and expected.shape[0] == 2
    reseeded = PairedSequence.make("a", motion, motion, FOUR, 1, full_noise=True)
    assert not torch.equal(full.z_star, reseeded.z_star)
