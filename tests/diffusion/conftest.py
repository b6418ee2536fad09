"""A small denoiser whose every part shows in its output."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from gesturekit.diffusion.config import NetworkConfig
from gesturekit.diffusion.networks import Denoiser
from gesturekit.training.seeds import generator

SMALL = NetworkConfig(blocks=3, layers=2, channels=32, heads=4, feedforward=48, embedding=24)


@pytest.fixture(scope="session")
def shaken() -> Callable[..., Denoiser]:
    """`shaken(config, n_motion, n_condition)`: a network in eval mode with no weight at zero.

    As it is made, its output is zero and its attention's bias hardly bends.
    """

    def make(config: NetworkConfig = SMALL, n_motion: int = 7, n_condition: int = 5) -> Denoiser:
        torch.manual_seed(0)
        network = Denoiser(n_motion, n_condition, config).eval()
        torch.nn.init.normal_(network.leave.weight, std=config.channels**-0.5)
        for name, value in network.named_parameters():
            rng = generator("shaken", name)
            if name.endswith("bias.amplitudes"):
                value.data = torch.randn(value.shape, generator=rng) * 3
            elif name.endswith(("bias.widths", "bias.floors")):
                value.data *= 0.2 + torch.rand(value.shape, generator=rng)
        return network

    return make
