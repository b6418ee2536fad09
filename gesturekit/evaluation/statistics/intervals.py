"""Confidence intervals over takes, and the correction for many tests.

A take (recording session) is the unit. Samples (seeds) are averaged within a clip, and clips within
a take: pieces of one take share its mood, and say little about another take.

Population: new takes of the speakers that were measured, in the shares that they have among the
takes. Speakers are strata: the spread of takes is taken within speakers, and differences between
speakers do not widen an interval. Two or three speakers cannot say how speakers differ, so that no
interval claims to hold for others. The one exception is a corpus of at least `FEW` speakers with
hardly more than a take each: there speakers are the units, and the population is new speakers.

Student's t is used on a scale where the metric is unbounded (the logit between two bounds, which
is Fisher's z between -1 and 1; the logarithm above one bound), so that no interval leaves the range
of its metric. The standard error is brought there by the delta method, with the spread of takes
equal for all speakers on that scale. Above one bound values are skewed, and their standard
deviation is too small whenever no take is far out: the standard deviation of the logarithms is used
if it is larger. Standard errors of other statistics than means are those of the jackknife over
takes. Coverage in simulated corpora: benchmarks/interval_coverage.py.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gesturekit.evaluation.pairs import Pair
from gesturekit.evaluation.results import Interval, takes_of_speakers
from gesturekit.evaluation.statistics.thresholds import LEAST_IN_STYLE

LEVEL = 0.95
FEW = 5
"""Least number of takes for an interval or a test."""
LEAST_FREEDOM = 3
"""Least number of takes beyond one of each speaker."""
RESOLUTION = 0.1
"""Share of the mean below which the logarithm of a value says more of the resolution of measurement
than of skewness: a clip that does not move has 1e-15 m/s."""
ANY = (-np.inf, np.inf)
"""Bounds of a metric without any."""


@dataclass(frozen=True)
class Takes:
    """Nesting of measured values: values in clips, clips in takes, takes in speakers.

    Attributes:
        weights: (R, n) weights by which n values become the means of R takes.
        speakers: (R,) number of each take's speaker, from 0.
    """

    weights: np.ndarray
    speakers: np.ndarray

    @classmethod
    def nested(
        cls,
        takes: Sequence[str],
        speakers: Sequence[str | None] | None = None,
        clips: Sequence[str] | None = None,
    ) -> Takes:
        """Return the nesting of n values; takes are sorted by speaker and name.

        Args:
            takes: (n,) take of each value.
            speakers: (n,) speaker of each value; None for a single speaker.
            clips: (n,) clip of each value, for several samples of a clip; None if all differ.
        """
        n = len(takes)
        names = [""] * n if speakers is None else [name or "" for name in speakers]
        pieces = range(n) if clips is None else clips
        named = np.array([*zip(names, takes)], str).reshape(n, 2)
        found, take = np.unique(named, axis=0, return_inverse=True)
        _, clip = np.unique([f"{t}\0{c}" for t, c in zip(take, pieces)], return_inverse=True)
        weights = np.zeros((len(found), n))
        weights[take, np.arange(n)] = 1.0 / np.bincount(clip)[clip]
        weights /= weights.sum(axis=1, keepdims=True)
        return cls(weights, np.unique(found[:, 0], return_inverse=True)[1])

    @classmethod
    def of(cls, pairs: Sequence[Pair]) -> Takes:
        """Return the nesting of generated clips."""
        return cls.nested(
            [pair.take for pair in pairs],
            [pair.speaker for pair in pairs],
            [f"{pair.stem}\0{pair.window}" for pair in pairs],
        )

    @property
    def count(self) -> int:
        """Number of takes."""
        return len(self.weights)

    @property
    def in_words(self) -> str:
        """Numbers of takes and speakers, such as "4 takes of 2 speakers"."""
        return takes_of_speakers(self.count, len(set(self.speakers)))

    @property
    def needed(self) -> int:
        """Number of takes from which there are intervals, with as many speakers."""
        speakers = len(set(self.speakers))
        return speakers if speakers >= FEW else max(FEW, speakers + LEAST_FREEDOM)

    def means(self, values: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the means (R,) of values (n,) by take."""
        return self.weights @ np.asarray(values, np.float64)


def groups_of(pairs: Sequence[Pair]) -> list[str]:
    """Return the group of each clip, such as "maya" or "maya, angry"; "" without a speaker.

    The styles of a speaker are groups of their own if each has recordings of `LEAST_IN_STYLE` or
    more.
    """
    styles: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for pair in pairs:
        styles[pair.speaker or ""][pair.style or ""].add(pair.stem)
    split = {
        speaker
        for speaker, stems in styles.items()
        if len(stems) > 1 and min(map(len, stems.values())) >= LEAST_IN_STYLE
    }
    return [
        ", ".join(filter(None, (pair.speaker, pair.style)))
        if (pair.speaker or "") in split
        else pair.speaker or ""
        for pair in pairs
    ]


def standard_error(
    values: np.ndarray, speakers: np.ndarray, within: tuple[float, float] = ANY
) -> tuple[float, int] | None:
    """Return the standard error of the mean over takes, and its degrees of freedom.

    Args:
        values: (R,) one value a take.
        speakers: (R,) number of each take's speaker, from 0.
        within: the bounds of the metric.

    Returns:
        None with too few takes: fewer than `FEW`, or hardly more than one of each of a few
        speakers.
    """
    takes = np.bincount(speakers)
    free = len(values) - len(takes)
    if len(values) >= FEW and free >= LEAST_FREEDOM:
        means = np.bincount(speakers, values) / takes
        inside = (within[0] < means.min()) and (means.max() < within[1])
        slopes = _slope(means, within if inside else ANY)
        spread = _spread_of_takes(values, speakers, slopes, free)
        if inside and np.isinf(within[1]) and not np.isinf(within[0]):
            least = within[0] + RESOLUTION * (values.mean() - within[0])
            logs = _scale(np.maximum(values, least), within)
            spread = max(spread, _spread_of_takes(logs, speakers, np.ones(len(takes)), free))
        return float(spread * np.sqrt((takes / slopes**2).sum()) / len(values)), free
    if len(takes) >= FEW:
        away = np.bincount(speakers, values - values.mean()) / len(values)
        return float(np.sqrt((away**2).sum() * len(takes) / (len(takes) - 1))), len(takes) - 1
    return None


def _spread_of_takes(
    values: np.ndarray, speakers: np.ndarray, slopes: np.ndarray, free: int
) -> float:
    """Return the standard deviation of takes about their speaker's mean, times its slope."""
    means = np.bincount(speakers, values) / np.bincount(speakers)
    away = (values - means[speakers]) * slopes[speakers]
    return float(np.sqrt((away**2).sum() / free))


def bounds_about(
    value: float, error: float, free: int, within: tuple[float, float] = ANY
) -> tuple[float, float] | None:
    """Return the 95 % interval of a value with a standard error of `free` degrees of freedom.

    None for a value at a bound of its metric, such as a share of 0 %: its spread there says
    nothing.
    """
    from scipy.stats import t

    if not within[0] < value < within[1]:
        return None
    half = t.ppf(0.5 + LEVEL / 2, free) * error * _slope(value, within)
    at = _scale(value, within)
    return _unscale(at - half, within), _unscale(at + half, within)


def scaled_like(interval: Interval, value: float, within: tuple[float, float]) -> Interval:
    """Return an interval that is as wide about another value, on the scale of the metric."""
    if interval.low is None or interval.high is None or not within[0] < value < within[1]:
        return replace(interval, value=value, low=None, high=None)
    shift = _scale(value, within) - _scale(interval.value, within)
    low, high = (
        _unscale(_scale(bound, within) + shift, within) for bound in (interval.low, interval.high)
    )
    return replace(interval, value=value, low=low, high=high)


def _scale(value: np.ndarray | float, within: tuple[float, float]) -> np.ndarray:
    """Return values on the scale where their metric is unbounded."""
    low, high = within
    if np.isinf(low):
        return np.asarray(value)
    return np.log(np.asarray(value) - low) - (0.0 if np.isinf(high) else np.log(high - value))


def _slope(value: np.ndarray | float, within: tuple[float, float]) -> np.ndarray:
    """Return the derivative of `_scale`."""
    low, high = within
    if np.isinf(low):
        return np.ones_like(value)
    return 1.0 / (np.asarray(value) - low) + (0.0 if np.isinf(high) else 1.0 / (high - value))


def _unscale(at: float, within: tuple[float, float]) -> float:
    """Return the value at a place on the scale."""
    from scipy.special import expit

    low, high = within
    if np.isinf(low):
        return at
    return float(low + (np.exp(at) if np.isinf(high) else (high - low) * expit(at)))


def pseudo_values(statistic: Callable[[np.ndarray], np.ndarray], units: int) -> np.ndarray:
    """Return the jackknife's pseudo-values (R, ...) of a statistic of weighted takes.

    Their mean and spread stand for those of the values of takes; a mean's are these values.

    Args:
        statistic: maps weights (B, R) of takes, each row with the sum 1, to values (B, ...).
        units: number of takes R, at least 2.
    """
    weights = np.vstack([np.ones(units), 1.0 - np.eye(units)])
    found = np.asarray(statistic(weights / weights.sum(axis=1, keepdims=True)))
    return units * found[0] - (units - 1) * found[1:]


def interval_of(
    values: Sequence[float], takes: Takes, within: tuple[float, float] = ANY
) -> Interval:
    """Return mean and interval of a clip metric over takes.

    Args:
        values: (n,) the values that `takes` nests.
        takes: the nesting.
        within: the bounds of the metric.
    """
    units = takes.means(values)
    return interval_about(float(units.mean()), units, takes, within)


def interval_about(
    value: float, units: np.ndarray, takes: Takes, within: tuple[float, float] = ANY
) -> Interval:
    """Return the interval of a value with one value (or pseudo-value) a take."""
    error = standard_error(units, takes.speakers, within)
    low, high = (error and bounds_about(value, *error, within)) or (None, None)
    speakers = len(set(takes.speakers))
    return Interval(value, low, high, takes.weights.shape[1], takes.count, "takes", speakers)


def interval_over_samples(values: Sequence[float], within: tuple[float, float] = ANY) -> Interval:
    """Return mean and interval over the samples (seeds) of one recording."""
    each = Takes(np.eye(len(values)), np.zeros(len(values), int))
    return replace(interval_of(values, each, within), over="samples")


def interval_of_statistic(
    statistic: Callable[[np.ndarray], float], takes: Takes, within: tuple[float, float] = ANY
) -> Interval:
    """Return a distance of a set of clips, and its interval by the jackknife over takes.

    A bootstrap would have sets with repeated takes, whose distances are biased upwards.

    Args:
        statistic: maps (m,) indices of clips to the distance.
        takes: the nesting of the clips.
        within: the bounds of the metric.
    """

    def weighted(weights: np.ndarray) -> np.ndarray:
        chosen = (weights > 0.0).astype(float) @ (takes.weights > 0.0)
        return np.array([statistic(np.flatnonzero(row)) for row in chosen])

    value = float(statistic(np.arange(takes.weights.shape[1])))
    enough = takes.count >= FEW
    units = pseudo_values(weighted, takes.count) if enough else np.full(takes.count, value)
    return interval_about(value, units, takes, within)


def whole_set(value: float, n: int) -> Interval:
    """Return the value of a whole set of n clips, without an interval."""
    return Interval(value, None, None, n, 1, "the whole set")


def holm(p: Sequence[float | None]) -> np.ndarray:
    """Return p-values (K,) adjusted for K tests by Holm's step-down procedure (1979).

    NaN stays NaN and is not counted; None becomes NaN.
    """
    adjusted = np.array(p, np.float64)
    order = np.argsort(adjusted)[: np.count_nonzero(~np.isnan(adjusted))]
    stepped = np.maximum.accumulate(adjusted[order] * np.arange(len(order), 0, -1))
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted
