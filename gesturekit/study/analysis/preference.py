"""Preference tests: merit scores, Bradley-Terry strengths, win rates, and tests of all pairs.

Merit scores (Parizet et al. 2005, as in the diffusion paper): a clear preference scores 2 for the
preferred system, a slight one 1; the other system, and ties, score 0. The merit score is the mean
over all answers in which the system was shown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import connected_components

from gesturekit.evaluation.statistics.answers import Answer, Rating
from gesturekit.evaluation.statistics.intervals import holm
from gesturekit.study.analysis.significance import (
    Anova,
    Estimate,
    anova,
    mean_estimate,
    mean_test,
    share,
)
from gesturekit.study.analysis.votes import Votes

WEIGHTS = np.array([4.0, 2.0, 1.0])
"""Weights of a clear and a slight preference and of a tie, as in GENEA's analysis; a tie counts for
either system."""
SCALE, MEAN = 400.0, 1000.0
_RIDGE = 1e-6  # keeps the strength of a system that lost every comparison finite
_MOST_STEPS = 100


def weighted_wins(counts: np.ndarray) -> np.ndarray:
    """Return the weighted wins (..., k, k) of i over j from counts (..., 3, k, k) of `Votes`."""
    return np.einsum("h,...hij->...ij", WEIGHTS, counts)


def fit_strengths(wins: np.ndarray) -> np.ndarray:
    """Fit Bradley-Terry strengths by maximum likelihood (Newton's method).

    P(i beats j) = 1 / (1 + exp(strength_j - strength_i)): a logistic regression without intercept.

    Args:
        wins: (..., k, k) weighted wins of i over j.

    Returns:
        (..., k) strengths in nats, with mean 0.
    """
    games = wins + np.swapaxes(wins, -1, -2)
    k = wins.shape[-1]
    strengths = np.zeros(wins.shape[:-1])
    for _ in range(_MOST_STEPS):
        p = 1.0 / (1.0 + np.exp(strengths[..., None, :] - strengths[..., :, None]))
        gradient = (wins - games * p).sum(axis=-1) - _RIDGE * strengths
        curvature = games * p * (1.0 - p)
        hessian = -curvature
        diagonal = np.arange(k)
        hessian[..., diagonal, diagonal] += curvature.sum(axis=-1) + _RIDGE
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        # Full steps can overshoot where a system wins almost always.
        longest = np.abs(step).max(axis=-1, keepdims=True)
        strengths = strengths + step / np.maximum(longest, 1.0)
        if longest.max(initial=0.0) < 1e-9:
            break
    return strengths - strengths.mean(axis=-1, keepdims=True)


def elo(strengths: np.ndarray) -> np.ndarray:
    """Return Elo ratings: 400 points for odds of 10 to 1, mean 1000."""
    return SCALE / np.log(10.0) * strengths + MEAN


def connected_groups(wins: np.ndarray) -> list[list[int]]:
    """Return the groups of systems that comparisons connect; strengths need a single one.

    Args:
        wins: (k, k) weighted wins.
    """
    n, label = connected_components(wins + wins.T > 0, directed=False)
    return [[int(i) for i in np.flatnonzero(label == g)] for g in range(n)]


def is_bounded(wins: np.ndarray) -> bool:
    """Return whether finite strengths maximise the likelihood (Ford's condition).

    It fails if a group of systems never lost to, or tied with, the others.
    """
    return connected_components(wins > 0, connection="strong")[0] == 1


@dataclass(frozen=True)
class SystemScore:
    """Scores of one system.

    Attributes:
        name: the system.
        n: answers in which it was shown.
        merit: merit score, 0 to 2; interval by bootstrap over raters and clips. Of ratings, their
            mean with its interval over both.
        elo: Elo rating of the Bradley-Terry fit; NaN where comparisons do not connect the systems.
    """

    name: str
    n: int
    merit: Estimate
    elo: Estimate


@dataclass(frozen=True)
class PairScore:
    """Comparison of two systems; `a` is the one that was preferred more often.

    Attributes:
        a, b: the systems.
        counts: a clearly, a slightly, equal, b slightly, b clearly.
        raters: raters who compared them.
        win_rate: share of preferences for `a`, ties excluded; interval over raters and clips.
        mean: mean score, 2 to -2, or mean difference of ratings; below 0 if raters prefer `b`.
        p: test of the mean over raters and clips; `p_holm` is adjusted for the number of pairs.
        p_tukey: Tukey's test of merit scores.
    """

    a: str
    b: str
    counts: tuple[int, ...]
    raters: int
    win_rate: Estimate
    mean: float
    p: float
    p_holm: float
    p_tukey: float

    @property
    def n(self) -> int:
        """Number of answers."""
        return sum(self.counts)


@dataclass(frozen=True)
class Preference:
    """Result of a preference test.

    Attributes:
        systems: best first, by Elo rating or, where there is none, by merit.
        pairs: all pairs that were compared.
        not_compared: pairs of systems without a single answer.
        anova: one-way ANOVA of merit scores; None if scores of a system do not vary, or of ratings.
        separate: groups of systems that no comparison connects, if there are several.
        bounded: False if a system never lost or never won, so that ratings have no finite value.
        votes: counts behind it.
        rated: True if the answers are ratings.
    """

    systems: tuple[SystemScore, ...]
    pairs: tuple[PairScore, ...]
    not_compared: tuple[tuple[str, str], ...]
    anova: Anova | None
    separate: tuple[tuple[str, ...], ...]
    bounded: bool
    votes: Votes
    rated: bool = False


def merit_scores(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return merit scores (..., k) and numbers of answers (..., k) from counts of `Votes`."""
    clear, slight, ties = np.moveaxis(counts, -3, 0)
    preferences = clear + slight
    shown = (preferences + preferences.swapaxes(-1, -2) + ties).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (2 * clear + slight).sum(axis=-1) / shown, shown


def analyse_preference(
    answers: Sequence[Answer], rounds: int, seed: int, ratings: Sequence[Rating] = ()
) -> Preference:
    """Analyse answers that compare systems with each other.

    Args:
        answers: at least one.
        rounds: rounds of the bootstrap over raters and clips.
        seed: the same seed gives the same intervals.
        ratings: the ratings that the answers compare, if they are ratings.
    """
    votes = Votes.of(answers)
    total = weighted_wins(votes.counts)
    separate = connected_groups(total)
    variance = None if ratings else anova(*_responses(votes))

    def merit_and_elo(counts: np.ndarray) -> np.ndarray:
        merit, _ = merit_scores(counts)
        if len(separate) > 1:
            return merit
        return np.concatenate([merit, elo(fit_strengths(weighted_wins(counts)))], axis=1)

    estimates = votes.estimates(merit_and_elo, rounds, seed)
    shown, k = merit_scores(votes.counts)[1], len(votes.systems)
    elos = estimates[k:] or [Estimate(math.nan, math.nan, math.nan)] * k
    merits = estimates[:k]
    if ratings:
        merits, shown = zip(*(_mean_rating(name, ratings) for name in votes.systems), strict=True)
    systems = [
        SystemScore(name, int(n), merit, rating)
        for name, n, merit, rating in zip(votes.systems, shown, merits, elos, strict=True)
    ]
    key = [s.merit.value if len(separate) > 1 else s.elo.value for s in systems]
    order = sorted(range(len(systems)), key=lambda i: (-key[i], systems[i].name))
    names = votes.systems
    return Preference(
        systems=tuple(systems[i] for i in order),
        pairs=tuple(_pairs(votes, variance)),
        not_compared=tuple(
            (names[i], names[j]) for i, j in combinations(range(k), 2) if votes.compared[i, j] == 0
        ),
        anova=variance,
        separate=tuple(tuple(names[i] for i in g) for g in separate) if len(separate) > 1 else (),
        bounded=is_bounded(total),
        votes=votes,
        rated=bool(ratings),
    )


def _mean_rating(system: str, ratings: Sequence[Rating]) -> tuple[Estimate, int]:
    """Return the mean rating of a system, and the number of its ratings."""
    given = [rating for rating in ratings if rating.system == system]
    rater, clip = (
        np.unique(names, return_inverse=True)[1]
        for names in ([r.user for r in given], [r.clip for r in given])
    )
    return mean_estimate(np.array([r.value for r in given]), rater, clip), len(given)


def _responses(votes: Votes) -> tuple[np.ndarray, np.ndarray]:
    """Return the merit score and the system (n,) of every answer, two of each answer."""
    scores = np.concatenate([np.maximum(votes.score, 0), np.maximum(-votes.score, 0)])
    return scores.astype(float), np.concatenate([votes.first, votes.second])


def compare(votes: Votes, a: int, b: int, p_tukey: float = math.nan) -> PairScore:
    """Return the comparison of two systems, given by their indices; p is not adjusted."""
    pair = votes.between(a, b)
    p = mean_test(*pair.answers)
    return PairScore(
        votes.systems[a], votes.systems[b], pair.tally, pair.n_raters, share(*pair.answers),
        float(pair.value.mean()), p, p, p_tukey,
    )  # fmt: skip


def _pairs(votes: Votes, variance: Anova | None) -> list[PairScore]:
    tukey = variance.tukey if variance else {}
    pairs = []
    for i, j in combinations(range(len(votes.systems)), 2):
        a, b = (i, j) if votes.wins[i, j] >= votes.wins[j, i] else (j, i)
        if votes.compared[i, j]:
            pairs.append(compare(votes, a, b, tukey.get((i, j), math.nan)))
    adjusted = holm([pair.p for pair in pairs]).tolist()
    return [replace(pair, p_holm=p) for pair, p in zip(pairs, adjusted, strict=True)]
