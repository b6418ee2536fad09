"""Expert weights over time, from the style control or from numbers, arrays and spans in seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from gesturekit.corpus.speech import style_number, style_track
from gesturekit.diffusion.sampling.experts import SUM_TOLERANCE, Weight, checked_weight
from gesturekit.errors import ModelError

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
    asked = ",".join(f"{label}@{span}" for label, span in zip(labels, spans, strict=True))
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


ExpertWeight = Weight | str | None
"""The forms of an expert's weight; see `weights_over_time`."""

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
    values, spans = [], []
    for part in text.split(","):
        match = _SPAN.fullmatch(part.strip())
        if match is None:
            raise ModelError(
                f"weight {part.strip()!r}: weights over time look like 0.2@0-10,0.8@10-20"
            )
        if float(match["end"]) <= float(match["start"]):
            raise ModelError(f"weight {part.strip()!r}: the span ends before it begins")
        values.append(float(match["weight"]))
        spans.append((match["start"], match["end"]))
    reached = 0.0
    for start, end in sorted(spans, key=lambda span: float(span[0])):
        if float(start) > reached:
            values.append(0.0)
            spans.append((f"{reached:f}", start))
        reached = max(reached, float(end))
    if n_frames / fps > reached:
        values.append(0.0)
        spans.append((f"{reached:f}", f"{reached + n_frames / fps:f}"))
    names = [str(k) for k in range(len(spans))]
    asked = ",".join(f"{k}@{start}-{end}" for k, (start, end) in zip(names, spans, strict=True))
    return style_track(names, asked, n_frames, fps).astype(np.float64) @ np.array(values)


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
    read = [weight_track(w, n_frames, fps) if isinstance(w, str) else w for w in given]
    own = [None if weight is None else checked_weight(weight, n_frames) for weight in read]
    rest = np.ones(1) - sum(weight for weight in own if weight is not None)
    shares = sum(weight is None for weight in own)
    return [rest / shares if weight is None else weight for weight in own]
