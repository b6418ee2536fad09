"""Sample size of a study: how many raters find a difference by the test of `study analyse`."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from gesturekit.errors import ConfigError
from gesturekit.evaluation.statistics.intervals import LEVEL
from gesturekit.evaluation.statistics.scores import freedom_of
from gesturekit.training.config import Settings, Share, ShareBelowOne

MOST_RATERS, MOST_CLIPS = 100_000, 10_000


@dataclass(frozen=True)
class Expected(Settings):
    """Expected answers to one comparison: normal preferences, cut into the five answers.

    Attributes:
        win_rate: share of preferences for the better system, ties excluded; above 0.5.
        ties: share of answers without a preference.
        clear: share of clear preferences among all preferences.
        rater_share, clip_share: share of the variance of answers that raters and clips make: 0 if
            they differ by chance alone.
    """

    win_rate: float
    ties: ShareBelowOne
    clear: Share
    rater_share: ShareBelowOne
    clip_share: ShareBelowOne

    def problems(self) -> Iterator[str]:
        """Yield a win rate without a difference, and shares that leave no variance to chance."""
        if not 0.5 < self.win_rate < 1:
            yield f"win_rate: {self.win_rate} must be above 0.5 and below 1"
        if self.rater_share + self.clip_share >= 1:
            yield (
                f"rater_share {self.rater_share} and clip_share {self.clip_share}: their sum must "
                "be below 1"
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


def power_of(
    expected: Expected, raters: int, answers: int, clips: int, comparisons: int = 1
) -> float:
    """Return the probability that the difference is found.

    Args:
        expected: the difference.
        raters: raters who pass the attention checks; at least 2.
        answers: answers of each rater to one comparison, on different clips.
        clips: speech segments of the study.
        comparisons: pairs of systems that are tested. The level is 0.05 divided by them, Holm's
            first step.
    """
    from scipy.stats import nct, t

    mean, variance = expected.moments()
    chance = (1 - expected.rater_share - expected.clip_share) / (raters * answers)
    over_raters, over_clips = expected.rater_share / raters, expected.clip_share / clips
    freedom = freedom_of(over_raters + chance, raters - 1, over_clips + chance, clips - 1)
    effect = mean / math.sqrt(variance * (over_raters + over_clips + chance))
    critical = t.isf((1.0 - LEVEL) / comparisons / 2, freedom)
    return float(nct.sf(critical, freedom, effect) + nct.cdf(-critical, freedom, effect))


def raters_needed(
    expected: Expected, answers: int, clips: int, comparisons: int = 1, power: float = 0.8
) -> int | None:
    """Return the smallest number of raters with this power; None if 100,000 are too few.

    Args:
        expected: the difference.
        answers, clips, comparisons: see `power_of`.
        power: probability that the difference is found.

    Raises:
        ConfigError: power is not between 0 and 1.
    """
    if not 0 < power < 1:
        raise ConfigError(f"power is {power}: give a probability between 0 and 1, such as 0.8")
    return _least(MOST_RATERS, power, lambda n: power_of(expected, n, answers, clips, comparisons))


def clips_needed(
    expected: Expected, answers: int, comparisons: int = 1, power: float = 0.8
) -> int | None:
    """Return the smallest number of clips with this power for 100,000 raters; None above 10,000."""
    return _least(
        MOST_CLIPS, power, lambda n: power_of(expected, MOST_RATERS, answers, n, comparisons)
    )


def _least(most: int, power: float, power_at: Callable[[int], float]) -> int | None:
    """Return the smallest number from 2 with this power; None if the most are too few."""
    at = 2 + bisect_left(range(2, most + 1), power, key=power_at)
    return at if at <= most else None
