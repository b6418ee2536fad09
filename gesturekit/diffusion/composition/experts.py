"""Products of experts: several predictions of the noise, weighed into one.

    eps(x, n) = sum_m gamma_m eps_m(x, c_m, n),    sum_m gamma_m = 1

(eq. 8 of Alexanderson et al. 2023). Experts may be several models, or one model that is told
several things; weights may be negative or above 1, which extrapolates, and may change from frame
to frame. Classifier-free guidance (eq. 6) is the case of two experts, one of which is not told the
style: weights 1 - gamma and gamma. Guided interpolation between two styles (eq. 7) is another.
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
from gesturekit.diffusion.sampling.noise_schedule import NoiseSchedule
from gesturekit.diffusion.sampling.solvers import Predict
from gesturekit.errors import ModelError

SUM_TOLERANCE = 1e-5
"""How far from 1 the sum of the weights may be: rounding, and nothing that anybody typed."""

FARTHEST = 10.0
"""Standard deviations from the mean beyond which no number of a motion lies."""

SILENT = 1e-8
"""Share of a motion's variance below which no network is asked. All the 21,000 numbers of 10 s then
say 1e-4 nats together about the motion. 39 of the 100 steps of the published gesture schedule, 69
of dance's 150."""

Weight = float | np.ndarray | Tensor
"""gamma of one expert: a number, or (T,) of them, one for each frame."""


@dataclass(frozen=True, eq=False)
class Expert:
    """A network and what it is told.

    Attributes:
        network: in eval mode.
        schedule: by which it was trained.
        condition: (1, T, C), or (B, T, C) for a batch of motions that are told different things.
        shift: (X,) what is added to a clean motion to have it as this network knows it, for one
            whose motions were standardised about another mean; None for nothing.
    """

    network: Denoiser
    schedule: NoiseSchedule
    condition: Tensor
    shift: Tensor | None = None

    def is_like(self, other: Expert) -> bool:
        """Whether both predict the same, to the last bit: same weights, same condition."""
        return (
            torch.equal(self.condition, other.condition)
            and (self.shift is None) == (other.shift is None)
            and (self.shift is None or torch.equal(self.shift, other.shift))
            and self.schedule.predicts == other.schedule.predicts
            and _same_weights(self.network, other.network)
        )

    @cached_property
    def _listening(self) -> Predict:
        return self.network.listening(self.condition, range(self.schedule.steps))

    def predict(self, noisy: Tensor, step: int) -> Tensor:
        """The noise in `noisy` (B, T, X), whatever the network itself predicts.

        A network that knows motions about another mean sees this one moved there: as far as its
        clean part is left at this step. The noise in it is the same.
        """
        if self.shift is not None:
            signal, _ = self.schedule.scales(step, noisy)
            noisy = noisy + signal * self.shift
        return self.schedule.noise_of(self._listening(noisy, step), noisy, step)


class Mixture:
    """A product of experts.

    Experts that are alike become one, with the sum of their weights, and those of weight 0 are not
    run: a mixture of equal experts is the single model, to the last bit.

    Args:
        experts: of one schedule, for motions of one kind and length.
        weights: gamma of each; they add up to 1, at every frame.

    Raises:
        ModelError: weights that do not add up to 1 or do not fit the frames; experts with other
            schedules, lengths, or widths of their motions.
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
            like = (k for k, (known, _) in enumerate(merged) if expert.is_like(known))
            k = next(like, None)
            if k is None:
                merged.append((expert, gamma))
            else:
                merged[k] = (merged[k][0], merged[k][1] + gamma)
        self._set(merged)

    def _set(self, merged: Sequence[tuple[Expert, np.ndarray]]) -> None:
        used = [(expert, gamma) for expert, gamma in merged if np.abs(gamma).max() > 0]
        self.experts = tuple(expert for expert, _ in used)
        self.weights = tuple(gamma for _, gamma in used)

    def part(self, first: int, last: int) -> Mixture:
        """The mixture of frames first (included) to last (not included)."""
        part = Mixture.__new__(Mixture)
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
        """The noise in `noisy` (B, T, X) that the experts agree on."""
        if len(self.experts) == 1:  # its weight is 1, but for rounding
            return self.experts[0].predict(noisy, step)
        total = torch.zeros_like(noisy)
        for expert, gamma in zip(self.experts, self.weights, strict=True):
            weight = torch.from_numpy(gamma).to(noisy.device, noisy.dtype)
            total = total + weight[:, None] * expert.predict(noisy, step)
        return total


def bounded(predict: Predict, schedule: NoiseSchedule) -> Predict:
    """The same prediction of the noise, but for what would make the motion an impossible one.

    The clean motion that a prediction stands for is kept within `FARTHEST` (`clip_denoised` of Ho
    et al. 2020). In steps that are all but noise this tells the noise better than any network:
    what a network gets wrong there, a step multiplies by up to 2, and all of them by 1e12. In
    `SILENT` steps, where both bounds are what is given to 1e-3, the network is not asked.
    """

    def within(noisy: Tensor, step: int) -> Tensor:
        signal, spread = schedule.scales(step, noisy)
        if schedule.alphas_bar[step] < SILENT:
            return noisy / spread
        noise = predict(noisy, step)
        reach = signal * FARTHEST
        return torch.clamp(noise, (noisy - reach) / spread, (noisy + reach) / spread)

    return within


def _check_alike(experts: Sequence[Expert]) -> None:
    first = experts[0]
    for expert in experts[1:]:
        if expert.network.n_motion != first.network.n_motion:
            raise ModelError(
                f"experts: one moves by {first.network.n_motion} numbers a frame, another by "
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
                f"experts: one is told about {first.condition.shape[1]} frames, another about "
                f"{expert.condition.shape[1]}"
            )


def _described(schedule: NoiseSchedule) -> str:
    return f"{schedule.steps} steps, beta {schedule.betas[0]:g} to {schedule.betas[-1]:g}"


def checked_weight(weight: Weight, n_frames: int) -> np.ndarray:
    """(1,) or (T,) float64 of a weight of one expert for T frames.

    Raises:
        ModelError: it has another shape.
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
