"""Bootstrap confidence intervals over independent samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

LEVEL = 0.95
RESAMPLES = 2000
FEW = 5
"""Least number of units for an interval without a warning."""


@dataclass(frozen=True)
class Interval:
    """A mean and its percentile bootstrap interval.

    Attributes:
        value: the mean over units.
        low, high: 95 % interval; None for a single unit.
        n: number of clips.
        units: number of resampled units.
        over: kind of unit: "recordings" (the mean of a recording's samples), or "samples" of
            the only recording.
    """

    value: float
    low: float | None
    high: float | None
    n: int
    units: int
    over: str


def interval_of(values: Sequence[float], groups: Sequence[str], seed: int) -> Interval:
    """Return mean and interval of a clip metric.

    Samples of one recording are not independent: they are averaged, and recordings are resampled.
    With a single recording, its samples are resampled.

    Args:
        values: (n,) value of each clip.
        groups: (n,) recording of each clip.
        seed: the same seed gives the same interval.
    """
    values = np.asarray(values, dtype=np.float64)
    names = sorted(set(groups))
    if len(names) > 1:
        belongs = np.asarray(groups)
        units = np.array([values[belongs == name].mean() for name in names])
        over = "recordings"
    else:
        units, over = values, "samples"
    low = high = None
    if len(units) > 1:
        found = _bootstrap(len(units), lambda drawn, axis=-1: units[drawn].mean(axis=axis), seed)
        low, high = map(float, found.confidence_interval)
    return Interval(float(units.mean()), low, high, len(values), len(units), over)


def interval_of_statistic(
    statistic: Callable[[np.ndarray], float], groups: Sequence[str], seed: int, resamples: int = 500
) -> Interval:
    """Return a distance of a set of clips, and its interval by resampling the clips.

    The interval is 1.96 bootstrap standard errors either way, at least 0. Distances of resampled
    sets are biased upwards, so that their quantiles could exclude the value itself.

    Args:
        statistic: maps (m,) indices of clips to the distance.
        groups: (n,) recording of each clip; whole recordings are resampled if there
            are several.
        seed: the same seed gives the same interval.
        resamples: number of resampled sets.
    """
    names = sorted(set(groups))
    everything = np.arange(len(groups))
    if len(names) > 1:
        belongs = np.asarray(groups)
        members, over = [np.flatnonzero(belongs == name) for name in names], "recordings"
    else:
        members, over = [np.array([i]) for i in everything], "samples"

    def of(drawn: np.ndarray) -> float:
        return statistic(np.concatenate([members[i] for i in drawn]))

    value = float(statistic(everything))
    low = high = None
    if len(members) > 1:
        spread = 1.96 * float(_bootstrap(len(members), of, seed, resamples, False).standard_error)
        low, high = max(0.0, value - spread), value + spread
    return Interval(value, low, high, len(everything), len(members), over)


def whole_set(value: float, n: int) -> Interval:
    """Return the value of a whole set of n clips, without an interval."""
    return Interval(value, None, None, n, 1, "the whole set")


def _bootstrap(
    n: int,
    statistic: Callable[..., Any],
    seed: int,
    resamples: int = RESAMPLES,
    vectorized: bool = True,
) -> Any:
    from scipy.stats import bootstrap

    return bootstrap(
        (np.arange(n),),
        statistic,
        n_resamples=resamples,
        confidence_level=LEVEL,
        method="percentile",
        vectorized=vectorized,
        rng=np.random.default_rng(seed),
    )
