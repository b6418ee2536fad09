"""Styles over time.

A style is one-hot over the style names of a corpus. It may change over time, with blends.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from gesturekit.errors import ModelError

BLEND_SECONDS = 1.0
"""Length of the transition from one style to the next, centred on the border."""

_SPAN = re.compile(r"(?P<name>.+)@(?P<start>\d+(\.\d+)?)-(?P<end>\d+(\.\d+)?)")


def style_track(names: Sequence[str], wanted: str, n_frames: int, fps: float) -> np.ndarray:
    """Return (T, K) float32 weights of the styles over time; each row adds up to 1.

    Args:
        names: the K styles.
        wanted: one of them, or spans of seconds: `old@0-10,angry@10-20`. Outside all spans the
            nearest one applies; overlapping spans have equal weights.
        n_frames: T.
        fps: frames per second.

    Raises:
        ModelError: an unknown style, or a span that cannot be read.
    """
    track = np.zeros((n_frames, len(names)), np.float32)
    if "@" not in wanted:
        track[:, style_number(names, wanted)] = 1.0
        return track
    time = np.arange(n_frames) / fps
    apart, numbers = [], []
    for text in wanted.split(","):
        match = _SPAN.fullmatch(text.strip())
        if match is None:
            raise ModelError(f"style {text.strip()!r}: spans look like old@0-10,angry@10-20")
        start, end = float(match["start"]), float(match["end"])
        if end <= start:
            raise ModelError(f"style {text.strip()!r}: the span ends before it begins")
        numbers.append(style_number(names, match["name"]))
        apart.append(np.maximum(np.maximum(start - time, time - end + 0.5 / fps), 0.0))
    holds = np.stack(apart) <= np.min(apart, axis=0) + 1e-6
    for number, now in zip(numbers, holds, strict=True):
        track[:, number] += now
    track /= track.sum(axis=1, keepdims=True)
    # A running mean of this length turns every border into a linear ramp.
    reach = math.floor(BLEND_SECONDS * fps / 2)
    around = np.pad(track, ((reach, reach), (0, 0)), mode="reflect")
    return np.lib.stride_tricks.sliding_window_view(around, 2 * reach + 1, axis=0).mean(axis=-1)


def style_number(names: Sequence[str], name: str) -> int:
    """Return the index of a style.

    Raises:
        ModelError: an unknown style.
    """
    if name not in names:
        raise ModelError(f"style {name!r}: unknown; the model has {', '.join(names) or 'none'}")
    return list(names).index(name)
