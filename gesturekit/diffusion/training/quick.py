"""Motion vectors in a few denoising steps, for measurements during training."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.network import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule, sample
from gesturekit.diffusion.sampling.experts import Expert

STEPS = 10
"""Number of denoising steps."""


@torch.no_grad()
def quick_vectors(
    network: Denoiser, schedule: NoiseSchedule, condition: np.ndarray, rng: torch.Generator
) -> Tensor:
    """Return normalised motion vectors (T, X) that a network makes of a condition (T, C)."""
    device = next(network.parameters()).device
    expert = Expert(network, schedule, torch.from_numpy(condition)[None].to(device), np.ones(1))
    noise = torch.randn((1, len(condition), network.n_motion), generator=rng).to(device)
    steps = min(STEPS, schedule.steps)
    return sample(expert.predict, partial(_same, noise), schedule, solver="dpm", steps=steps)[0]


def _same(noise: Tensor, _: int) -> Tensor:
    return noise
