"""How sure a mean is: bootstrap intervals over what was drawn independently."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

LEVEL = 0.95
RESAMPLES = 2000
FEW = 5
"""Below so many units an interval is rough, and says so."""


@dataclass(frozen=True)
class Interval:
    """A mean and its percentile bootstrap interval.

    Attributes:
        value: the mean over units.
        low, high: 95 % interval; None where there is but one unit.
        n: how many clips went in.
        units: how many units were resampled.
        over: what a unit is: "recordings" (the mean of a recording's samples), or "samples" of
            the only recording.
    """

    value: float
    low: float | None
    high: float | None
    n: int
    units: int
    over: str


def interval_of(values: Sequence[float], groups: Sequence[str], seed: int) -> Interval:
    """Mean and interval of clip figures.

    Samples of one recording are no independent draws: they are averaged, and recordings are
    resampled. Of a single recording the samples are.

    Args:
        values: (n,) one figure a clip.
        groups: (n,) the recording each clip belongs to.
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
    """A distance of a whole set, and its interval from drawing the set's clips again.

    The interval is 1.96 bootstrap standard errors either way, from 0: distances of sets drawn
    again all lie too high, so that their quantiles would leave the value itself out.

    Args:
        statistic: from (m,) indices of clips to the figure.
        groups: (n,) the recording each clip belongs to; whole recordings are drawn where there
            are several.
        seed: the same seed gives the same interval.
        resamples: how many sets are drawn.
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
