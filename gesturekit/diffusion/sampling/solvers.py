"""Solvers of the reverse diffusion, with all steps as published or with few.

Every solver gets noise predictions from `predict(noisy, step)` and all random numbers from
`noise_at(k)`. `predict` may be one network, a product of experts, or a tiled prediction.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gesturekit.diffusion.controls import Solver
from gesturekit.diffusion.noise_schedule import NoiseSchedule
from gesturekit.errors import ModelError

Predict = Callable[[Tensor, int], Tensor]
SOLVERS: tuple[Solver, ...] = ("ancestral", "ddim", "dpm")

PURE_NOISE = 1e-5
"""abar below which solvers with few steps do not start."""


def last_step_with_signal(schedule: NoiseSchedule) -> int:
    """Return the last step with abar above `PURE_NOISE`."""
    return int((schedule.alphas_bar > PURE_NOISE).sum()) - 1


def chosen_steps(schedule: NoiseSchedule, count: int | None, start: int | None = None) -> list[int]:
    """Return the steps that a solver visits, noisiest first.

    Args:
        schedule: of the network.
        count: number of steps; None for all.
        start: the first step. By default the last one of the schedule or, if `count` skips steps,
            `last_step_with_signal`.

    Raises:
        ModelError: fewer than one step, more than the schedule has, or a start outside of it.
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
        last = max(last_step_with_signal(schedule), count - 1)
    # Evenly in log signal-to-noise ratio, without repeated steps.
    level = schedule.log_snr()[: last + 1]
    wanted = torch.linspace(float(level[-1]), float(level[0]), count, dtype=torch.float64)
    steps: list[int] = []
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
    """Sample a motion from noise.

    Args:
        predict: returns the noise in (noisy, step); see `NoiseSchedule.noise_of`.
        noise_at: returns standard normal noise (B, T, X): 0 is the initial noise, 1, 2 ... are
            added by ancestral steps.
        schedule: of the network.
        solver: "ancestral" as published (Ho et al. 2020); "ddim", deterministic (Song et al. 2021);
            "dpm", deterministic of second order (DPM-Solver++ 2M, Lu et al. 2022).
        steps: number of steps; None for all of the schedule.
        start: (clean, step): start from this motion (B, T, X) or (T, X), noised to that step,
            instead of from pure noise.

    Returns:
        (B, T, X).

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
    """Sample the reverse Markov chain; beta covers all steps between two visited ones."""
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
    """Integrate the probability flow ODE by exponential steps in the predicted clean motion."""
    signal = [*schedule.alphas_bar[visited].sqrt().tolist(), 1.0]
    spread = [*(1 - schedule.alphas_bar[visited]).sqrt().tolist(), 0.0]
    level = (schedule.log_snr()[visited] / 2).tolist()
    before = None
    for k, step in enumerate(visited):
        clean = (x - spread[k] * predict(x, step)) / signal[k]
        ahead = clean
        # The last step ends at the clean motion, where the log signal-to-noise ratio is infinite.
        if order == 2 and before is not None and k + 1 < len(visited):
            ratio = (level[k] - level[k - 1]) / (level[k + 1] - level[k])
            ahead = clean + (clean - before) / (2 * ratio)
        before = clean
        shrink = spread[k + 1] / spread[k]
        x = shrink * x + (signal[k + 1] - signal[k] * shrink) * ahead
    return x
