"""Expert weights over time: a number, one number per frame, or spans in seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from gesturekit.corpus.styles import style_track
from gesturekit.diffusion.composition.experts import Weight, checked_weight
from gesturekit.errors import ModelError

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
