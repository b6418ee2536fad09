"""Products of experts: a weighted sum of several noise predictions.

    eps(x, n) = sum_m gamma_m eps_m(x, c_m, n),    sum_m gamma_m = 1

(eq. 8 of Alexanderson et al. 2023). The experts are several models, or one model with several
conditions. Weights may be negative or above 1, which extrapolates, and may change over time.
Classifier-free guidance (eq. 6) has two experts, without and with the style, of weights 1 - gamma
and gamma. Guided interpolation (eq. 7) has two experts with different styles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule
from gesturekit.diffusion.sampling.solvers import Predict
from gesturekit.errors import ModelError

SUM_TOLERANCE = 1e-5
"""Largest rounding error of the sum of the weights."""

MAX_DEVIATION = 10.0
"""Bound of every number of a motion, in standard deviations from its mean."""

NO_SIGNAL = 1e-8
"""abar below which the network is not evaluated: all 21,000 numbers of 10 s then hold 1e-4 nats of
information about the motion. These are 39 of the 100 steps of the published gesture schedule, and
69 of the 150 for dance."""

Weight = float | np.ndarray | Tensor
"""gamma of one expert: a number, or (T,) with one number per frame."""


@dataclass(frozen=True, eq=False)
class Expert:
    """A network with its condition.

    Attributes:
        network: in eval mode.
        schedule: of its training.
        condition: (1, T, C), or (B, T, C) for a batch of motions with different conditions.
        shift: (X,) offset from the product's normalised motion to that of this network, for a
            network trained with another mean; None for no offset.
    """

    network: Denoiser
    schedule: NoiseSchedule
    condition: Tensor
    shift: Tensor | None = None

    def equals(self, other: Expert) -> bool:
        """Return whether both have the same weights and condition, hence the same predictions."""
        shifts = [shift for shift in (self.shift, other.shift) if shift is not None]
        return (
            torch.equal(self.condition, other.condition)
            and (not shifts or (len(shifts) == 2 and torch.equal(*shifts)))
            and self.schedule.predicts == other.schedule.predicts
            and _same_weights(self.network, other.network)
        )

    @cached_property
    def _predict(self) -> Predict:
        return self.network.for_condition(self.condition, range(self.schedule.steps))

    def predict(self, noisy: Tensor, step: int) -> Tensor:
        """Return the noise in `noisy` (B, T, X), converted from the network's own prediction.

        For a network trained with another mean, the clean part of `noisy` is shifted to it. The
        noise stays the same.
        """
        if self.shift is not None:
            signal, _ = self.schedule.scales(step, noisy)
            noisy = noisy + signal * self.shift
        return self.schedule.noise_of(self._predict(noisy, step), noisy, step)


class ProductOfExperts:
    """A weighted sum of the noise predictions of several experts (eq. 8).

    Equal experts are merged and their weights added; experts of weight 0 are not run. A product of
    equal experts is therefore bitwise equal to the single model.

    Args:
        experts: with one schedule, length, and width of the motion vector.
        weights: gamma of each; they add up to 1 at every frame.

    Raises:
        ModelError: weights that do not add up to 1 or have the wrong number of frames; experts with
            different schedules, lengths or widths.
    """

    def __init__(self, experts: Sequence[Expert], weights: Sequence[Weight]) -> None:
        if not experts or len(experts) != len(weights):
            raise ModelError(
                f"{len(experts)} experts and {len(weights)} weights; give a weight for each of at "
                "least one expert"
            )
        _check_alike(experts)
        self.n_frames = experts[0].condition.shape[1]
        gammas = [checked_weight(weight, self.n_frames) for weight in weights]
        _check_sum(gammas)
        merged: list[tuple[Expert, np.ndarray]] = []
        for expert, gamma in zip(experts, gammas, strict=True):
            equal = (k for k, (known, _) in enumerate(merged) if expert.equals(known))
            k = next(equal, None)
            if k is None:
                merged.append((expert, gamma))
            else:
                merged[k] = (merged[k][0], merged[k][1] + gamma)
        self._set(merged)

    def _set(self, merged: Sequence[tuple[Expert, np.ndarray]]) -> None:
        used = [(expert, gamma) for expert, gamma in merged if np.abs(gamma).max() > 0]
        self.experts = tuple(expert for expert, _ in used)
        self.weights = tuple(gamma for _, gamma in used)

    def part(self, first: int, last: int) -> ProductOfExperts:
        """Return the product for frames first (included) to last (excluded)."""
        part = ProductOfExperts.__new__(ProductOfExperts)
        part.n_frames = last - first
        part._set(
            [
                (
                    replace(expert, condition=expert.condition[:, first:last]),
                    gamma[first:last] if gamma.size > 1 else gamma,
                )
                for expert, gamma in zip(self.experts, self.weights, strict=True)
            ]
        )
        return part

    def predict(self, noisy: Tensor, step: int) -> Tensor:
        """Return the weighted sum of the experts' noise predictions (B, T, X)."""
        if len(self.experts) == 1:  # its weight is 1 up to rounding
            return self.experts[0].predict(noisy, step)
        total = torch.zeros_like(noisy)
        for expert, gamma in zip(self.experts, self.weights, strict=True):
            weight = torch.from_numpy(gamma).to(noisy.device, noisy.dtype)
            total = total + weight[:, None] * expert.predict(noisy, step)
        return total


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


def _check_alike(experts: Sequence[Expert]) -> None:
    first = experts[0]
    for expert in experts[1:]:
        if expert.network.n_motion != first.network.n_motion:
            raise ModelError(
                f"experts: one has {first.network.n_motion} numbers a frame, another "
                f"{expert.network.n_motion}; experts of a product need one rig and representation"
            )
        own, theirs = first.schedule.betas, expert.schedule.betas
        if own.shape != theirs.shape or not torch.allclose(own, theirs, rtol=0, atol=1e-6):
            raise ModelError(
                f"experts: their noise schedules differ ({_described(first.schedule)}; "
                f"{_described(expert.schedule)}); experts of a product need the same one"
            )
        if expert.condition.shape[1] != first.condition.shape[1]:
            raise ModelError(
                f"experts: one has a condition of {first.condition.shape[1]} frames, another of "
                f"{expert.condition.shape[1]}"
            )


def _described(schedule: NoiseSchedule) -> str:
    return f"{schedule.steps} steps, beta {schedule.betas[0]:g} to {schedule.betas[-1]:g}"


def checked_weight(weight: Weight, n_frames: int) -> np.ndarray:
    """Return the weight of one expert as float64 (1,) or (T,), for T frames.

    Raises:
        ModelError: the weight has another shape.
    """
    values = np.atleast_1d(np.asarray(weight, dtype=np.float64))
    if values.shape not in ((1,), (n_frames,)):
        raise ModelError(
            f"weights of an expert have shape {values.shape}; expected a number or ({n_frames},), "
            "one for each frame"
        )
    return values


def _check_sum(gammas: Sequence[np.ndarray]) -> None:
    sums = np.sum(np.broadcast_arrays(*gammas), axis=0)
    worst = sums[np.argmax(np.abs(sums - 1))]  # NaN is the worst
    if not math.isclose(worst, 1.0, rel_tol=0, abs_tol=SUM_TOLERANCE):
        given = ", ".join(f"{gamma[0]:g}" if gamma.size == 1 else "..." for gamma in gammas)
        raise ModelError(f"weights {given} add up to {worst:g}; experts' weights must add up to 1")


def _same_weights(one: Denoiser, other: Denoiser) -> bool:
    if one is other:
        return True
    if one.config != other.config:
        return False
    own, theirs = one.state_dict(), other.state_dict()
    return own.keys() == theirs.keys() and all(
        value.shape == theirs[name].shape and torch.equal(value, theirs[name])
        for name, value in own.items()
    )
