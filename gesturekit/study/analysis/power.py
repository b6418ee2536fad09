"""Sample size: how many raters and answers a difference between two systems needs."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gesturekit.errors import ConfigError
from gesturekit.study.analysis.significance import ALPHA, statsmodels_module

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

    win_rate: float = 0.6
    ties: float = 0.2
    clear: float = 0.4
    agreement: float = 0.05

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
    low, high = 1, 2
    while power_of(expected, high, answers, comparisons) < power:
        low, high = high, 2 * high
        if high > MOST_RATERS:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        if power_of(expected, middle, answers, comparisons) < power:
            low = middle
        else:
            high = middle
    return high
