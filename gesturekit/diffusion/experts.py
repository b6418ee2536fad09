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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gesturekit.corpus.checks import first_difference
from gesturekit.diffusion.conditions import (
    SUM_TOLERANCE,
    ExpertWeight,
    style_weights,
    weight_track,
    weights_over_time,
)
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.network import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule, Predict
from gesturekit.errors import ModelError
from gesturekit.state.process import mood_seed
from gesturekit.training.seeds import rng_for

if TYPE_CHECKING:
    from gesturekit.diffusion.model import DiffusionModel
    from gesturekit.diffusion.request import Request

_SCALE_TOLERANCE = 1e-4
"""Largest relative difference between the scales of two models that can be combined."""


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


def _same_weights(network: Denoiser, other: Denoiser) -> bool:
    if network is other or network.config != other.config:
        return network is other
    return all(map(torch.equal, network.state_dict().values(), other.state_dict().values()))


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
    _check_sum([expert.weight for expert in experts])
    merged: list[Expert] = []
    for expert in experts:
        k = next((k for k, known in enumerate(merged) if expert.equals(known)), None)
        if k is None:
            merged.append(expert)
        else:
            merged[k] = replace(merged[k], weight=merged[k].weight + expert.weight)
    return [expert for expert in merged if np.abs(expert.weight).max() > 0]


def _check_sum(weights: Sequence[np.ndarray]) -> None:
    sums = np.sum(np.broadcast_arrays(*weights), axis=0)
    worst = sums[np.argmax(np.abs(sums - 1))]  # NaN is the worst
    if not math.isclose(worst, 1.0, rel_tol=0, abs_tol=SUM_TOLERANCE):
        given = ", ".join(f"{weight[0]:g}" if weight.size == 1 else "..." for weight in weights)
        raise ModelError(f"weights {given} add up to {worst:g}; experts' weights must add up to 1")


class Member(NamedTuple):
    """A model of a product, with its weight, and its style; None for a random style."""

    model: DiffusionModel
    weight: ExpertWeight
    style: str | None


def product_members(first: DiffusionModel, controls: DiffusionControls) -> list[Member]:
    """Collect and check the models of a request, without the unconditional one.

    An expert without a style gets the style of the first model if it has that style, and a
    random one otherwise.

    Raises:
        ModelError: models that cannot be combined, weights over time or styles that cannot be
            read, or guidance that none of the models supports.
    """
    style = controls["style"]
    members = [Member(first, None, style)]
    for number, expert in enumerate(controls["experts"], start=1):
        if not 1 <= len(expert) <= 3:
            raise ModelError(f"expert {number}: expected (model, weight) or + (style,)")
        model, weight, named = (*expert, None, None)[:3]
        if reason := next(_differences(first, model), None):
            raise ModelError(f"expert {number}: {reason}")
        if isinstance(weight, str):
            weight_track(weight, 1, first.fps)
        inherited = style if style is not None and _knows(model, style) else None
        members.append(Member(model, weight, inherited if named is None else named))
    if style is not None and not any(member.model.styles for member in members):
        raise ModelError(f"style={style!r}: this model has no styles")
    if problem := next(_guidance_problems(first, controls), None):
        raise ModelError(problem)
    for model, _, name in members:
        if model.styles and name is not None:
            style_weights(model.styles, name, 1, model.fps)
    return members


def _knows(model: DiffusionModel, style: str) -> bool:
    try:
        style_weights(model.styles, style, 1, model.fps)
    except ModelError:
        return False
    return True


def _guidance_problems(first: DiffusionModel, controls: DiffusionControls) -> Iterator[str]:
    """Yield what is wrong with guidance."""
    guidance, unconditional = controls["guidance"], controls["unconditional"]
    if (gamma := controls["state_guidance"]) is not None and "state" not in first.droppable:
        yield (
            f"state_guidance={gamma:g}: this model was trained without dropout of the state "
            "(training.dropout_state above 0)"
        )
    if unconditional is not None:
        if guidance is None:
            yield "unconditional: only used with guidance; give guidance too"
        for reason in _differences(first, unconditional):
            yield f"unconditional: {reason}"
        if unconditional.styles and not {"styles", "all"} & set(unconditional.droppable):
            yield "unconditional: that model needs a style too; give one trained with styles: null"
    elif guidance is not None:
        if not first.conditions.columns["state"].start:
            yield f"guidance={guidance:g}: this model has no conditions to guide on"
        if not ("all" in first.droppable or (first.styles and "styles" in first.droppable)):
            what = "style" if first.styles else "condition"
            yield (
                f"guidance={guidance:g}: this model was trained without {what} dropout "
                f"(training.dropout_{what} above 0); give an unconditional model beside it"
            )


def _differences(first: DiffusionModel, other: Any) -> Iterator[str]:
    """Yield reasons for which the motion vectors or noise of two models differ in meaning."""
    kind = getattr(other, "kind", type(other).__name__)
    if kind != first.kind:
        yield f"a {kind} model; only diffusion models can be combined"
    if other.device != first.device:
        yield f"is on {other.device}, this model on {first.device}; load both on one device"
    if other.fps != first.fps:
        yield f"moves at {other.fps:g} fps, this model at {first.fps:g}"
    theirs, ours = other.representation, first.representation
    if different := first_difference(other.skeleton, first.skeleton):
        yield f"another rig: {different}"
    if theirs.joints != ours.joints:
        yield f"its {len(theirs.joints)} joints are not the {len(ours.joints)} of this model"
    if theirs.makes_root != ours.makes_root:
        yield "only one of the two follows a path"
    if theirs.turn_first != ours.turn_first:
        yield "only one of the two has the motion vector of the released code"
    ratio = other.normaliser.scale / first.normaliser.scale
    worst = float(ratio[(ratio.log().abs()).argmax()])
    places = (theirs.references, ours.references), (theirs.side, ours.side)
    same = {
        "lengths are relative to another body size": math.isclose(
            theirs.scale, ours.scale, rel_tol=_SCALE_TOLERANCE
        ),
        "rotations are relative to other mean rotations": all(
            np.allclose(*pair, atol=1e-6) for pair in places
        ),
        f"motion has another scale (by up to a factor of {worst:.3g})": abs(worst - 1)
        <= _SCALE_TOLERANCE,
    }
    for reason in (text for text, is_same in same.items() if not is_same):
        yield f"its {reason}; train one with moves_like: the other, to share motion vectors"
    noises = [
        f"{noise.steps} steps, beta {noise.first_beta:g} to {noise.last_beta:g}"
        for noise in (first.noise_config, other.noise_config)
    ]
    if noises[0] != noises[1]:
        yield f"its noise schedule has {noises[1]}, that of this model {noises[0]}"


def experts_of(request: Request, numbers: Sequence[int]) -> list[Expert]:
    """Return the experts of a request for the samples with these numbers.

    A model with several styles is one expert for each style with a weight; guidance adds experts
    with the style, the conditions or the state of movement left out.
    """
    states, members = _states(request, numbers), request.members
    weights = weights_over_time([m.weight for m in members], request.n_frames, request.fps)
    experts: list[Expert] = []
    for k, (member, weight) in enumerate(zip(members, weights, strict=True)):
        plain = _styled(member, request, numbers)
        terms = [_with_state(expert, member.model, states) for expert in plain]
        if k == 0:
            terms += _guidance(plain, terms, request, states)
        experts += [expert.weighted(weight) for expert in terms]
    device = request.model.device
    return [replace(expert, condition=expert.condition.to(device)) for expert in experts]


def _guidance(
    plain: list[Expert], terms: list[Expert], request: Request, states: list[np.ndarray] | None
) -> list[Expert]:
    """Return what classifier-free guidance adds: gamma - 1 with the style, 1 - gamma without.

    This is eq. 6. Guidance on the state of movement is the same beside it, with and without the
    state.

    Args:
        plain: experts of the first model without the state of movement.
        terms: its experts.
        request: the request.
        states: see `_states`.
    """
    added: list[Expert] = []
    if (gamma := request.controls["guidance"]) is not None:
        unconditional = request.controls["unconditional"]
        model = request.model if unconditional is None else unconditional
        condition = request.condition(model.conditions)
        if unconditional is None and not ("styles" in model.droppable and model.styles):
            condition = model.conditions.without(condition)
        without = _expert(request, model, condition[None], np.ones(1) - gamma)
        added.append(_with_state(without, model, states))
        added += [expert.weighted(gamma - 1) for expert in terms]
    if (gamma := request.controls["state_guidance"]) is not None:
        for without, expert in zip(plain, terms, strict=True):
            added += [without.weighted(1 - gamma), expert.weighted(gamma - 1)]
    return added


def _expert(
    request: Request, model: DiffusionModel, condition: np.ndarray, weight: np.ndarray
) -> Expert:
    """Return a model with a condition (B, T, C) as an expert beside the model of the request."""
    first, shift = request.model, None
    if not torch.equal(first.normaliser.mean, model.normaliser.mean):
        shift = (first.normaliser.mean - model.normaliser.mean) / first.normaliser.scale
        shift = shift.to(model.device)
    return Expert(model.network, model.schedule, torch.from_numpy(condition), weight, shift)


def _styled(member: Member, request: Request, numbers: Sequence[int]) -> list[Expert]:
    """Return a model's experts, one for each style with a weight, without its state of movement.

    Without a requested style, each sample gets a random one.
    """
    model, _, style = member
    condition = request.condition(model.conditions)[None]
    if not model.styles:
        return [_expert(request, model, condition, np.ones(1))]
    first = model.conditions.columns["styles"].start
    if style is None:
        condition = np.repeat(condition, len(numbers), axis=0)
        for row, number in zip(condition, numbers, strict=True):
            row[:, first + _random_style(model, request, number)] = 1
        return [_expert(request, model, condition, np.ones(1))]
    experts = []
    weights = style_weights(model.styles, style, request.n_frames, request.fps)
    for k, weight in enumerate(weights.T):
        if np.abs(weight).max() > 0:
            styled = condition.copy()
            styled[..., first + k] = 1
            weight = weight[:1] if (weight == weight[0]).all() else weight
            experts.append(_expert(request, model, styled, weight))
    return experts


def _random_style(model: DiffusionModel, request: Request, number: int) -> int:
    """Return the random style of the sample with this number."""
    rng = rng_for(request.seed, request.item, "sample", number, "style")
    return int(torch.randint(len(model.styles), (), generator=rng))


def _states(request: Request, numbers: Sequence[int]) -> list[np.ndarray] | None:
    """Return the state of movement (C, T) of each sample, for all experts; None without any.

    It is drawn for the first model with a state, in its style.
    """
    if request.state is not None:
        return [request.state] * len(numbers)
    members = (member for member in request.members if member.model.state_process is not None)
    model, _, name = next(members, request.members[0])
    controls, process, style = request.controls, model.state_process, None
    if process is None:
        return None
    if model.styles and name is not None:
        weights = style_weights(model.styles, name, request.n_frames, request.fps)
        style = int(weights.sum(axis=0).argmax())
    speech = request.condition(model.conditions)[:, model.conditions.columns["speech"]].T
    seed = mood_seed(request.seed, controls)
    states = []
    for number in numbers:
        drawn_style = style
        if style is None and model.styles:
            drawn_style = _random_style(model, request, number)
        states.append(
            process.draw(
                rng_for(seed, request.item, "sample", number, "mood").initial_seed() >> 1,
                speech,
                (controls["speaker"], drawn_style),
                liveliness=controls["liveliness"],
            )
        )
    return states


def _with_state(
    expert: Expert, model: DiffusionModel, states: Sequence[np.ndarray] | None
) -> Expert:
    """Return the expert of a model with the state of movement (C, T) of each sample."""
    if states is None:
        return expert
    condition = expert.condition.repeat(len(states) // len(expert.condition), 1, 1)
    if model.state_process is not None:
        for row, state in zip(condition, states, strict=True):
            given = torch.from_numpy(model.state_process.given(state).T)
            row[:, model.conditions.columns["state"]] = given
    return replace(expert, condition=condition)
