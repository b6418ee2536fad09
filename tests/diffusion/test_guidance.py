"""Products of experts obey their algebra."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from gesturekit.diffusion import Denoiser, NetworkConfig, NoiseConfig
from gesturekit.diffusion.experts import Expert, predicted_noise, product
from gesturekit.diffusion.noise_schedule import (
    MAX_DEVIATION,
    NoiseSchedule,
    clip_denoised,
    sample,
)
from gesturekit.errors import ModelError
from gesturekit.training.seeds import rng_for, seeded

FRAMES, MOTION, CONDITION = 40, 5, 3
CONFIG = NetworkConfig(blocks=2, layers=1, channels=16, heads=2, feedforward=32, embedding=16)
SCHEDULE = NoiseSchedule.of(NoiseConfig())


def network(seed: int, n_condition: int = CONDITION) -> Denoiser:
    def make() -> Denoiser:
        made = Denoiser(MOTION, n_condition, CONFIG)
        torch.nn.init.normal_(made.leave.weight)  # which is zero before training
        return made.eval()

    return seeded(("network", seed), make)


def noise(*keys: int | str, width: int = MOTION) -> torch.Tensor:
    return torch.randn(1, FRAMES, width, generator=rng_for("noise", *keys))


def expert(seed: int, condition: int = 0, schedule: NoiseSchedule = SCHEDULE) -> Expert:
    given = noise("conditional", condition, width=CONDITION)
    return Expert(network(seed), schedule, given, np.ones(1))


def mixed(experts: Sequence[Expert], weights: Sequence, step: int) -> torch.Tensor:
    terms = [e.weighted(np.atleast_1d(w)) for e, w in zip(experts, weights, strict=True)]
    return predicted_noise(product(terms), noise(), step)


@pytest.mark.parametrize("weights", [(0.5, 0.5, 0), (1.5, 0, -0.5), (-0.25, 1.0, 0.25)])
def test_experts_give_the_weighted_sum_of_what_their_networks_predict(weights):
    """The released code, adding in place, gives the second of three weights g1 (1 - g2)."""
    narrow = Expert(network(3, n_condition=1), SCHEDULE, noise("narrow", width=1), np.ones(1))
    experts = [expert(1), expert(2, condition=1), narrow]
    predicted = [e.network(noise(), e.condition, torch.tensor([30])).detach() for e in experts]
    expected = np.tensordot(weights, torch.stack(predicted).numpy(), 1)
    np.testing.assert_allclose(mixed(experts, weights, 30).numpy(), expected, atol=1e-5)


def test_experts_that_are_alike_are_the_single_model_to_the_last_bit():
    alone = expert(1)
    alike = [expert(1), expert(1), alone]  # other objects, the same weights and conditions
    for weights in [(1 / 3, 1 / 3, 1 / 3), (-4.0, 7.0, -2.0)]:
        assert torch.equal(mixed(alike, weights, 12), alone.predict(noise(), 12))
    varying = np.linspace(-1, 2, FRAMES)
    weights = [varying, 1 - varying]
    assert torch.equal(mixed(alike[:2], weights, 12), alone.predict(noise(), 12))


def test_an_expert_without_weight_is_not_run():
    broken = expert(2)
    torch.nn.init.constant_(broken.network.leave.bias, float("nan"))
    assert torch.equal(mixed([expert(1), broken], [1, 0], 5), expert(1).predict(noise(), 5))


def test_noise_and_velocity_networks_mix_as_noise():
    velocity = NoiseSchedule.of(NoiseConfig(predict="velocity"))
    experts = [expert(1), expert(2, schedule=velocity)]
    signal, spread = SCHEDULE.scales(10, noise())
    second = experts[1].network(noise(), experts[1].condition, torch.tensor([10])).detach()
    expected = 0.5 * experts[0].predict(noise(), 10) + 0.5 * (spread * noise() + signal * second)
    torch.testing.assert_close(mixed(experts, [0.5, 0.5], 10), expected)


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


def test_weights_that_do_not_add_up_are_refused():
    with pytest.raises(ModelError, match=r"(?=.*0\.5)(?=.*0\.25)(?=.*0\.75)"):
        mixed([expert(1), expert(2)], [0.5, 0.25], 5)
