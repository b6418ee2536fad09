"""From noise to motion, in many steps as published or in few.

Every solver asks `predict(noisy, step)` for the noise in a noisy motion and takes all random
numbers from `noise_at(k)`. It does not matter what either is: one network, a mixture of experts,
windows of an hour.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from gesturekit.diffusion.sampling.noise_schedule import NoiseSchedule
from gesturekit.errors import ModelError

Predict = Callable[[Tensor, int], Tensor]
Solver = Literal["ancestral", "ddim", "dpm"]
SOLVERS: tuple[Solver, ...] = ("ancestral", "ddim", "dpm")

PURE_NOISE = 1e-5
"""Share of the clean motion's variance below which solvers with few steps do not begin."""


def last_audible(schedule: NoiseSchedule) -> int:
    """The last step that has any of the motion in it."""
    return int((schedule.alphas_bar > PURE_NOISE).sum()) - 1


def chosen_steps(schedule: NoiseSchedule, count: int | None, start: int | None = None) -> list[int]:
    """The steps that a solver visits, most noisy first.

    Args:
        schedule: of the network.
        count: how many; None for all.
        start: the first of them; None for the last of the schedule, or, where `count` leaves
            steps out, for the last that has any motion in it.

    Raises:
        ModelError: fewer than one step, more than there are, or a start outside the schedule.
    """
    if start is not None and not 0 <= start < schedule.steps:
        raise ModelError(
            f"start: step {start} is not within the noise schedule, which has steps 0 to "
            f"{schedule.steps - 1}"
        )
    last = schedule.steps - 1 if start is None else start
    if count is None or count == last + 1:
        return list(range(last, -1, -1))
    if not 1 <= count <= last:
        raise ModelError(f"steps: {count} must be between 1 and {last + 1}")
    if start is None:
        last = max(last_audible(schedule), count - 1)
    # Evenly in log signal-to-noise, but never twice at one step.
    level = schedule.log_snr()[: last + 1]
    wanted = torch.linspace(float(level[-1]), float(level[0]), count, dtype=torch.float64)
    steps = []
    for k, value in enumerate(wanted):
        nearest = int((level - value).abs().argmin())
        highest = steps[-1] - 1 if steps else last
        steps.append(max(min(nearest, highest), count - 1 - k))
    return steps


def sample(
    predict: Predict,
    noise_at: Callable[[int], Tensor],
    schedule: NoiseSchedule,
    *,
    solver: Solver = "ancestral",
    steps: int | None = None,
    start: tuple[Tensor, int] | None = None,
) -> Tensor:
    """A motion from noise.

    Args:
        predict: the noise in (noisy, step); see `NoiseSchedule.noise_of` for velocity networks.
        noise_at: standard normal noise of the motion's shape; 0 is what it begins with, 1, 2 ...
            are what ancestral steps add.
        schedule: of the network.
        solver: "ancestral" as published (Ho et al. 2020); "ddim" without noise (Song et al. 2021);
            "dpm", second order without noise (DPM-Solver++ 2M of Lu et al. 2022).
        steps: how many of the schedule's steps to take; None for all.
        start: (clean, step): begin with this motion, noised to that step, instead of with noise.

    Returns:
        As `noise_at` gives it.

    Raises:
        ModelError: an unknown solver, or steps that the schedule does not have.
    """
    if solver not in SOLVERS:
        raise ModelError(f"solver: {solver!r} is unknown; choose one of {', '.join(SOLVERS)}")
    visited = chosen_steps(schedule, steps, None if start is None else start[1])
    x = noise_at(0)
    if start is not None:
        x = schedule.add_noise(start[0], x, start[1])
    if solver == "ancestral":
        return _ancestral(predict, noise_at, schedule, visited, x)
    return _without_noise(predict, schedule, visited, x, 1 if solver == "ddim" else 2)


def _ancestral(
    predict: Predict,
    noise_at: Callable[[int], Tensor],
    schedule: NoiseSchedule,
    visited: list[int],
    x: Tensor,
) -> Tensor:
    """Steps of the reverse chain; beta is that of all the schedule's steps between two visits."""
    kept = [*schedule.alphas_bar[visited].tolist(), 1.0]
    for k, step in enumerate(visited):
        alpha = kept[k] / kept[k + 1]
        beta = 1 - alpha
        x = (x - beta / math.sqrt(1 - kept[k]) * predict(x, step)) / math.sqrt(alpha)
        if k + 1 < len(visited):
            x = x + math.sqrt(beta * (1 - kept[k + 1]) / (1 - kept[k])) * noise_at(k + 1)
    return x


def _without_noise(
    predict: Predict, schedule: NoiseSchedule, visited: list[int], x: Tensor, order: int
) -> Tensor:
    """The probability flow, in exponential steps over the clean motion that is predicted."""
    signal = [*schedule.alphas_bar[visited].sqrt().tolist(), 1.0]
    spread = [*(1 - schedule.alphas_bar[visited]).sqrt().tolist(), 0.0]
    level = (schedule.log_snr()[visited] / 2).tolist()
    before = None
    for k, step in enumerate(visited):
        clean = (x - spread[k] * predict(x, step)) / signal[k]
        ahead = clean
        # The last step has no length in signal-to-noise, and ends at the clean motion itself.
        if order == 2 and before is not None and k + 1 < len(visited):
            ratio = (level[k] - level[k - 1]) / (level[k + 1] - level[k])
            ahead = clean + (clean - before) / (2 * ratio)
        before = clean
        shrink = spread[k + 1] / spread[k]
        x = shrink * x + (signal[k + 1] - signal[k] * shrink) * ahead
    return x
