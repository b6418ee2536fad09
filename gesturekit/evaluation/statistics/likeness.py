"""Likeness: one number between 0 and 1 for how much a motion moves like the speaker.

Eight aspects have equal weight: hand speed (four quantiles), rests, reach, range, jerk, feet, 1-NN
test and the direction of time. An aspect that is measured as a ratio to the recording has the
credit 1 within 0.8 to 1.25, 0 beyond 0.4 and 2.5, and falls linearly in the logarithm between.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.statistics.thresholds import (
    FORWARD,
    FULL_CREDIT,
    MOST_ONE_NN,
    NO_CREDIT,
    USUAL_ONE_NN,
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
    )
}
"""Keys of `definitions` of each aspect."""
RATIOS = {k: d.ratio_floor for k, d in DEFINITIONS.items() if d.ratio_floor is not None}
"""Metrics that are compared as ratios, and what is added to both values."""
MEASURES = tuple(key for keys in ASPECTS.values() for key in keys)
"""Keys of `definitions` from which likeness is computed."""


def credits(
    ours: Mapping[str, np.ndarray], own: Mapping[str, np.ndarray], own_one_nn: float = USUAL_ONE_NN
) -> dict[str, np.ndarray]:
    """Return the credit of each aspect that is known, 0 to 1.

    Args:
        ours: {measure: values (...)} of the motion.
        own: the same of the recordings; only those in `RATIOS` are needed.
        own_one_nn: 1-NN accuracy with full credit.
    """
    found: dict[str, list[np.ndarray]] = {}
    for aspect, keys in ASPECTS.items():
        for key in keys:
            if key in ours and (key not in RATIOS or key in own):
                credit = _credit(key, ours[key], own.get(key), own_one_nn)
                found.setdefault(aspect, []).append(credit)
    return {aspect: np.mean(values, axis=0) for aspect, values in found.items()}


def likeness(
    ours: Mapping[str, np.ndarray], own: Mapping[str, np.ndarray], own_one_nn: float = USUAL_ONE_NN
) -> np.ndarray | None:
    """Return the mean credit of all aspects; None if none is known. Arguments as of `credits`."""
    found = credits(ours, own, own_one_nn)
    return np.mean(list(found.values()), axis=0) if found else None


def _credit(key: str, ours: np.ndarray, own: np.ndarray | None, own_one_nn: float) -> np.ndarray:
    if key == "one_nn":
        full = np.clip(own_one_nn, USUAL_ONE_NN, MOST_ONE_NN)
        return np.clip((1.0 - np.asarray(ours)) / (1.0 - full), 0.0, 1.0)
    if key == "forward":
        return np.clip(np.asarray(ours) / FORWARD, 0.0, 1.0)
    floor, full, none = RATIOS[key], np.log(FULL_CREDIT), np.log(NO_CREDIT)
    ratio = np.abs(np.log((np.asarray(ours) + floor) / (np.asarray(own) + floor)))
    return np.clip((none - ratio) / (none - full), 0.0, 1.0)
