"""Answers as votes with their raters and clips, and the bootstrap over both."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.statistics.answers import Answer
from gesturekit.study.analysis.significance import Estimate

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

LEVEL = 0.95
ROUNDS = 10_000
"""Rounds of the bootstrap, as GENEA's."""
_MOST_COUNTS = 20_000_000


@dataclass(frozen=True, eq=False)
class Votes:
    """Answers that compare two systems, n of them.

    Attributes:
        systems: (k,) names, sorted.
        first, second: (n,) indices of the systems that were compared.
        score: (n,) 2 first clearly better, 1 slightly better, 0 equal, -1 and -2 second.
        value: (n,) what is tested: the score or, of ratings, the difference.
        rater, clip: (n,) index of the rater and of the speech segment.
    """

    systems: tuple[str, ...]
    first: np.ndarray
    second: np.ndarray
    score: np.ndarray
    value: np.ndarray
    rater: np.ndarray
    clip: np.ndarray

    @classmethod
    def of(cls, answers: Sequence[Answer]) -> Votes:
        """Return answers as votes.

        Raises:
            EvaluationError: so many raters and systems that the names cannot be right.
        """
        sides = [(answer.left, answer.right) for answer in answers]
        systems, shown = np.unique(np.array(sides), return_inverse=True)
        rater, clip = (
            np.unique(names, return_inverse=True)[1]
            for names in ([a.user for a in answers], [a.clip for a in answers])
        )
        raters = int(rater.max()) + 1
        if raters * len(systems) ** 2 > _MOST_COUNTS:
            raise EvaluationError(
                f"{raters} raters and {len(systems)} systems: more than can be analysed. Are "
                "user, model_a and model_b the right columns?"
            )
        first, second = shown.reshape(-1, 2).T
        score = np.array([answer.score for answer in answers])
        value = [a.score if a.difference is None else a.difference for a in answers]
        return cls(tuple(map(str, systems)), first, second, score, np.array(value), rater, clip)

    def between(self, one: int, other: int) -> Votes:
        """Return the votes on two systems; positive scores are for `one`."""
        forward = (self.first == one) & (self.second == other)
        kept = forward | ((self.first == other) & (self.second == one))
        sign = np.where(forward, 1, -1)[kept]
        n = len(sign)
        return Votes(
            self.systems,
            np.full(n, one),
            np.full(n, other),
            sign * self.score[kept],
            sign * self.value[kept],
            self.rater[kept],
            self.clip[kept],
        )

    @property
    def answers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values, raters and clips (n,), as `mean_test` and `share` take them."""
        return self.value, self.rater, self.clip

    @property
    def n_raters(self) -> int:
        """Number of raters."""
        return len(np.unique(self.rater))

    @property
    def tally(self) -> tuple[int, ...]:
        """Number of answers of each score, from 2 to -2."""
        return tuple(int((self.score == score).sum()) for score in (2, 1, 0, -1, -2))

    @cached_property
    def _cells(self) -> csr_matrix:
        """Return (n, 3·k·k) with 1 at the cell of `counts` that each vote is counted in."""
        from scipy.sparse import csr_matrix

        k = len(self.systems)
        better = np.where(self.score >= 0, self.first, self.second)
        worse = self.first + self.second - better
        rows, kind = np.arange(len(better)), 2 - np.abs(self.score)
        cells = (kind * k + better) * k + worse
        return csr_matrix((np.ones(len(rows)), (rows, cells)), (len(rows), 3 * k * k))

    def _counted(self, weights: np.ndarray) -> np.ndarray:
        """Return counts (b, 3, k, k) of votes with weights (b, n)."""
        k = len(self.systems)
        counts = (self._cells.T @ weights.T).T.reshape(-1, 3, k, k)
        counts[:, 2] += counts[:, 2].swapaxes(1, 2)
        return counts

    @cached_property
    def counts(self) -> np.ndarray:
        """Numbers (3, k, k) of clear and slight preferences of i to j, and of ties of both."""
        return self._counted(np.ones((1, len(self.score))))[0]

    @property
    def wins(self) -> np.ndarray:
        """Preferences (k, k) of i to j, clear and slight."""
        return self.counts[0] + self.counts[1]

    @property
    def compared(self) -> np.ndarray:
        """Answers (k, k) in which i and j were compared."""
        return self.wins + self.wins.T + self.counts[2]

    def resampled(self, rounds: int, seed: int) -> Iterator[np.ndarray]:
        """Yield counts (b, 3, k, k) of bootstrap samples, some hundred rounds at a time.

        Pigeonhole bootstrap (Owen 2007): raters and clips are drawn again with replacement,
        independently; a vote counts as often as its rater was drawn times as often as its clip was.
        """
        rng = np.random.default_rng(seed)
        chunk = max(1, _MOST_COUNTS // (len(self.score) + self._cells.shape[1]))
        for start in range(0, rounds, chunk):
            size = min(chunk, rounds - start)
            weights = np.ones((size, len(self.score)))
            for unit in (self.rater, self.clip):
                n = int(unit.max()) + 1
                weights *= rng.multinomial(n, np.full(n, 1.0 / n), size)[:, unit]
            yield self._counted(weights)

    def estimates(
        self, statistic: Callable[[np.ndarray], np.ndarray], rounds: int, seed: int
    ) -> list[Estimate]:
        """Return a statistic with its 95 % percentile intervals over raters and clips.

        Args:
            statistic: maps counts (b, 3, k, k) to values (b, s); NaN where undefined.
            rounds: number of bootstrap rounds.
            seed: the same seed gives the same intervals.

        Returns:
            s estimates; without an interval with a single rater.
        """
        values = statistic(self.counts[None])[0]
        low = high = np.full(len(values), np.nan)
        if self.n_raters > 1:
            drawn = np.concatenate([statistic(counts) for counts in self.resampled(rounds, seed)])
            tail = (1 - LEVEL) / 2
            low, high = np.nanquantile(drawn, [tail, 1 - tail], axis=0)
        return [Estimate(*map(float, bounds)) for bounds in zip(values, low, high, strict=True)]
