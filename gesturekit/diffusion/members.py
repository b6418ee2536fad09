"""Models of a product with their weights and styles over time, as a request asks for them.

Weights are read from the style control, or from numbers, arrays and spans in seconds. Two models
can be combined if one was trained from the other (`start_from`), with the other's motion vectors
(`moves_like`), or on the same recordings.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gesturekit.corpus.checks import first_difference
from gesturekit.corpus.speech import style_number, style_track
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.errors import ModelError

if TYPE_CHECKING:
    from gesturekit.diffusion.model import DiffusionModel

SUM_TOLERANCE = 1e-5
"""Largest rounding error of the sum of the weights."""

_SCALE_TOLERANCE = 1e-4
"""Largest relative difference between the scales of two models that can be combined."""

ExpertWeight = float | np.ndarray | str | None
"""The forms of an expert's weight; see `weights_over_time`."""


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
        _compatible(first, model, f"expert {number}")
        if isinstance(weight, str):
            weight_track(weight, 1, first.fps)
        inherited = style if _knows(model, style) else None
        members.append(Member(model, weight, inherited if named is None else named))
    if style is not None and not any(member.model.styles for member in members):
        raise ModelError(f"style={style!r}: this model has no styles")
    _check_guidance(first, controls)
    for model, _, name in members:
        if model.styles and name is not None:
            style_weights(model.styles, name, 1, model.fps)
    return members


def _knows(model: DiffusionModel, style: str | None) -> bool:
    if style is None or not model.styles:
        return False
    try:
        style_weights(model.styles, style, 1, model.fps)
    except ModelError:
        return False
    return True


def _check_guidance(first: DiffusionModel, controls: DiffusionControls) -> None:
    guidance, unconditional = controls["guidance"], controls["unconditional"]
    if (gamma := controls["state_guidance"]) is not None and "state" not in first.droppable:
        raise ModelError(
            f"state_guidance={gamma:g}: this model was trained without dropout of the state "
            "(training.dropout_state above 0)"
        )
    if unconditional is not None:
        if guidance is None:
            raise ModelError("unconditional: only used with guidance; give guidance too")
        model = _compatible(first, unconditional, "unconditional")
        if model.styles and not {"styles", "all"} & set(model.droppable):
            raise ModelError(
                "unconditional: that model needs a style too; give one trained with styles: null"
            )
    elif guidance is not None:
        if not first.conditions.columns["state"].start:
            raise ModelError(f"guidance={guidance:g}: this model has no conditions to guide on")
        if not ("all" in first.droppable or (first.styles and "styles" in first.droppable)):
            what = "style" if first.styles else "condition"
            raise ModelError(
                f"guidance={guidance:g}: this model was trained without {what} dropout "
                f"(training.dropout_{what} above 0); give an unconditional model beside it"
            )


def _compatible(first: DiffusionModel, other: Any, who: str) -> DiffusionModel:
    """Return the other model; raise ModelError if the two cannot be combined."""
    if reason := next(_differences(first, other), None):
        raise ModelError(f"{who}: {reason}")
    return other


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


_TERM = re.compile(
    r"(?P<name>.+?)(:(?P<weight>[-+]?(\d+(\.\d*)?|\.\d+)))?(@(?P<span>\d+(\.\d+)?-\d+(\.\d+)?))?"
)


def style_weights(names: Sequence[str], wanted: str, n_frames: int, fps: float) -> np.ndarray:
    """Return the weights (T, K) float64 of the styles over time, which add up to 1.

    Args:
        names: the model's K styles.
        wanted: one style (`old`); several with weights (`old:0.25,angry:0.75`), which may be below
            0 or above 1 (`old:-0.25,angry:1.25`); spans in seconds (`old@0-10,angry@10-20`), which
            are cross-faded as in `style_track`; or weights in spans
            (`old:0.5@0-10,angry:0.5@0-10,angry@10-20`).
        n_frames: T.
        fps: frames per second.

    Raises:
        ModelError: an unknown style, a text that cannot be read, or weights that do not add up to 1
            in some span.
    """
    spans: dict[str, dict[int, float | None]] = {}
    for text in [wanted] if wanted in names else wanted.split(","):
        name, weight, span = _read(names, text.strip())
        spans.setdefault(span, {})
        number = style_number(names, name)
        if number in spans[span]:
            raise ModelError(f"style {wanted!r}: {name} is named twice for the same time")
        spans[span][number] = weight
    if "" in spans and len(spans) > 1:
        raise ModelError(
            f"style {wanted!r}: some styles have a span of seconds and some have none; give all "
            "or none of them one, as in old@0-10,angry@10-20"
        )
    mixtures = np.zeros((len(spans), len(names)))
    for row, weights in zip(mixtures, spans.values(), strict=True):
        row[list(weights)] = _complete(wanted, list(weights.values()))
    if "" in spans:
        return np.repeat(mixtures, n_frames, axis=0)
    labels = [str(k) for k in range(len(spans))]
    asked = ",".join(f"{k}@{span}" for k, span in enumerate(spans))
    return style_track(labels, asked, n_frames, fps).astype(np.float64) @ mixtures


def _read(names: Sequence[str], text: str) -> tuple[str, float | None, str]:
    """Return name, weight and span of one style; names may contain colons."""
    match = _TERM.fullmatch(text)
    if text in names or match is None:
        return text, None, ""
    name, weight = match["name"], match["weight"]
    if weight is not None and f"{name}:{weight}" in names:
        name, weight = f"{name}:{weight}", None
    return name, None if weight is None else float(weight), match["span"] or ""


def _complete(wanted: str, weights: list[float | None]) -> list[float]:
    """Return the weights of one span; without any, all styles share equally."""
    given = [weight for weight in weights if weight is not None]
    if not given:
        return [1 / len(weights)] * len(weights)
    if len(given) < len(weights):
        raise ModelError(f"style {wanted!r}: some styles have a weight and some have none")
    if abs(sum(given) - 1) > SUM_TOLERANCE:
        raise ModelError(f"style {wanted!r}: weights add up to {sum(given):g}; they must give 1")
    return given


_SPAN = re.compile(
    r"(?P<weight>[-+]?(\d+(\.\d*)?|\.\d+))@(?P<start>\d+(\.\d+)?)-(?P<end>\d+(\.\d+)?)"
)


def weight_track(text: str, n_frames: int, fps: float) -> np.ndarray:
    """Return weights (T,) float64 given as spans in seconds: `0.2@0-10,0.8@10-20`.

    Neighbouring spans are cross-faded like styles (`style_track`), and overlapping spans averaged.
    Outside of all spans the weight is 0.

    Raises:
        ModelError: a text that cannot be read, or a span that ends before it begins.
    """
    spans = []
    for span in map(str.strip, text.split(",")):
        match = _SPAN.fullmatch(span)
        if match is None:
            raise ModelError(f"weight {span!r}: weights over time look like 0.2@0-10,0.8@10-20")
        if float(match["end"]) <= float(match["start"]):
            raise ModelError(f"weight {span!r}: the span ends before it begins")
        spans.append((float(match["weight"]), match["start"], match["end"]))
    reached = 0.0
    for _, start, end in sorted(spans, key=lambda span: float(span[1])):
        if float(start) > reached:
            spans.append((0.0, f"{reached:f}", start))
        reached = max(reached, float(end))
    if n_frames / fps > reached:
        spans.append((0.0, f"{reached:f}", f"{reached + n_frames / fps:f}"))
    names = [str(k) for k in range(len(spans))]
    asked = ",".join(f"{k}@{start}-{end}" for k, (_, start, end) in enumerate(spans))
    weights = np.array([weight for weight, _, _ in spans])
    return style_track(names, asked, n_frames, fps).astype(np.float64) @ weights


def weights_over_time(given: Sequence[ExpertWeight], n_frames: int, fps: float) -> list[np.ndarray]:
    """Return the weight of each expert: (1,) if it is constant, else (T,).

    Args:
        given: numbers, arrays (T,), texts (see `weight_track`), or None for an equal share of the
            remaining weight.
        n_frames: T.
        fps: frames per second.

    Raises:
        ModelError: a text that cannot be read, or weights that do not fit the frames.
    """
    weights: list[np.ndarray | None] = []
    for weight in given:
        if isinstance(weight, str):
            weight = weight_track(weight, n_frames, fps)
        values = None if weight is None else np.atleast_1d(np.asarray(weight, dtype=np.float64))
        if values is not None and values.shape not in ((1,), (n_frames,)):
            raise ModelError(
                f"weights of an expert have shape {values.shape}; expected a number or "
                f"({n_frames},), one for each frame"
            )
        weights.append(values)
    rest = np.ones(1) - sum(weight for weight in weights if weight is not None)
    shares = sum(weight is None for weight in weights)
    return [rest / shares if weight is None else weight for weight in weights]
