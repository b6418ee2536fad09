"""The models that make a motion together, each with its weight and with what it is told.

A model that is told several styles takes part once for each; with guidance once more, told less.
All of them become experts of one `Mixture`.

Noise is predicted in standardised motion. Models that standardise about other means still mix: one
is shifted to the other, and the noise in it stays the same. Where numbers are scaled otherwise,
noise that is alike for one model is not for another, and a network has never learnt to take noise
of another size from each number: such models are refused. They go together where one is trained
from the other (`start_from`) or both learn from the same recordings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gesturekit.corpus.checks import first_difference
from gesturekit.diffusion.composition.experts import Expert, Mixture
from gesturekit.diffusion.composition.styles import style_weights
from gesturekit.diffusion.composition.weights import Share, weight_track, weights_over_time
from gesturekit.diffusion.sampling.request import Request
from gesturekit.errors import ModelError
from gesturekit.training.seeds import rng_for

if TYPE_CHECKING:
    from gesturekit.diffusion.model import DiffusionModel

_SCALE_TOLERANCE = 1e-4
"""Share by which two models may scale a number differently and still mean the same."""


@dataclass(frozen=True, eq=False)
class Term:
    """A model that takes part in a product.

    Attributes:
        model: whose network it is.
        shift: see `Expert`.
        rows: (T, C) what it is told.
        weight: a number, or (T,).
        draws_style: whether each sample is told a style by chance.
    """

    model: DiffusionModel
    shift: Tensor | None
    rows: np.ndarray
    weight: float | np.ndarray
    draws_style: bool = False

    def expert(self, seed: int, numbers: Sequence[int]) -> Expert:
        """The expert for these samples."""
        rows = torch.from_numpy(self.rows)[None]
        if self.draws_style:
            rows = rows.repeat(len(numbers), 1, 1)
            first = self.model.conditions.columns["styles"].start
            for row, number in zip(rows, numbers, strict=True):
                rng = rng_for(seed, "sample", number, "style")
                drawn = int(torch.randint(len(self.model.styles), (), generator=rng))
                row[:, first + drawn] = 1
        device = self.model.device
        shift = None if self.shift is None else self.shift.to(device)
        return Expert(self.model.network, self.model.schedule, rows.to(device), shift)


@dataclass(frozen=True, eq=False)
class Told:
    """A product whose models have been told what to do."""

    terms: tuple[Term, ...]

    def mixture(self, seed: int, numbers: Sequence[int]) -> Mixture:
        """The mixture for these samples."""
        experts = [term.expert(seed, numbers) for term in self.terms]
        return Mixture(experts, [term.weight for term in self.terms])


@dataclass(frozen=True, eq=False)
class Product:
    """Models with weights, styles and shifts; the first one leads.

    Attributes:
        models: of one rig; the one that guidance leads away from is the last, if it is not the
            first.
        weights: of all but that one; None for an equal share of what the others leave of 1.
        styles: that each of them is asked for; None for one by chance.
        guidance: of the first; None for none.
        unconditional: what guidance leads away from.
    """

    models: tuple[DiffusionModel, ...]
    weights: tuple[Share, ...]
    styles: tuple[str | None, ...]
    guidance: float | None
    unconditional: DiffusionModel | None

    @classmethod
    def of(
        cls,
        leader: DiffusionModel,
        style: str | None,
        guidance: float | None,
        unconditional: DiffusionModel | None,
        experts: Sequence[tuple],
    ) -> Product:
        """Settle who takes part, before anything is computed.

        Args:
            leader: the model that is asked.
            style: for all that know it.
            guidance: of the leader.
            unconditional: what that leads away from; None for the leader itself.
            experts: (model, weight), (model, weight, style) for further models. A weight may be
                one for each frame, a text of weights over time (see `weight_track`), or None: the
                leader and all experts without weight share equally what is left of 1. Without a
                style, an expert has that of the leader where it knows it, and is else told one by
                chance.

        Raises:
            ModelError: models that do not go together, weights over time that cannot be read, or
                guidance that none of them can give.
        """
        for number, expert in enumerate(experts, start=1):
            if not 1 <= len(expert) <= 3:
                raise ModelError(f"expert {number}: expected (model, weight) or + (style,)")
            _check_goes_with(leader, expert[0], f"expert {number}")
            if isinstance((*expert, None)[1], str):
                weight_track(expert[1], 1, leader.fps)
        if unconditional is not None:
            if guidance is None:
                raise ModelError("unconditional: goes with guidance, which leads away from it")
            _check_goes_with(leader, unconditional, "unconditional")
        _check_guidance(leader, guidance, unconditional)
        own = [(*expert, None, None)[:3] for expert in experts]
        models = (leader, *(model for model, _, _ in own))
        styles = (style, *(theirs if theirs is not None else style for _, _, theirs in own))
        if style is not None and not any(model.styles for model in models):
            raise ModelError(f"style={style!r}: this model knows no styles")
        styles = tuple(
            wanted if not k or own[k - 1][2] is not None or _knows(model, wanted) else None
            for k, (model, wanted) in enumerate(zip(models, styles, strict=True))
        )
        return cls(
            (*models, *(() if unconditional is None else (unconditional,))),
            (None, *(weight for _, weight, _ in own)),
            styles,
            guidance,
            unconditional,
        )

    def check_styles(self) -> None:
        """Raises ModelError for a style that a model which is asked for it does not know."""
        for model, style in zip(self.models, self.styles, strict=False):
            if model.styles and style is not None:
                style_weights(model.styles, style, 1, model.fps)

    def told(self, request: Request) -> Told:
        """Tell each model what was asked."""
        terms: list[Term] = []
        weights = weights_over_time(self.weights, request.n_frames, request.fps)
        members = zip(self.models, weights, self.styles, strict=False)
        for k, (model, weight, style) in enumerate(members):
            own = self._styled(model, style, request)
            if k == 0 and self.guidance is not None:
                own = self._guided(own, request)
            terms += [replace(term, weight=weight * term.weight) for term in own]
        return Told(tuple(terms))

    def _styled(self, model: DiffusionModel, style: str | None, request: Request) -> list[Term]:
        """A model's terms, one for each style that has any weight."""
        shift, rows = _shift(self.models[0], model), request.told(model.conditions)
        if not model.styles or style is None:
            return [Term(model, shift, rows, 1.0, bool(model.styles))]
        weights = style_weights(model.styles, style, request.n_frames, request.fps)
        first = model.conditions.columns["styles"].start
        terms = []
        for k, weight in enumerate(weights.T):
            if np.abs(weight).max() > 0:
                told = rows.copy()
                told[:, first + k] = 1
                constant = bool((weight == weight[0]).all())
                terms.append(Term(model, shift, told, float(weight[0]) if constant else weight))
        return terms

    def _guided(self, terms: list[Term], request: Request) -> list[Term]:
        """(1 - gamma) of the prediction without, gamma of that with."""
        model = self.unconditional or self.models[0]
        rows = request.told(model.conditions)
        if self.unconditional is None and not ("styles" in model.droppable and model.styles):
            rows = model.conditions.without(rows)
        return [
            Term(model, _shift(self.models[0], model), rows, 1 - self.guidance),
            *(replace(term, weight=self.guidance * term.weight) for term in terms),
        ]


def _knows(model: DiffusionModel, style: str | None) -> bool:
    if style is None or not model.styles:
        return False
    try:
        style_weights(model.styles, style, 1, model.fps)
    except ModelError:
        return False
    return True


def _check_guidance(
    leader: DiffusionModel, guidance: float | None, unconditional: DiffusionModel | None
) -> None:
    if guidance is None:
        return
    if not math.isfinite(guidance):
        raise ModelError(f"guidance={guidance}: give a finite number, such as 1.5")
    if unconditional is not None:
        if unconditional.styles and not {"styles", "all"} & set(unconditional.droppable):
            raise ModelError(
                "unconditional: that model must be told a style too; give one trained with "
                "styles: null"
            )
        return
    if not leader.conditions.width:
        raise ModelError(f"guidance={guidance:g}: this model is told nothing that it could follow")
    if not ("all" in leader.droppable or (leader.styles and "styles" in leader.droppable)):
        what = "its style" if leader.styles else "what it is told"
        setting = "dropout_style" if leader.styles else "dropout_condition"
        raise ModelError(
            f"guidance={guidance:g}: this model was never trained without {what} "
            f"(training.{setting} above 0); give an unconditional model beside it"
        )


def _check_goes_with(leader: DiffusionModel, other: DiffusionModel, who: str) -> None:
    """Experts of a product must mean the same by the numbers of a motion vector."""
    kind = getattr(other, "kind", type(other).__name__)
    if kind != leader.kind:
        raise ModelError(f"{who}: a {kind} model; only diffusion models can be multiplied")
    if other.fps != leader.fps:
        raise ModelError(f"{who}: moves at {other.fps:g} fps, this model at {leader.fps:g}")
    theirs, own = other.representation, leader.representation
    different = first_difference(other.skeleton, leader.skeleton)
    if different:
        raise ModelError(f"{who}: another rig: {different}")
    if theirs.joints != own.joints:
        raise ModelError(
            f"{who}: it models {len(theirs.joints)} joints, this model {len(own.joints)}, or "
            "others; experts of a product need the same joints"
        )
    if theirs.makes_root != own.makes_root:
        raise ModelError(f"{who}: only one of the two follows a path")
    advice = "train one with moves_like: the other, so that both mean the same by a motion"
    if not math.isclose(theirs.scale, own.scale, rel_tol=_SCALE_TOLERANCE):
        raise ModelError(f"{who}: its lengths are those of another body size; {advice}")
    if not np.allclose(theirs.references, own.references, atol=1e-6) or not np.allclose(
        theirs.side, own.side, atol=1e-6
    ):
        raise ModelError(f"{who}: its joints turn about other mean rotations; {advice}")
    ratio = other.standardiser.scale / leader.standardiser.scale
    worst = float(ratio[(ratio.log().abs()).argmax()])
    if not abs(worst - 1) <= _SCALE_TOLERANCE:
        raise ModelError(
            f"{who}: its motion is standardised on another scale (by up to a factor of "
            f"{worst:.3g}); {advice}"
        )


def _shift(leader: DiffusionModel, model: DiffusionModel) -> Tensor | None:
    """See `Expert.shift`: nothing where both standardise about the same mean."""
    if torch.equal(leader.standardiser.mean, model.standardiser.mean):
        return None
    return (leader.standardiser.mean - model.standardiser.mean) / leader.standardiser.scale
