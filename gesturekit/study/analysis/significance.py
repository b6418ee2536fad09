"""Significance tests, from scipy and statsmodels, and the sample size that a difference needs."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from typing import Any

import numpy as np

from gesturekit.errors import ConfigError

ALPHA = 0.05
_MOST_TABLES = 250_000


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
        tukey: {(i, j), i < j: p-value} by indices of groups.
    """

    f: float
    p: float
    between: int
    within: int
    tukey: dict[tuple[int, int], float]


def statsmodels_module(name: str) -> Any:
    """Import a module of statsmodels.

    Raises:
        ConfigError: statsmodels is not installed.
    """
    import importlib

    try:
        return importlib.import_module(f"statsmodels.{name}")
    except ImportError as error:
        raise ConfigError(
            f"the analysis of user studies needs statsmodels ({error}): "
            "pip install 'gesturekit[study]'"
        ) from None


def rater_means(scores: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return the mean score of each rater with answers; arguments as for `rater_test`."""
    return scores[n > 0] / n[n > 0]


def rater_test(scores: np.ndarray, n: np.ndarray) -> float:
    """Return the p-value of "raters prefer neither side": a t-test of the raters' means.

    Answers of one rater are not independent, raters are.

    Args:
        scores: (R,) sum of the rater's answers, positive for one side and negative for the other.
        n: (R,) number of the rater's answers; raters without any are left out.

    Returns:
        p, two-sided; NaN with fewer than two raters.
    """
    from scipy.stats import ttest_1samp

    means = rater_means(scores, n)
    if len(means) < 2:
        return float("nan")
    if np.ptp(means) == 0:
        # The t statistic is infinite or 0 / 0. All raters agree: the sign test can be computed.
        return 1.0 if means[0] == 0 else float(2.0 ** (1 - len(means)))
    return float(ttest_1samp(means, 0.0).pvalue)


def wilson(successes: float, n: float) -> Estimate:
    """Return a proportion with its Wilson interval; NaN if n is 0."""
    from scipy.stats import binomtest

    if n == 0:
        return Estimate(float("nan"), float("nan"), float("nan"))
    bounds = binomtest(int(successes), int(n)).proportion_ci(0.95, method="wilson")
    return Estimate(successes / n, float(bounds.low), float(bounds.high))


def two_proportions(one: tuple[int, int], other: tuple[int, int]) -> float:
    """Return the p-value of "both proportions are equal": Barnard's exact test.

    With very many answers its time is prohibitive and its p-value that of the z-test, which is
    returned instead.

    Args:
        one: successes and failures.
        other: successes and failures.

    Returns:
        p, two-sided; NaN if one has no answers.
    """
    from scipy.stats import barnard_exact

    n_one, n_other = sum(one), sum(other)
    if min(n_one, n_other) == 0:
        return float("nan")
    if n_one * n_other > _MOST_TABLES:
        test = statsmodels_module("stats.proportion").proportions_ztest
        with np.errstate(invalid="ignore"):
            p = float(test([one[0], other[0]], [n_one, n_other])[1])
        return 1.0 if np.isnan(p) else p
    return float(barnard_exact([[one[0], other[0]], [one[1], other[1]]]).pvalue)


def anova(scores: np.ndarray, group: np.ndarray) -> Anova | None:
    """Return the one-way ANOVA and Tukey's test; None if scores do not vary within groups.

    Args:
        scores: (n,) scores.
        group: (n,) index of the group of each.
    """
    groups = np.unique(group)
    if len(groups) < 2 or all(np.ptp(scores[group == g]) == 0 for g in groups):
        return None
    formula = statsmodels_module("formula.api")
    import pandas

    model = formula.ols("score ~ C(group)", pandas.DataFrame({"score": scores, "group": group}))
    table = statsmodels_module("stats.anova").anova_lm(model.fit())
    found = statsmodels_module("stats.multicomp").pairwise_tukeyhsd(scores, group)
    levels = [int(level) for level in found.groupsunique]
    pairs = [(i, j) for at, i in enumerate(levels) for j in levels[at + 1 :]]
    return Anova(
        f=float(table["F"].iloc[0]),
        p=float(table["PR(>F)"].iloc[0]),
        between=int(table["df"].iloc[0]),
        within=int(table["df"].iloc[1]),
        tukey=dict(zip(pairs, map(float, found.pvalues), strict=True)),
    )


MOST_RATERS = 100_000


@dataclass(frozen=True)
class Expected:
    """Expected answers to one comparison.

    Attributes:
        win_rate: share of preferences for the better system, ties excluded; above 0.5.
        ties: share of answers without a preference.
        clear: share of clear preferences among all preferences.
        agreement: intraclass correlation of the answers of one rater: 0 if raters differ by chance
            alone, 1 if each rater always answers the same.
    """

    win_rate: float
    ties: float
    clear: float
    agreement: float

    def __post_init__(self) -> None:
        if not 0.5 < self.win_rate < 1:
            raise ConfigError(f"win_rate is {self.win_rate}: give a share above 0.5 and below 1")
        for name in ("ties", "clear", "agreement"):
            value = getattr(self, name)
            if not 0 <= value < 1 and not (name == "clear" and value == 1):
                raise ConfigError(f"{name} is {value}: give a share from 0 to below 1")

    def effect_size(self, answers: int) -> float:
        """Return mean / standard deviation of the raters' mean scores (Cohen's d).

        A score is 2, 1, 0, -1 or -2.

        Args:
            answers: answers of each rater to this comparison.
        """
        mean = (1 - self.ties) * (2 * self.win_rate - 1) * (1 + self.clear)
        variance = (1 - self.ties) * (1 + 3 * self.clear) - mean**2
        share = self.agreement + (1 - self.agreement) / answers
        return mean / math.sqrt(variance * share)


def power_of(expected: Expected, raters: int, answers: int, comparisons: int = 1) -> float:
    """Return the probability that the difference is found, by the t-test of `study analyse`.

    Args:
        expected: the difference.
        raters: raters who pass the attention checks; at least 2.
        answers: answers of each rater to this comparison.
        comparisons: pairs of systems; the level is 0.05 divided by it, Holm's first step.
    """
    test = statsmodels_module("stats.power").TTestPower()
    return float(test.power(expected.effect_size(answers), raters, ALPHA / comparisons))


def raters_needed(
    expected: Expected, answers: int, comparisons: int = 1, power: float = 0.8
) -> int | None:
    """Return the smallest number of raters with this power; None if 100,000 are too few.

    Args:
        expected: the difference.
        answers: answers of each rater to this comparison.
        comparisons: pairs of systems that are tested.
        power: probability that the difference is found.

    Raises:
        ConfigError: power is not between 0 and 1.
    """
    if not 0 < power < 1:
        raise ConfigError(f"power is {power}: give a probability between 0 and 1, such as 0.8")
    tried = range(2, MOST_RATERS + 1)
    at = bisect_left(tried, power, key=lambda n: power_of(expected, n, answers, comparisons))
    return tried[at] if at < len(tried) else None
