"""The diffusion process: its noise schedule, and solvers of the reverse process.

Steps count from 0 (least noise) to N - 1; the paper's n is one more. At step n, a noisy motion is
sqrt(abar_n) clean + sqrt(1 - abar_n) noise, by eq. 1 of Alexanderson et al. 2023. All values are in
double precision: the published schedule ends at abar = 6e-26.

Every solver gets noise predictions from `predict(noisy, step)` and all random numbers from
`noise_at(k)`. `predict` may be one network, a product of experts, or a tiled prediction.

| paper | here |
|---|---|
| n = 1 ... N | `step` = 0 ... `steps` - 1 |
| beta_n, alpha_n^2 = 1 - beta_n | `betas`, 1 - `betas` |
| abar_n, the product of alpha_i^2 up to n | `alphas_bar` |
| x_0, x_n, eps | `clean`, `noisy`, `noise` |
| eps_hat(x_n, c, n) | `predict(noisy, step)`, `Denoiser.forward` |
| c, s, gamma_m | columns of `Conditions`, its `styles`, `Expert.weight` |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gesturekit.diffusion.config import NoiseConfig
from gesturekit.diffusion.controls import Solver
from gesturekit.errors import ModelError

Step = int | Tensor
"""A step of the diffusion, or steps (B,), one for each clip of a batch."""


@dataclass(frozen=True)
class NoiseSchedule:
    """A variance-preserving schedule.

    Attributes:
        betas: (N,) float64 variance of the noise that each step adds.
        alphas_bar: (N,) float64 remaining share of the clean motion's variance.
        predicts: prediction target of the network: "noise", "velocity" or "clean".
    """

    betas: Tensor
    alphas_bar: Tensor
    predicts: str

    @classmethod
    def of(cls, config: NoiseConfig) -> NoiseSchedule:
        """Return the linear schedule of the paper."""
        ends = config.first_beta, config.last_beta
        betas = torch.linspace(*ends, config.steps, dtype=torch.float64)
        return cls(betas, torch.cumprod(1 - betas, 0), config.predict)

    @property
    def steps(self) -> int:
        """N, the number of steps."""
        return len(self.betas)

    def log_snr(self) -> Tensor:
        """Return the log signal-to-noise ratio log(abar / (1 - abar)), (N,) float64, decreasing."""
        return torch.log(self.alphas_bar) - torch.log1p(-self.alphas_bar)

    def scales(self, step: Step, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return factors (signal, noise) of clean motion and noise, which broadcast to `like`."""
        index = torch.as_tensor(step, dtype=torch.long, device="cpu")
        kept = self.alphas_bar[index]
        shape = (-1, *(1,) * (like.ndim - 1)) if index.ndim else ()
        signal, noise = kept.sqrt().reshape(shape), (1 - kept).sqrt().reshape(shape)
        # 0-dimensional factors stay on the CPU, where they combine with tensors of any device.
        device = like.device if index.ndim else None
        return signal.to(device, like.dtype), noise.to(device, like.dtype)

    def add_noise(self, clean: Tensor, noise: Tensor, step: Step) -> Tensor:
        """Sample q(x_n | x_0) of eq. 1, (B, T, X), from clean motion and standard normal noise."""
        signal, spread = self.scales(step, clean)
        return signal * clean + spread * noise

    def target(self, clean: Tensor, noise: Tensor, step: Step) -> Tensor:
        """Return the prediction target (B, T, X) for `add_noise(clean, noise, step)`.

        The velocity is signal * noise - spread * clean (Salimans and Ho 2022).
        """
        if self.predicts == "velocity":
            signal, spread = self.scales(step, clean)
            return signal * noise - spread * clean
        return noise if self.predicts == "noise" else clean

    def noise_of(self, prediction: Tensor, noisy: Tensor, step: Step) -> Tensor:
        """Convert a network's prediction (B, T, X) to noise."""
        if self.predicts == "noise":
            return prediction
        signal, spread = self.scales(step, noisy)
        if self.predicts == "velocity":
            return spread * noisy + signal * prediction
        return (noisy - signal * prediction) / spread

    def loss_weight(self, step: Tensor, gamma: float | None) -> Tensor:
        """Return the min-SNR weight (Hang et al. 2023) of each clip's squared error.

        With s = abar / (1 - abar), the weight is min(s, gamma) / s for noise, min(s, gamma) /
        (s + 1) for velocity, and min(s, gamma) for clean motion. Each is equivalent to a weight of
        min(s, gamma) on the error of the clean motion. `gamma=None` gives 1, as in the paper.

        Returns:
            (B,) float32 on the device of `step`.
        """
        if gamma is None:
            return torch.ones(len(step), device=step.device)
        snr = self.log_snr().exp()
        unit = {"noise": snr, "velocity": snr + 1, "clean": torch.ones_like(snr)}[self.predicts]
        weights = snr.clamp(max=gamma) / unit
        return weights[step.cpu()].to(step.device, torch.float32)


Predict = Callable[[Tensor, int], Tensor]
"""Return the noise in motion (B, T, X) at a step, or a network's own prediction."""

NoiseAt = Callable[[int], Tensor]
"""Return standard normal noise (B, T, X): 0 is the initial noise, 1, 2 ... are for later steps."""

MAX_DEVIATION = 10.0
"""Bound of every number of a motion, in standard deviations from its mean."""

NO_SIGNAL = 1e-8
"""abar below which the network is not evaluated: all 21,000 numbers of 10 s then hold 1e-4 nats of
information about the motion. These are 39 of the 100 steps of the published gesture schedule, and
69 of the 150 for dance."""

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
        ModelError: fewer than one step, or more than there are.
    """
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
    noise_at: NoiseAt,
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
        ModelError: steps that the schedule does not have.
    """
    visited = chosen_steps(schedule, steps, None if start is None else start[1])
    x = noise_at(0)
    if start is not None:
        x = schedule.add_noise(start[0], x, start[1])
    if solver == "ancestral":
        return _ancestral(predict, noise_at, schedule, visited, x)
    return _without_noise(predict, schedule, visited, x, 1 if solver == "ddim" else 2)


def _ancestral(
    predict: Predict, noise_at: NoiseAt, schedule: NoiseSchedule, visited: list[int], x: Tensor
) -> Tensor:
    """Sample the reverse Markov chain (eqs. 2, 3).

    beta covers all steps between two visited ones.
    """
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


def clip_denoised(predict: Predict, schedule: NoiseSchedule) -> Predict:
    """Clip noise predictions so that the clean motion stays within `MAX_DEVIATION`.

    This is `clip_denoised` of Ho et al. (2020). At steps of almost pure noise, one step doubles the
    network's error and all of them multiply it by 1e12, and the bounds are more accurate than the
    network. Where abar is below `NO_SIGNAL`, both bounds equal the noisy motion to 1e-3: it is
    returned, and the network is not evaluated.
    """

    def clipped(noisy: Tensor, step: int) -> Tensor:
        signal, spread = schedule.scales(step, noisy)
        if schedule.alphas_bar[step] < NO_SIGNAL:
            return noisy
        noise = predict(noisy, step)
        reach = signal * MAX_DEVIATION
        return torch.clamp(noise, (noisy - reach) / spread, (noisy + reach) / spread)

    return clipped
