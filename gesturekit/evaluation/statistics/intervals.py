"""Confidence intervals over recordings, and the correction for many tests.

A model is measured on a sample of recordings: they are the units, and the samples (seeds) of one
recording are averaged within it. A percentile interval of few recordings is too narrow, so that the
standard error is that of the bootstrap, times sqrt(R / (R - 1)), and the quantile is Student's with
R - 1 degrees of freedom (Hesterberg 2015).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np

from gesturekit.evaluation.results import Interval

LEVEL = 0.95
RESAMPLES = 2000
FEW = 5
"""Least number of recordings for an interval without a warning."""


def means_by(groups: Sequence[str], values: np.ndarray) -> np.ndarray:
    """Return (R, ...) means of values (n, ...) over the clips of each recording, sorted by name."""
    belongs = np.asarray(groups)
    return np.stack([values[belongs == name].mean(axis=0) for name in sorted(set(groups))])


@functools.cache
def draws(units: int, seed: int, resamples: int = RESAMPLES) -> np.ndarray:
    """Return (resamples, units) weights of bootstrap resamples; each row sums to 1."""
    rng = np.random.default_rng(seed)
    return rng.multinomial(units, np.full(units, 1 / units), resamples) / units


def standard_error(replicates: np.ndarray, units: int) -> np.ndarray:
    """Return the bootstrap's standard error of replicates (resamples, ...), for few units."""
    return replicates.std(axis=0) * np.sqrt(units / (units - 1))


def half_width(replicates: np.ndarray, units: int) -> np.ndarray:
    """Return half the width of the 95 % interval of a statistic from its bootstrap replicates."""
    from scipy.stats import t

    return t.ppf(0.5 + LEVEL / 2, units - 1) * standard_error(replicates, units)


def interval_of(values: Sequence[float], groups: Sequence[str], seed: int) -> Interval:
    """Return mean and interval of a clip metric over recordings; no interval of a single one.

    Args:
        values: (n,) value of each clip.
        groups: (n,) recording of each clip.
        seed: the same seed gives the same interval.
    """
    return _interval(
        means_by(groups, np.asarray(values, np.float64)), len(values), "recordings", seed
    )


def interval_over_samples(values: Sequence[float], seed: int) -> Interval:
    """Return mean and interval over the samples (seeds) of one recording."""
    return _interval(np.asarray(values, np.float64), len(values), "samples", seed)


def _interval(units: np.ndarray, n: int, over: str, seed: int) -> Interval:
    value, count = float(units.mean()), len(units)
    low = high = None
    if count > 1:
        spread = float(half_width(draws(count, seed) @ units, count))
        low, high = value - spread, value + spread
    return Interval(value, low, high, n, count, over)


def interval_of_statistic(
    statistic: Callable[[np.ndarray], float], groups: Sequence[str], seed: int, resamples: int = 500
) -> Interval:
    """Return a distance of a set of clips, and its interval by resampling recordings.

    It is at least 0. Distances of resampled sets are biased upwards, so that their quantiles could
    exclude the value itself.

    Args:
        statistic: maps (m,) indices of clips to the distance.
        groups: (n,) recording of each clip.
        seed: the same seed gives the same interval.
        resamples: number of resampled sets.
    """
    names, belongs = sorted(set(groups)), np.asarray(groups)
    members = [np.flatnonzero(belongs == name) for name in names]
    value = float(statistic(np.arange(len(groups))))
    low = high = None
    if len(names) > 1:
        drawn = np.random.default_rng(seed).integers(len(names), size=(resamples, len(names)))
        found = [statistic(np.concatenate([members[i] for i in row])) for row in drawn]
        spread = float(half_width(np.array(found), len(names)))
        low, high = max(0.0, value - spread), value + spread
    return Interval(value, low, high, len(groups), len(names), "recordings")


def whole_set(value: float, n: int) -> Interval:
    """Return the value of a whole set of n clips, without an interval."""
    return Interval(value, None, None, n, 1, "the whole set")


def holm(p: Sequence[float]) -> np.ndarray:
    """Return p-values (K,) adjusted for K tests by Holm's step-down procedure (1979)."""
    p = np.asarray(p, np.float64)
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * (len(p) - np.arange(len(p))))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted
