"""Answers as counts a rater, and bootstrap over raters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.statistics.answers import Answer

LEVEL = 0.95
ROUNDS = 10_000
"""Rounds of the bootstrap, as GENEA's."""
_MOST_COUNTS = 20_000_000
_CHUNK = 500


@dataclass(frozen=True)
class Votes:
    """Counts of the answers of each rater.

    Attributes:
        systems: (k,) names, sorted.
        raters: (R,) names, sorted.
        clear, slight: (R, k, k) how often the rater preferred system i to system j.
        ties: (R, k, k) how often the rater found them equal; symmetric.
    """

    systems: tuple[str, ...]
    raters: tuple[str, ...]
    clear: np.ndarray
    slight: np.ndarray
    ties: np.ndarray

    @classmethod
    def of(cls, answers: Sequence[Answer]) -> Votes:
        """Count answers.

        Raises:
            EvaluationError: so many raters and systems that the names cannot be right.
        """
        systems = tuple(sorted({name for a in answers for name in (a.left, a.right)}))
        raters = tuple(sorted({answer.user for answer in answers}))
        shape = (len(raters), len(systems), len(systems))
        if np.prod(shape, dtype=float) > _MOST_COUNTS:
            raise EvaluationError(
                f"{len(raters)} raters and {len(systems)} systems: more than can be analysed. Are "
                "user, model_a and model_b the right columns?"
            )
        counts = {size: np.zeros(shape) for size in (0, 1, 2)}
        place = {name: i for i, name in enumerate(systems)}
        row = {name: i for i, name in enumerate(raters)}
        for answer in answers:
            i, j = place[answer.left], place[answer.right]
            if answer.score < 0:
                i, j = j, i
            counts[abs(answer.score)][row[answer.user], i, j] += 1
        ties = counts[0] + counts[0].transpose(0, 2, 1)
        return cls(systems, raters, counts[2], counts[1], ties)

    @property
    def wins(self) -> np.ndarray:
        """Preferences (k, k) of i to j, clear and slight."""
        return (self.clear + self.slight).sum(axis=0)

    @property
    def compared(self) -> np.ndarray:
        """Answers (k, k) in which i and j were compared."""
        return self.wins + self.wins.T + self.ties.sum(axis=0)


def resampled(counts: np.ndarray, rounds: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield sums of counts over raters drawn with replacement, some hundred rounds at a time.

    Args:
        counts: (R, ...) counts of each rater.
        rounds: number of bootstrap rounds.
        rng: random numbers.

    Yields:
        (b, ...) sums of b rounds.
    """
    n = len(counts)
    for start in range(0, rounds, _CHUNK):
        times = rng.multinomial(n, np.full(n, 1.0 / n), size=min(_CHUNK, rounds - start))
        yield np.tensordot(times.astype(np.float64), counts, axes=1)


def interval(
    counts: np.ndarray,
    statistic: Callable[[np.ndarray], np.ndarray],
    rounds: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95 % percentile bootstrap interval over raters of a statistic.

    Args:
        counts: (R, ...) counts of each rater.
        statistic: maps sums (b, ...) over raters to values (b, k); NaN where undefined.
        rounds: number of bootstrap rounds.
        rng: random numbers.

    Returns:
        low and high (k,); NaN with a single rater.
    """
    values = np.concatenate([statistic(sums) for sums in resampled(counts, rounds, rng)])
    if len(counts) < 2:
        return np.full(values.shape[1], np.nan), np.full(values.shape[1], np.nan)
    tail = (1 - LEVEL) / 2
    low, high = np.nanquantile(values, [tail, 1 - tail], axis=0)
    return low, high
