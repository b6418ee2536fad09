"""Products of experts obey their algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gesturekit.diffusion.config import NetworkConfig, NoiseConfig
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule
from gesturekit.diffusion.sampling.experts import (
    MAX_DEVIATION,
    Expert,
    ProductOfExperts,
    clip_denoised,
)
from gesturekit.diffusion.sampling.solvers import sample
from gesturekit.errors import ModelError
from gesturekit.training.seeds import rng_for, seeded

FRAMES, MOTION, CONDITION = 40, 5, 3
CONFIG = NetworkConfig(blocks=2, layers=1, channels=16, heads=2, feedforward=32, embedding=16)
SCHEDULE = NoiseSchedule.of(NoiseConfig())


def network(seed: int, n_condition: int = CONDITION, n_motion: int = MOTION) -> Denoiser:
    def make() -> Denoiser:
        made = Denoiser(n_motion, n_condition, CONFIG)
        torch.nn.init.normal_(made.leave.weight)  # which is zero before training
        return made.eval()

    return seeded(("network", seed), make)


def noise(*keys: int | str, width: int = MOTION) -> torch.Tensor:
    return torch.randn(1, FRAMES, width, generator=rng_for("noise", *keys))


def expert(seed: int, told: int = 0, schedule: NoiseSchedule = SCHEDULE) -> Expert:
    return Expert(network(seed), schedule, noise("told", told, width=CONDITION))


@pytest.mark.parametrize("weights", [(1, 0), (0, 1), (0.5, 0.5), (-0.25, 1.25)])
def test_two_experts_give_the_weighted_sum_of_what_they_predict(weights):
    one, other = expert(1), expert(2)
    expected = sum(
        w * e.network(noise(), e.condition, torch.tensor([30]))
        for w, e in zip(weights, (one, other), strict=True)
    )
    found = ProductOfExperts([one, other], weights).predict(noise(), 30)
    np.testing.assert_allclose(found.numpy(), expected.detach().numpy(), atol=1e-5)


def test_three_experts_with_different_conditions():
    """The released code, adding in place, gives the second of three weights g1 (1 - g2)."""
    narrow = Expert(network(3, n_condition=1), SCHEDULE, noise("narrow", width=1))
    experts, weights = [expert(1), expert(2, told=1), narrow], [-0.25, 1.0, 0.25]
    expected = sum(w * e.predict(noise(), 7) for w, e in zip(weights, experts, strict=True))
    torch.testing.assert_close(ProductOfExperts(experts, weights).predict(noise(), 7), expected)


def test_experts_that_are_alike_are_the_single_model_to_the_last_bit():
    alone = expert(1)
    alike = [expert(1), expert(1), alone]  # other objects, the same weights and conditions
    for weights in [(1 / 3, 1 / 3, 1 / 3), (-4.0, 7.0, -2.0)]:
        mixed = ProductOfExperts(alike, weights)
        assert torch.equal(mixed.predict(noise(), 12), alone.predict(noise(), 12))
    varying = np.linspace(-1, 2, FRAMES)
    mixed = ProductOfExperts(alike[:2], [varying, 1 - varying])
    assert torch.equal(mixed.predict(noise(), 12), alone.predict(noise(), 12))


def test_equal_weights_with_other_dilations_are_another_expert():
    alone = expert(1)
    other = Denoiser(MOTION, CONDITION, replace(CONFIG, dilations=(0, 2))).eval()
    other.load_state_dict(alone.network.state_dict())
    mixed = ProductOfExperts([alone, Expert(other, SCHEDULE, alone.condition)], [0, 1])
    assert not torch.allclose(mixed.predict(noise(), 12), alone.predict(noise(), 12))


def test_equal_experts_that_are_not_merged_give_the_single_model():
    """As far as float32 goes: what one is told differs in the last digit."""
    alone = expert(1)
    nearly = Expert(alone.network, SCHEDULE, alone.condition * (1 + 1e-7))
    mixed = ProductOfExperts([alone, nearly], [-0.25, 1.25])
    assert len(mixed.experts) == 2
    apart = (mixed.predict(noise(), 12) - alone.predict(noise(), 12)).abs().max()
    assert apart <= 1e-6 * alone.predict(noise(), 12).abs().max()


def test_an_expert_without_weight_is_not_run():
    class Broken(Denoiser):
        def for_condition(self, *args):
            raise AssertionError("it was run")

    broken = Expert(Broken(MOTION, CONDITION, CONFIG).eval(), SCHEDULE, expert(1).condition)
    predicted = ProductOfExperts([expert(1), broken], [1, 0]).predict(noise(), 5)
    assert torch.equal(predicted, expert(1).predict(noise(), 5))
    late = np.repeat([0.0, 0.5], FRAMES // 2)
    first = ProductOfExperts([expert(1), broken], [1 - late, late]).part(0, FRAMES // 2)
    first.predict(noise()[:, : FRAMES // 2], 5)


def test_weights_over_time_are_static_ones_where_they_are_constant():
    experts = [expert(1), expert(2)]
    gamma = np.where(np.arange(FRAMES) < 20, 0.3, np.linspace(0.3, 1.4, FRAMES))
    varying = ProductOfExperts(experts, [1 - gamma, gamma]).predict(noise(), 9)
    static = ProductOfExperts(experts, [0.7, 0.3]).predict(noise(), 9)
    torch.testing.assert_close(varying[:, :20], static[:, :20], atol=1e-6, rtol=0)
    assert (varying[:, 21:] - static[:, 21:]).abs().max() > 1e-2


def test_an_expert_with_another_mean_predicts_the_same_as_alone():
    """From one noise, a model and the same one told of another mean make one motion, shifted."""
    shift = torch.linspace(-1, 1, MOTION)
    alone = expert(1)
    moved = Expert(alone.network, SCHEDULE, alone.condition, shift)
    for step in (0, 20, 60):
        signal, _ = SCHEDULE.scales(step, noise())
        expected = alone.predict(noise() + signal * shift, step)
        torch.testing.assert_close(moved.predict(noise(), step), expected)


def test_noise_and_velocity_networks_mix_as_noise():
    velocity = NoiseSchedule.of(NoiseConfig(predict="velocity"))
    experts = [expert(1), expert(2, schedule=velocity)]
    signal, spread = SCHEDULE.scales(10, noise())
    second = experts[1].network(noise(), experts[1].condition, torch.tensor([10])).detach()
    expected = 0.5 * experts[0].predict(noise(), 10) + 0.5 * (spread * noise() + signal * second)
    torch.testing.assert_close(ProductOfExperts(experts, [0.5, 0.5]).predict(noise(), 10), expected)


def test_clipping_bounds_the_errors_of_an_imperfect_network():
    """A network that tells nine tenths of the noise, and nothing of it in one number."""

    def tell(noisy: torch.Tensor, step: int) -> torch.Tensor:
        return noisy * torch.tensor([0.9, 0.9, 0.9, 0.9, 0.0])

    made = sample(clip_denoised(tell, SCHEDULE), noise, SCHEDULE)
    assert made.abs().max() <= MAX_DEVIATION + 1e-3
    assert sample(tell, noise, SCHEDULE).abs().max() > 1e6
    # What is within bounds stays as it is.
    right = clip_denoised(lambda noisy, step: noisy, SCHEDULE)(noise(), 3)
    torch.testing.assert_close(right, noise())


def test_experts_that_do_not_fit_are_refused():
    one, two = expert(1), expert(2)
    for weights, told in (
        ([0.5, 0.25], r"weights 0\.5, 0\.25 add up to 0\.75"),
        ([0.5, float("nan")], "add up to nan"),
        ([0.5, np.linspace(0.5, 1.0, FRAMES)], r"add up to 1\.5"),
        ([0.5, np.full(FRAMES - 1, 0.5)], "shape"),
        ([1.0], "2 experts and 1 weights"),
    ):
        with pytest.raises(ModelError, match=told):
            ProductOfExperts([one, two], weights)
    dance = NoiseSchedule.of(NoiseConfig(steps=150, first_beta=0.01, last_beta=0.7))
    wide = network(2, n_motion=MOTION + 1)
    for other, told in (
        (expert(2, schedule=dance), "noise schedules differ.*100 steps.*150 steps"),
        (Expert(wide, SCHEDULE, one.condition), "5 numbers a frame, another 6"),
        (Expert(two.network, SCHEDULE, two.condition[:, :-1]), "40 frames, another of 39"),
    ):
        with pytest.raises(ModelError, match=told):
            ProductOfExperts([one, other], [0.5, 0.5])
    # One beta apart, and by no more than float32 rounds.
    near = NoiseSchedule.of(NoiseConfig(last_beta=0.78 - 1e-4))
    with pytest.raises(ModelError, match="noise schedules differ"):
        ProductOfExperts([one, expert(2, schedule=near)], [0.5, 0.5])
    same = NoiseSchedule.of(NoiseConfig(last_beta=0.78 - 1e-7))
    ProductOfExperts([one, expert(2, schedule=same)], [0.5, 0.5])
    wrong = Expert(one.network, SCHEDULE, noise("wrong", width=CONDITION + 1))
    with pytest.raises(ModelError, match="4 numbers a frame.*3"):
        ProductOfExperts([wrong], [1]).predict(noise(), 0)
