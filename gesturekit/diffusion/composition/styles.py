"""Parsing of the style control into expert weights over time."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from gesturekit.corpus.styles import style_number, style_track
from gesturekit.diffusion.composition.experts import SUM_TOLERANCE
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
