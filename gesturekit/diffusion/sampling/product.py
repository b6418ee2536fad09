"""Product of several models, each with a weight, a style and conditions.

A model with several styles is one expert per style; classifier-free guidance adds one more expert,
with the style dropped.

Noise is predicted in normalised motion. Models with different means can be combined: the noisy
motion is shifted to the mean of each, and its noise stays the same. Models with different scales
cannot: the same noise would have a different size for each of them. Two models can be combined if
one was trained from the other (`start_from`), with the other's motion vectors (`moves_like`), or on
the same recordings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.corpus.checks import first_difference
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.sampling.drawn_state import DrawnState, drawn_style
from gesturekit.diffusion.sampling.expert_weights import (
    ExpertWeight,
    style_weights,
    weight_track,
    weights_over_time,
)
from gesturekit.diffusion.sampling.experts import Expert, ProductOfExperts
from gesturekit.diffusion.sampling.request import Request
from gesturekit.diffusion.trained_model import TrainedModel
from gesturekit.errors import ModelError

_SCALE_TOLERANCE = 1e-4
"""Largest relative difference between the scales of two models that can be combined."""


@dataclass(frozen=True, eq=False)
class Term:
    """One term of a product: a model with its condition and weight.

    Attributes:
        model: the model with the network.
        shift: see `Expert`.
        condition: (T, C).
        weight: a number, or (T,).
        draws_style: whether each sample gets a random style.
        state: the state of movement of each sample; None without.
    """

    model: TrainedModel
    shift: Tensor | None
    condition: np.ndarray
    weight: float | np.ndarray
    draws_style: bool = False
    state: DrawnState | None = None

    def expert(self, seed: int, item: str, numbers: Sequence[int]) -> Expert:
        """Return the expert for the samples of an item with these numbers."""
        condition = torch.from_numpy(self.condition)[None]
        if self.draws_style or self.state is not None:
            condition = condition.repeat(len(numbers), 1, 1)
        columns, process = self.model.conditions.columns, self.model.state_process
        for own, number in zip(condition, numbers, strict=False):
            if self.draws_style:
                drawn = drawn_style(len(self.model.styles), seed, item, number)
                own[:, columns["styles"].start + drawn] = 1
            if self.state is not None and process is not None:
                given = process.given(self.state.of_sample(seed, item, number))
                own[:, columns["state"]] = torch.from_numpy(given.T)
        device = self.model.device
        shift = None if self.shift is None else self.shift.to(device)
        return Expert(self.model.network, self.model.schedule, condition.to(device), shift)


def product_of(
    terms: Sequence[Term], seed: int, item: str, numbers: Sequence[int]
) -> ProductOfExperts:
    """Return the product of experts for the samples of an item with these numbers."""
    experts = [term.expert(seed, item, numbers) for term in terms]
    return ProductOfExperts(experts, [term.weight for term in terms])


@dataclass(frozen=True, eq=False)
class ModelProduct:
    """Models with weights and styles.

    Attributes:
        models: of one rig. The first is the model of the request; the last is the unconditional
            model, if that is another one.
        weights: of all models but the unconditional one; models with None share the remaining
            weight equally.
        styles: style of each of these models; None for a random style.
        guidance: gamma of classifier-free guidance for the first model; None for no guidance.
        state_guidance: gamma of its guidance on the state of movement; None for no guidance.
        unconditional: the unconditional model; None for the first model with conditions dropped.
    """

    models: tuple[TrainedModel, ...]
    weights: tuple[ExpertWeight, ...]
    styles: tuple[str | None, ...]
    guidance: float | None
    state_guidance: float | None
    unconditional: TrainedModel | None

    @classmethod
    def build(cls, first: TrainedModel, controls: DiffusionControls) -> ModelProduct:
        """Collect and check the models of a request.

        An expert without a style gets the style of the first model if it has that style, and a
        random one otherwise.

        Raises:
            ModelError: models that cannot be combined, weights over time that cannot be read, or
                guidance that none of the models supports.
        """
        style, unconditional = controls["style"], controls["unconditional"]
        for number, expert in enumerate(controls["experts"], start=1):
            if not 1 <= len(expert) <= 3:
                raise ModelError(f"expert {number}: expected (model, weight) or + (style,)")
            _check_compatible(first, expert[0], f"expert {number}")
            if isinstance((*expert, None)[1], str):
                weight_track(expert[1], 1, first.fps)
        if unconditional is not None:
            if controls["guidance"] is None:
                raise ModelError("unconditional: only used with guidance; give guidance too")
            unconditional = _check_compatible(first, unconditional, "unconditional")
        _check_guidance(first, controls["guidance"], unconditional)
        experts = [(*expert, None, None)[:3] for expert in controls["experts"]]
        models = (first, *(model for model, _, _ in experts))
        if style is not None and not any(model.styles for model in models):
            raise ModelError(f"style={style!r}: this model has no styles")
        styles = (
            own if own is not None else style if _knows(model, style) else None
            for model, _, own in experts
        )
        return cls(
            (*models, *(() if unconditional is None else (unconditional,))),
            (None, *(weight for _, weight, _ in experts)),
            (style, *styles),
            controls["guidance"],
            controls["state_guidance"],
            unconditional,
        )

    def check_styles(self) -> None:
        """Raise ModelError if a model does not have its requested style."""
        for model, style in zip(self.models, self.styles, strict=False):
            if model.styles and style is not None:
                style_weights(model.styles, style, 1, model.fps)

    def terms(self, request: Request) -> list[Term]:
        """Return the terms of the product for a request."""
        terms: list[Term] = []
        state = DrawnState.of(self.models, self.styles, request)
        weights = weights_over_time(self.weights, request.n_frames, request.fps)
        members = zip(self.models, weights, self.styles, strict=False)
        for k, (model, weight, style) in enumerate(members):
            own = [replace(term, state=state) for term in self._styled(model, style, request)]
            if k == 0:
                own = self._guided(own, request)
            terms += [replace(term, weight=weight * term.weight) for term in own]
        return terms

    def _styled(self, model: TrainedModel, style: str | None, request: Request) -> list[Term]:
        """Return a model's terms, one for each style with a weight."""
        shift, condition = _shift(self.models[0], model), request.condition(model.conditions)
        if not model.styles or style is None:
            return [Term(model, shift, condition, 1.0, bool(model.styles))]
        weights = style_weights(model.styles, style, request.n_frames, request.fps)
        first = model.conditions.columns["styles"].start
        terms = []
        for k, weight in enumerate(weights.T):
            if np.abs(weight).max() > 0:
                own = condition.copy()
                own[:, first + k] = 1
                constant = bool((weight == weight[0]).all())
                weight = float(weight[0]) if constant else weight
                terms.append(Term(model, shift, own, weight))
        return terms

    def _guided(self, terms: list[Term], request: Request) -> list[Term]:
        """Apply classifier-free guidance (eq. 6): gamma - 1 more with the style, 1 - gamma without.

        Guidance on the state of movement is the same beside it, with and without the state.
        """
        guided = list(terms)
        if (gamma := self.guidance) is not None:
            model = self.unconditional or self.models[0]
            condition = request.condition(model.conditions)
            if self.unconditional is None and not ("styles" in model.droppable and model.styles):
                condition = model.conditions.without(condition)
            shift = _shift(self.models[0], model)
            guided += [
                Term(model, shift, condition, 1 - gamma, state=terms[0].state),
                *(replace(term, weight=(gamma - 1) * term.weight) for term in terms),
            ]
        if (gamma := self.state_guidance) is not None:
            for term in terms:
                guided += [
                    replace(term, weight=(1 - gamma) * term.weight, state=None),
                    replace(term, weight=(gamma - 1) * term.weight),
                ]
        return guided


def _knows(model: TrainedModel, style: str | None) -> bool:
    if style is None or not model.styles:
        return False
    try:
        style_weights(model.styles, style, 1, model.fps)
    except ModelError:
        return False
    return True


def _check_guidance(
    first: TrainedModel, guidance: float | None, unconditional: TrainedModel | None
) -> None:
    if guidance is None:
        return
    if unconditional is not None:
        if unconditional.styles and not {"styles", "all"} & set(unconditional.droppable):
            raise ModelError(
                "unconditional: that model needs a style too; give one trained with styles: null"
            )
        return
    if not first.conditions.columns["state"].start:
        raise ModelError(f"guidance={guidance:g}: this model has no conditions to guide on")
    if not ("all" in first.droppable or (first.styles and "styles" in first.droppable)):
        what = "style" if first.styles else "condition"
        raise ModelError(
            f"guidance={guidance:g}: this model was trained without {what} dropout "
            f"(training.dropout_{what} above 0); give an unconditional model beside it"
        )


def _check_compatible(first: TrainedModel, other: Any, who: str) -> TrainedModel:
    """Return the other model; raise ModelError if the numbers of their motion vectors differ in
    meaning."""
    kind = getattr(other, "kind", type(other).__name__)
    if kind != first.kind:
        raise ModelError(f"{who}: a {kind} model; only diffusion models can be combined")
    if other.device != first.device:
        raise ModelError(
            f"{who}: is on {other.device}, this model on {first.device}; load both on one device"
        )
    if other.fps != first.fps:
        raise ModelError(f"{who}: moves at {other.fps:g} fps, this model at {first.fps:g}")
    theirs, own = other.representation, first.representation
    different = first_difference(other.skeleton, first.skeleton)
    if different:
        raise ModelError(f"{who}: another rig: {different}")
    if theirs.joints != own.joints:
        raise ModelError(
            f"{who}: its {len(theirs.joints)} joints are not the {len(own.joints)} of this model; "
            "experts of a product need the same joints"
        )
    if theirs.makes_root != own.makes_root:
        raise ModelError(f"{who}: only one of the two follows a path")
    advice = "train one with moves_like: the other, so that both use the same motion vectors"
    if not math.isclose(theirs.scale, own.scale, rel_tol=_SCALE_TOLERANCE):
        raise ModelError(f"{who}: its lengths are relative to another body size; {advice}")
    if not np.allclose(theirs.references, own.references, atol=1e-6) or not np.allclose(
        theirs.side, own.side, atol=1e-6
    ):
        raise ModelError(f"{who}: its rotations are relative to other mean rotations; {advice}")
    ratio = other.normaliser.scale / first.normaliser.scale
    worst = float(ratio[(ratio.log().abs()).argmax()])
    if not abs(worst - 1) <= _SCALE_TOLERANCE:
        raise ModelError(
            f"{who}: its motion is normalised with another scale (by up to a factor of "
            f"{worst:.3g}); {advice}"
        )
    return other


def _shift(first: TrainedModel, model: TrainedModel) -> Tensor | None:
    """Return the `Expert.shift` (X,) of a model; None if both have the same mean."""
    if torch.equal(first.normaliser.mean, model.normaliser.mean):
        return None
    return (first.normaliser.mean - model.normaliser.mean) / first.normaliser.scale
