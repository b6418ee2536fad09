"""Small denoisers and models of random weights, whose every part shows in what they make."""

from collections.abc import Callable

import pytest
import torch
from small_runs import small_diffusion

from gesturekit.diffusion import (
    Conditions,
    DeltaRepresentation,
    Denoiser,
    DiffusionConfig,
    DiffusionModel,
    NetworkConfig,
    NoiseConfig,
    Normaliser,
)
from gesturekit.training.seeds import rng_for, seeded

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
            rng = rng_for("shaken", name)
            if name.endswith("bias.amplitudes"):
                value.data = torch.randn(value.shape, generator=rng) * 3
            elif name.endswith(("bias.widths", "bias.floors")):
                value.data *= 0.2 + torch.rand(value.shape, generator=rng)
        return network

    return make


NEAR = {"dilations": (0, 1), "nearest_view": 3, "farthest_view": 15}
TINY = NetworkConfig(blocks=2, layers=1, channels=16, heads=2, feedforward=24, embedding=16, **NEAR)


@pytest.fixture(scope="session")
def untrained(gesture) -> Callable[..., DiffusionModel]:
    """`untrained(seed=0, styles=..., ...)`: a model of random weights that stays within bounds.

    It predicts velocity: all but none of it, and standard normal noise stays what it is.
    """
    motions = [gesture(2.0, seed=seed) for seed in range(2)]
    ways = {True: DeltaRepresentation.fit(motions)}
    ways[False] = DeltaRepresentation.fit(motions, root=False)

    def make(seed: int = 0, *, droppable: tuple[str, ...] = (), **told) -> DiffusionModel:
        conditions = Conditions(**told)
        representation = ways[not conditions.path]
        width = representation.n_features
        network = seeded(("untrained", seed), lambda: Denoiser(width, conditions.width, TINY))
        torch.nn.init.normal_(network.leave.weight, std=0.5, generator=rng_for("leave", seed))
        normaliser = Normaliser.fit([representation.encode(motion) for motion in motions])
        learnt = {"representation": representation, "normaliser": normaliser, "network": network}
        told = {"conditions": conditions, "droppable": droppable, "speakers": {}}
        noise = NoiseConfig(predict="velocity")
        return DiffusionModel(fps=30.0, recorded_fps=30.0, noise_config=noise, **learnt, **told)

    return make


@pytest.fixture
def make_config(quick_corpus, tmp_path) -> Callable[..., DiffusionConfig]:
    """make_config(training={"batch": 1}, ...): a run of a second, with changes."""
    return lambda **changes: small_diffusion(quick_corpus, tmp_path / "run", changes)
