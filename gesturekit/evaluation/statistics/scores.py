"""Statistics of what people say of systems, over raters and clips.

Answers of one rater are not independent, nor are those on one clip. The variance of a mean is
therefore that over raters plus that over clips less that over the pairs of both (Cameron, Gelbach
and Miller 2011), and at least that over either alone; degrees of freedom are Satterthwaite's of the
sum of the first two. With a single clip, it is that over raters. Other statistics have the
pigeonhole bootstrap (Owen 2007): raters and clips are drawn again with replacement, independently
of each other, and an answer counts as often as its rater was drawn times as often as its clip was.

Ratings are modelled as system + rater + clip, by least squares: the score of a system is the mean
of its ratings after removal of each rater's and each clip's mean, adjusted for the systems that
this rater or clip has. If every rater rates all systems, it is the mean of rater-centred ratings.
Pairwise votes need no such model: every rater's mean is one half, and the score is the share of
comparisons won.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gesturekit.evaluation.statistics.answers import Ratings
from gesturekit.evaluation.statistics.intervals import LEVEL, holm

RESAMPLES = 1000
MOST_COUNTS = 20_000_000
"""Largest number of values that a bootstrap holds at a time."""


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval; NaN bounds where there is none."""

    value: float
    low: float = math.nan
    high: float = math.nan


def mean_test(
    scores: np.ndarray, rater: np.ndarray, clip: np.ndarray, group: np.ndarray | None = None
) -> float:
    """Return the p-value of "the mean score is 0", or of "the means of two groups are equal".

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
        return math.nan
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
    return max(raters + clips - pairs, raters, clips), freedom_of(raters, free, clips, clips_free)


def freedom_of(raters: float, raters_free: int, clips: float, clips_free: int) -> float:
    """Return the degrees of freedom of the variances over raters and over clips together.

    Satterthwaite's of their sum, and at most those of one of them. Leaving out the pairs of both
    keeps false positives below 7 % with 12 clips (benchmarks/study_false_positives.py).
    """
    spread = raters**2 / raters_free + clips**2 / max(clips_free, 1)
    freedom = (raters + clips) ** 2 / spread if spread > 0.0 else 1.0
    return min(freedom, max(raters_free, clips_free))


def mean_estimate(values: np.ndarray, rater: np.ndarray, clip: np.ndarray) -> Estimate:
    """Return the mean of ratings with its 95 % interval over raters and clips."""
    from scipy.stats import t

    mean = float(values.mean())
    if len(np.unique(rater)) < 2:
        return Estimate(mean)
    variance, freedom = _variance((values - mean) / len(values), rater, clip)
    half = float(t.ppf(0.975, freedom)) * math.sqrt(variance)
    return Estimate(mean, mean - half, mean + half)


def share(scores: np.ndarray, rater: np.ndarray, clip: np.ndarray) -> Estimate:
    """Return the share of positive scores among those other than 0, with its 95 % interval.

    Wilson's interval with the number of independent answers that the variance over raters and clips
    amounts to, and Student's t for the normal quantile (Korn and Graubard 1998).

    Args:
        scores: (n,) answers.
        rater, clip: (n,) index of the rater and of the clip of each.
    """
    from scipy.stats import norm, t

    kept = scores != 0
    won, rater, clip = scores[kept] > 0, rater[kept], clip[kept]
    value = float(won.mean()) if len(won) else math.nan
    units = [len(np.unique(unit)) for unit in (rater, clip)]
    if units[0] < 2:
        return Estimate(value)
    n, z = float(min(count for count in units if count > 1)), float(norm.ppf(0.975))
    if 0.0 < value < 1.0:
        variance, freedom = _variance((won - value) / len(won), rater, clip)
        wider = (t.ppf(0.975, freedom) / z) ** 2
        n = min(float(len(won)), value * (1.0 - value) / max(variance * wider, 1e-12))
    middle = (value + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z * math.sqrt(value * (1 - value) / n + (z / (2 * n)) ** 2) / (1 + z**2 / n)
    return Estimate(value, max(0.0, middle - half), min(1.0, middle + half))


def resampled_weights(
    rater: np.ndarray, clip: np.ndarray, rounds: int, seed: int, size: int
) -> Iterator[np.ndarray]:
    """Yield the weights (b, n) of answers in samples of the pigeonhole bootstrap.

    Args:
        rater, clip: (n,) index of the rater and of the clip of each answer.
        rounds: number of samples; some hundred are drawn at a time.
        seed: the same seed gives the same samples.
        size: number of values that a sample takes, at most `MOST_COUNTS` at a time.
    """
    rng = np.random.default_rng(seed)
    chunk = max(1, MOST_COUNTS // size)
    for start in range(0, rounds, chunk):
        weights = np.ones((min(chunk, rounds - start), len(rater)))
        for unit in (rater, clip):
            n = int(unit.max()) + 1
            weights *= rng.multinomial(n, np.full(n, 1.0 / n), len(weights))[:, unit]
        yield weights


@dataclass(frozen=True)
class Scores:
    """Scores of systems for one question.

    Attributes:
        systems: names of the systems that have ratings.
        values: (S,) scores, with the mean 0 (0.5 for pairwise votes).
        resampled: (B, S) scores of each bootstrap sample; NaN for a system without any rating.
        differ: (S, S) True for pairs whose scores differ significantly, by Holm's method.
        raters, clips, ratings: their numbers; a pairwise vote is one rating.
        note: "" or a remark on the design of the study.
    """

    systems: tuple[str, ...]
    values: np.ndarray
    resampled: np.ndarray
    differ: np.ndarray
    raters: int
    clips: int
    ratings: int
    note: str


def scores_of(ratings: Ratings, kept: np.ndarray, systems: Sequence[str], seed: int = 0) -> Scores:
    """Return scores of systems from some of the ratings.

    Args:
        ratings: the study.
        kept: (n,) True for the ratings of one question, and of these systems.
        systems: systems in the wanted order; those without any rating are left out.
        seed: seed of the bootstrap.
    """
    given = np.array(ratings.systems, object)[ratings.system[kept]]
    names = tuple(name for name in systems if name in given)
    of_system = (given[:, None] == np.array(names, object)).astype(float)
    system = of_system.argmax(axis=1)
    rater, clip = (
        np.unique(column[kept], return_inverse=True)[1] for column in (ratings.rater, ratings.clip)
    )
    values, note = ratings.value[kept].astype(float), ""
    if not ratings.paired:
        values, note = _without_raters_and_clips(values, system, rater, clip)
    resampled = []
    for weights in resampled_weights(rater, clip, RESAMPLES, seed, len(values)):
        with np.errstate(invalid="ignore"):
            resampled.append(weights @ (of_system * values[:, None]) / (weights @ of_system))
    p = []
    for one, other in combinations(range(len(names)), 2):
        rows = (system == one) | (system == other)
        p.append(mean_test(values[rows], rater[rows], clip[rows], system[rows] == one))
    differ = np.zeros((len(names), len(names)), bool)
    differ[np.triu_indices(len(names), 1)] = holm(p) < 1.0 - LEVEL
    return Scores(
        names,
        np.bincount(system, values) / np.bincount(system),
        np.concatenate(resampled),
        differ | differ.T,
        int(rater.max()) + 1,
        int(clip.max()) + 1,
        len(values) // (2 if ratings.paired else 1),
        note,
    )


def _without_raters_and_clips(
    values: np.ndarray, system: np.ndarray, rater: np.ndarray, clip: np.ndarray
) -> tuple[np.ndarray, str]:
    """Return ratings (n,) less the effects of raters and clips, and a note if one cannot be known.

    An effect can be separated from those of systems only if it connects them: raters who rate a
    single system each say nothing about the difference of two.
    """
    from scipy.sparse import csr_matrix, hstack
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import lsqr

    rows, n = np.arange(len(values)), int(system.max()) + 1
    parts = [csr_matrix((np.ones(len(values)), (rows, system)))]
    note = []
    for name, column in (("rater", rater), ("clip", clip)):
        part = csr_matrix((np.ones(len(values)), (rows, column)))
        # The graph of systems in which those of one rater (or clip) are neighbours.
        if connected_components((parts[0].T @ part) @ (part.T @ parts[0]))[0] == 1:
            parts.append(part)
        else:
            note.append(f"{name}s do not connect the systems: {name} means were not removed")
    centred = values - values.mean()
    effects = lsqr(hstack(parts).tocsr(), centred, 1e-10, 1e-10)[0]
    others = hstack(parts[1:]).tocsr() @ effects[n:] if parts[1:] else 0.0
    scores = np.bincount(system, centred - others) / np.bincount(system)
    return centred - others - scores.mean(), "; ".join(note)
