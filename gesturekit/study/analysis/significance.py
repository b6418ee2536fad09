"""Significance tests and intervals over raters and clips, and the sample size of a study."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from gesturekit.errors import ConfigError

ALPHA = 0.05


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval; NaN bounds where there is none."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Anova:
    """One-way analysis of variance, and p-values of Tukey's test for all pairs.

    Attributes:
        f, p: F statistic and its p-value.
        between, within: degrees of freedom.
        tukey: {(i, j), i < j: p-value} by indices of groups; {} if one has a single answer.
    """

    f: float
    p: float
    between: int
    within: int
    tukey: dict[tuple[int, int], float]


def mean_test(
    scores: np.ndarray, rater: np.ndarray, clip: np.ndarray, group: np.ndarray | None = None
) -> float:
    """Return the p-value of "the mean score is 0", or of "the means of two groups are equal".

    Answers of one rater are not independent, nor are those on one clip. The variance of the mean is
    therefore that over raters plus that over clips less that over the pairs of both (Cameron,
    Gelbach and Miller 2011), and at least that over either alone; degrees of freedom are
    Satterthwaite's of the sum of the first two. With a single clip, it is that over raters.

    Args:
        scores: (n,) answers.
        rater, clip: (n,) index of the rater and of the clip of each.
        group: (n,) True for the answers of one of two groups; None for one mean.

    Returns:
        p, two-sided; NaN with fewer than two raters, of a group.
    """
    from scipy.stats import t

    groups = [np.ones(len(scores), bool)] if group is None else [group, ~group]
    if min(len(np.unique(rater[members])) for members in groups) < 2:
        return float("nan")
    estimate, influence = 0.0, np.zeros(len(scores))
    for sign, members in zip((1.0, -1.0), groups):
        mean = scores[members].mean()
        estimate += sign * mean
        influence[members] = sign * (scores[members] - mean) / members.sum()
    variance, freedom = _variance(influence, rater, clip)
    if variance < 1e-24:  # all answers agree: Student's t is infinite, the sign test is not
        units = min(len(np.unique(unit)) for unit in (rater, clip) if len(np.unique(unit)) > 1)
        return 1.0 if abs(estimate) < 1e-12 else float(2.0 ** (1 - units))
    return float(2.0 * t.sf(abs(estimate) / math.sqrt(variance), freedom))


def _variance(influence: np.ndarray, rater: np.ndarray, clip: np.ndarray) -> tuple[float, float]:
    """Return the variance of a mean over raters and clips, and its degrees of freedom.

    Args:
        influence: (n,) what each answer adds to the mean, less its expectation.
        rater, clip: (n,) index of the rater and of the clip of each answer.
    """
    pair = np.unique(rater * (int(clip.max()) + 1) + clip, return_inverse=True)[1]
    found = []
    for unit in (rater, clip, pair):
        sums = np.bincount(unit, influence)[np.bincount(unit) > 0]
        n = len(sums)
        found.append((float((sums**2).sum()) * n / (n - 1) if n > 1 else 0.0, max(n - 1, 1)))
    (raters, free), (clips, clips_free), (pairs, _) = found
    variance = max(raters + clips - pairs, raters, clips)
    return variance, _freedom(raters, free, clips, clips_free)


def _freedom(raters: float, raters_free: int, clips: float, clips_free: int) -> float:
    """Return the degrees of freedom of the variances over raters and over clips together.

    Satterthwaite's of their sum, and at most those of one of them. Leaving out the pairs of both
    keeps false positives below 7 % with 12 clips (benchmarks/study_false_positives.py).
    """
    spread = raters**2 / raters_free + clips**2 / max(clips_free, 1)
    freedom = (raters + clips) ** 2 / spread if spread > 0.0 else 1.0
    return min(freedom, max(raters_free, clips_free))


def share(scores: np.ndarray, rater: np.ndarray, clip: np.ndarray) -> Estimate:
    """Return the share of positive scores among those other than 0, with its 95 % interval.

    Wilson's interval with the number of independent answers that the variance over raters and clips
    (see `mean_test`) amounts to, and Student's t for the normal quantile (Korn and Graubard 1998).

    Args:
        scores: (n,) answers.
        rater, clip: (n,) index of the rater and of the clip of each.
    """
    from scipy.stats import norm, t

    kept = scores != 0
    won, rater, clip = scores[kept] > 0, rater[kept], clip[kept]
    if not len(won):
        return Estimate(float("nan"), float("nan"), float("nan"))
    value = float(won.mean())
    units = [len(np.unique(unit)) for unit in (rater, clip)]
    if units[0] < 2:
        return Estimate(value, float("nan"), float("nan"))
    n, z = float(min(count for count in units if count > 1)), float(norm.ppf(0.975))
    if 0.0 < value < 1.0:
        variance, freedom = _variance((won - value) / len(won), rater, clip)
        wider = (t.ppf(0.975, freedom) / z) ** 2
        n = min(float(len(won)), value * (1.0 - value) / max(variance * wider, 1e-12))
    middle = (value + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z * math.sqrt(value * (1 - value) / n + (z / (2 * n)) ** 2) / (1 + z**2 / n)
    return Estimate(value, max(0.0, middle - half), min(1.0, middle + half))


def mean_estimate(values: np.ndarray, rater: np.ndarray, clip: np.ndarray) -> Estimate:
    """Return the mean of ratings with its 95 % interval over raters and clips; see `mean_test`."""
    from scipy.stats import t

    mean = float(values.mean())
    if len(np.unique(rater)) < 2:
        return Estimate(mean, float("nan"), float("nan"))
    variance, freedom = _variance((values - mean) / len(values), rater, clip)
    half = float(t.ppf(0.975, freedom)) * math.sqrt(variance)
    return Estimate(mean, mean - half, mean + half)


def anova(scores: np.ndarray, group: np.ndarray) -> Anova | None:
    """Return the one-way ANOVA and Tukey's test; None if scores do not vary within groups.

    Args:
        scores: (n,) scores.
        group: (n,) index of the group of each.
    """
    from scipy.stats import f_oneway, tukey_hsd

    numbers = np.unique(group)
    groups = [scores[group == number] for number in numbers]
    if len(groups) < 2 or all(np.ptp(values) == 0 for values in groups):
        return None
    f, p = f_oneway(*groups)
    tukey = {}
    if min(map(len, groups)) > 1:  # as scipy needs
        pairs = tukey_hsd(*groups).pvalue
        for i, j in combinations(range(len(groups)), 2):
            tukey[int(numbers[i]), int(numbers[j])] = float(pairs[i, j])
    return Anova(float(f), float(p), len(groups) - 1, len(scores) - len(groups), tukey)


MOST_RATERS, MOST_CLIPS = 100_000, 10_000


@dataclass(frozen=True)
class Expected:
    """Expected answers to one comparison: normal preferences, cut into the five answers.

    Attributes:
        win_rate: share of preferences for the better system, ties excluded; above 0.5.
        ties: share of answers without a preference.
        clear: share of clear preferences among all preferences.
        rater_share, clip_share: share of the variance of answers that raters and clips make: 0 if
            they differ by chance alone.
    """

    win_rate: float
    ties: float
    clear: float
    rater_share: float
    clip_share: float

    def __post_init__(self) -> None:
        if not 0.5 < self.win_rate < 1:
            raise ConfigError(f"win_rate is {self.win_rate}: give a share above 0.5 and below 1")
        for name in ("ties", "clear", "rater_share", "clip_share"):
            value = getattr(self, name)
            if not 0 <= value < 1 and not (name == "clear" and value == 1):
                raise ConfigError(f"{name} is {value}: give a share from 0 to below 1")
        if self.rater_share + self.clip_share >= 1:
            raise ConfigError(
                f"rater_share {self.rater_share} and clip_share {self.clip_share}: their sum is "
                "below 1"
            )

    def thresholds(self) -> tuple[float, float, float]:
        """Return the mean preference in standard deviations, and the least slight and clear one."""
        from scipy.optimize import brentq
        from scipy.stats import norm

        decided = 1 - self.ties
        above, below = norm.isf(decided * self.win_rate), norm.ppf(decided * (1 - self.win_rate))
        mean, slight = -(above + below) / 2, (above - below) / 2

        def surplus(clear: float) -> float:
            return float(norm.sf(clear - mean) + norm.cdf(-clear - mean) - self.clear * decided)

        return mean, slight, brentq(surplus, slight - 1e-9, 40.0)

    def moments(self) -> tuple[float, float]:
        """Return the mean of the scores 2, 1, 0, -1 and -2, and their variance."""
        from scipy.stats import norm

        preference, *limits = self.thresholds()
        won, lost = norm.sf(np.array(limits) - preference), norm.cdf(-np.array(limits) - preference)
        mean = float((won - lost).sum())
        return mean, float((won + lost) @ [1.0, 3.0]) - mean**2


@dataclass(frozen=True)
class Design:
    """Size of a study.

    Attributes:
        answers: answers of each rater to one comparison, on different clips.
        clips: speech segments of the study.
        comparisons: pairs of systems that are tested.
    """

    answers: int
    clips: int
    comparisons: int = 1


def power_of(expected: Expected, raters: int, design: Design) -> float:
    """Return the probability that the difference is found, by the test of `study analyse`.

    Args:
        expected: the difference.
        raters: raters who pass the attention checks; at least 2.
        design: the study. The level is 0.05 divided by its comparisons, Holm's first step.
    """
    from scipy.stats import nct, t

    mean, variance = expected.moments()
    n = raters * design.answers
    chance = (1 - expected.rater_share - expected.clip_share) / n
    over_raters, over_clips = expected.rater_share / raters, expected.clip_share / design.clips
    freedom = _freedom(over_raters + chance, raters - 1, over_clips + chance, design.clips - 1)
    effect = mean / math.sqrt(variance * (over_raters + over_clips + chance))
    critical = t.isf(ALPHA / design.comparisons / 2, freedom)
    return float(nct.sf(critical, freedom, effect) + nct.cdf(-critical, freedom, effect))


def raters_needed(expected: Expected, design: Design, power: float = 0.8) -> int | None:
    """Return the smallest number of raters with this power; None if 100,000 are too few.

    Args:
        expected: the difference.
        design: the study.
        power: probability that the difference is found.

    Raises:
        ConfigError: power is not between 0 and 1.
    """
    if not 0 < power < 1:
        raise ConfigError(f"power is {power}: give a probability between 0 and 1, such as 0.8")
    return _least(MOST_RATERS, power, lambda n: power_of(expected, n, design))


def clips_needed(expected: Expected, design: Design, power: float = 0.8) -> int | None:
    """Return the smallest number of clips with this power for 100,000 raters; None above 10,000.

    Arguments as of `raters_needed`; the clips of the design do not matter.
    """
    return _least(
        MOST_CLIPS, power, lambda n: power_of(expected, MOST_RATERS, replace(design, clips=n))
    )


def _least(most: int, power: float, power_at: Callable[[int], float]) -> int | None:
    """Return the smallest number from 2 with this power; None if the most are too few."""
    at = 2 + bisect_left(range(2, most + 1), power, key=power_at)
    return at if at <= most else None
