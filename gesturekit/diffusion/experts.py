"""Products of experts: a weighted sum of several noise predictions (eqs. 6 to 9).

    eps(x, n) = sum_m gamma_m eps_m(x, c_m, n),    sum_m gamma_m = 1

(eq. 8 of Alexanderson et al. 2023). The experts are several models, or one model with several
conditions. Weights may be negative or above 1, which extrapolates, and may change over time.
Classifier-free guidance (eq. 6) has two experts, without and with the style, of weights 1 - gamma
and gamma. Guided interpolation (eq. 7) has two experts with different styles.

Noise is predicted in normalised motion. Models with different means can be combined: the noisy
motion is shifted to the mean of each, and its noise stays the same. Models with different scales
cannot: the same noise would have a different size for each of them. So two models can be combined
if one was trained from the other (`start_from`), with the other's motion vectors (`moves_like`), or
on the same recordings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.conditions import SUM_TOLERANCE, style_weights, weights_over_time
from gesturekit.diffusion.motion_vector import measured_state
from gesturekit.diffusion.network import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule, Predict
from gesturekit.errors import ModelError
from gesturekit.state.process import given_state, mood_seed
from gesturekit.training.seeds import rng_for

if TYPE_CHECKING:
    from gesturekit.diffusion.model import DiffusionModel
    from gesturekit.diffusion.request import Member, Request


@dataclass(frozen=True, eq=False)
class Expert:
    """A network with its condition and weight: one term of eq. 8.

    Attributes:
        network: in eval mode.
        schedule: of its training.
        condition: (1, T, C), or (B, T, C) for a batch of motions with different conditions.
        weight: gamma, (1,) or (T,) float64.
        shift: (X,) offset from the product's normalised motion to that of this network, for a
            network trained with another mean; None for no offset.
    """

    network: Denoiser
    schedule: NoiseSchedule
    condition: Tensor
    weight: np.ndarray
    shift: Tensor | None = None

    def weighted(self, factor: float | np.ndarray) -> Expert:
        """Return the expert with its weight multiplied by a factor."""
        return replace(self, weight=factor * self.weight)

    def equals(self, other: Expert) -> bool:
        """Return whether both have the same weights and condition, hence the same predictions."""
        shifts = [shift for shift in (self.shift, other.shift) if shift is not None]
        ours, theirs = self.network, other.network
        return (
            torch.equal(self.condition, other.condition)
            and (not shifts or (len(shifts) == 2 and torch.equal(*shifts)))
            and self.schedule.predicts == other.schedule.predicts
            and (ours is theirs or _are_equal(ours, theirs))
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


def _are_equal(network: Denoiser, other: Denoiser) -> bool:
    weights = network.state_dict().values(), other.state_dict().values()
    return network.config == other.config and all(map(torch.equal, *weights))


def predicted_noise(experts: Sequence[Expert], noisy: Tensor, step: int) -> Tensor:
    """Return the weighted sum (B, T, X) of the experts' noise predictions (eq. 8)."""
    if len(experts) == 1:  # its weight is 1 up to rounding
        return experts[0].predict(noisy, step)
    total = torch.zeros_like(noisy)
    for expert in experts:
        weight = torch.from_numpy(expert.weight).to(noisy.device, noisy.dtype)
        total = total + weight[:, None] * expert.predict(noisy, step)
    return total


def product(experts: Sequence[Expert]) -> list[Expert]:
    """Check the weights of a product, and merge equal experts by adding theirs.

    Experts of weight 0 are left out. A product of equal experts is therefore bitwise equal to the
    single model.

    Raises:
        ModelError: weights that do not add up to 1.
    """
    weights = [expert.weight for expert in experts]
    sums = np.sum(np.broadcast_arrays(*weights), axis=0)
    worst = sums[np.argmax(np.abs(sums - 1))]  # NaN is the worst
    if not math.isclose(worst, 1.0, rel_tol=0, abs_tol=SUM_TOLERANCE):
        given = ", ".join(f"{weight[0]:g}" if weight.size == 1 else "..." for weight in weights)
        raise ModelError(f"weights {given} add up to {worst:g}; experts' weights must add up to 1")
    merged: list[Expert] = []
    for expert in experts:
        k = next((k for k, known in enumerate(merged) if expert.equals(known)), None)
        if k is None:
            merged.append(expert)
        else:
            merged[k] = replace(merged[k], weight=merged[k].weight + expert.weight)
    return [expert for expert in merged if np.abs(expert.weight).max() > 0]


Term = tuple["DiffusionModel", np.ndarray, np.ndarray, bool]
"""A model, its condition (1 or B, T, C), its weight, and whether it has the state of movement."""


def experts_of(request: Request, numbers: Sequence[int]) -> list[Expert]:
    """Return the experts of a request for the samples with these numbers.

    A model with several styles is one expert for each style with a weight; guidance adds experts
    with the style, the conditions or the state of movement left out.
    """
    states, members = _states(request, numbers), request.members
    weights = weights_over_time([m.weight for m in members], request.n_frames, request.fps)
    experts = []
    for k, (member, weight) in enumerate(zip(members, weights, strict=True)):
        terms = _styled(member, request, numbers)
        for term in [*terms, *(_guidance(terms, request) if k == 0 else ())]:
            experts.append(_expert(request, term, states).weighted(weight))
    return experts


def _guidance(terms: list[Term], request: Request) -> list[Term]:
    """Return what classifier-free guidance adds to the terms of the first model.

    This is eq. 6: gamma - 1 with the style, 1 - gamma without. Guidance on the state of movement is
    the same beside it, with and without the state.
    """
    added: list[Term] = []
    if (gamma := request.controls["guidance"]) is not None:
        unconditional = request.controls["unconditional"]
        model = request.model if unconditional is None else unconditional
        condition = request.condition(model.conditions)
        if unconditional is None and not ("styles" in model.droppable and model.styles):
            condition = model.conditions.without(condition)
        added.append((model, condition[None], np.ones(1) - gamma, True))
        added += [(model, given, (gamma - 1) * weight, True) for model, given, weight, _ in terms]
    if (gamma := request.controls["state_guidance"]) is not None:
        for model, given, weight, _ in terms:
            added.append((model, given, (1 - gamma) * weight, False))
            added.append((model, given, (gamma - 1) * weight, True))
    return added


def _expert(request: Request, term: Term, states: Sequence[np.ndarray] | None) -> Expert:
    """Return a term as an expert beside the model of the request, with states (C, T) of samples."""
    first, (model, given, weight, has_state), shift = request.model, term, None
    condition = torch.from_numpy(given)
    if states is not None and has_state:
        condition = condition.repeat(len(states) // len(condition), 1, 1)
        if model.state_process is not None:
            columns = model.conditions.columns["state"]
            for row, state in zip(condition, states, strict=True):
                row[:, columns] = torch.from_numpy(model.state_process.given(state).T)
    if not torch.equal(first.normaliser.mean, model.normaliser.mean):
        shift = (first.normaliser.mean - model.normaliser.mean) / first.normaliser.scale
        shift = shift.to(model.device)
    return Expert(model.network, model.schedule, condition.to(first.device), weight, shift)


def _styled(member: Member, request: Request, numbers: Sequence[int]) -> list[Term]:
    """Return a model's terms, one for each style with a weight.

    Without a requested style, each sample gets a random one.
    """
    model, _, style = member
    condition = request.condition(model.conditions)[None]
    first = model.conditions.columns["styles"].start
    if model.styles and style is None:
        condition = np.repeat(condition, len(numbers), axis=0)
        for row, number in zip(condition, numbers, strict=True):
            row[:, first + _random_style(model, request, number)] = 1
    if not model.styles or style is None:
        return [(model, condition, np.ones(1), True)]
    terms: list[Term] = []
    weights = style_weights(model.styles, style, request.n_frames, request.fps)
    for k, weight in enumerate(weights.T):
        if np.abs(weight).max() > 0:
            styled = condition.copy()
            styled[..., first + k] = 1
            weight = weight[:1] if (weight == weight[0]).all() else weight
            terms.append((model, styled, weight, True))
    return terms


def _random_style(model: DiffusionModel, request: Request, number: int) -> int:
    """Return the random style of the sample with this number."""
    rng = rng_for(request.seed, request.item, "sample", number, "style")
    return int(torch.randint(len(model.styles), (), generator=rng))


def _states(request: Request, numbers: Sequence[int]) -> list[np.ndarray] | None:
    """Return the state of movement (C, T) of each sample, for all experts; None without any.

    It is that of the request, or of the motion to start from; else it is drawn for the first model
    with a state, in its style.
    """
    members = (member for member in request.members if member.model.state_process is not None)
    model, _, name = next(members, request.members[0])
    controls = request.controls
    if (process := model.state_process) is None:
        return None
    if controls["state"] is not None:
        return [given_state(process, controls["state"], request.n_frames).T] * len(numbers)
    if request.start is not None:
        vectors = model.normaliser.inverse(request.start[0].cpu()).numpy()
        about = model.representation, process.channels, process.fps
        return [measured_state(vectors, *about)] * len(numbers)
    styles = [None] * len(numbers)
    if model.styles and name is not None:
        weights = style_weights(model.styles, name, request.n_frames, request.fps)
        styles = [int(weights.sum(axis=0).argmax())] * len(numbers)
    elif model.styles:
        styles = [_random_style(model, request, number) for number in numbers]
    speech = request.condition(model.conditions)[:, model.conditions.columns["speech"]].T
    seed = mood_seed(request.seed, controls)
    amount, states = controls["liveliness"], []
    for number, style in zip(numbers, styles, strict=True):
        own = rng_for(seed, request.item, "sample", number, "mood").initial_seed() >> 1
        group = controls["speaker"], style
        states.append(process.draw(own, speech, group, liveliness=amount))
    return states
