"""Likeness: one number between 0 and 1 for how much a motion moves like the speaker.

It is the geometric mean of two: the mean credit of seven aspects of movement (hand speed, rests,
reach, contrast, smoothness, feet, direction of time), and the lower credit of postures and
movements (1-NN test) and of left and right. So neither noise with the speaker's statistics nor
recorded postures without the speaker's movement come to a high value. An aspect that is measured as
a ratio to the recording has the credit 1 within 0.8 to 1.25, 0 beyond 0.4 and 2.5, and falls
linearly in the logarithm between.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.statistics.thresholds import (
    FORWARD,
    FULL_CREDIT,
    NO_CREDIT,
    SIDED,
)

ASPECTS: dict[str, tuple[str, ...]] = {
    aspect: tuple(key for key, d in DEFINITIONS.items() if d.aspect == aspect)
    for aspect in (
        "hand speed",
        "rests",
        "reach",
        "contrast of calm and lively",
        "smoothness",
        "feet",
        "postures and movements",
        "direction of time",
        "left and right",
    )
}
"""Keys of `definitions` of each aspect."""
RATIOS = {k: d.ratio_floor for k, d in DEFINITIONS.items() if d.ratio_floor is not None}
"""Metrics that are compared as ratios, and what is added to both values."""
TWO_SAMPLE = ("postures and movements", "left and right")
"""Aspects that tell windows of motion from those of the recordings."""
MEASURES = tuple(key for keys in ASPECTS.values() for key in keys)
"""Keys of `definitions` from which likeness is computed."""


def credits(ours: Mapping[str, np.ndarray], own: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the credit of each aspect that is known, 0 to 1.

    Args:
        ours: {measure: values (...)} of the motion.
        own: the same of the recordings; only those in `RATIOS` are needed.
    """
    found: dict[str, list[np.ndarray]] = {}
    for aspect, keys in ASPECTS.items():
        for key in keys:
            if key in ours and (key not in RATIOS or key in own):
                found.setdefault(aspect, []).append(_credit(key, ours[key], own.get(key)))
    return {aspect: np.mean(values, axis=0) for aspect, values in found.items()}


def likeness(ours: Mapping[str, np.ndarray], own: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Return likeness; None if no aspect is known. Arguments as of `credits`."""
    return likeness_of_credits(credits(ours, own))


def likeness_of_credits(found: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Return the likeness (...) of {aspect: credits (...)}; None without any."""
    movement = [credit for aspect, credit in found.items() if aspect not in TWO_SAMPLE]
    windows = [found[aspect] for aspect in TWO_SAMPLE if aspect in found]
    sides = [np.mean(movement, axis=0)] if movement else []
    sides += [np.min(windows, axis=0)] if windows else []
    return np.prod(sides, axis=0) ** (1.0 / len(sides)) if sides else None


def _credit(key: str, ours: np.ndarray, own: np.ndarray | None) -> np.ndarray:
    if key == "one_nn":
        return np.clip(2.0 * (1.0 - np.asarray(ours)), 0.0, 1.0)
    if key == "forward":
        return np.clip(np.asarray(ours) / FORWARD, 0.0, 1.0)
    if key == "sided":
        return np.clip((np.asarray(ours) - SIDED[0]) / (SIDED[1] - SIDED[0]), 0.0, 1.0)
    floor, full, none = RATIOS[key], np.log(FULL_CREDIT), np.log(NO_CREDIT)
    ratio = np.abs(np.log((np.asarray(ours) + floor) / (np.asarray(own) + floor)))
    return np.clip((none - ratio) / (none - full), 0.0, 1.0)
