"""Scores that people give to systems, with their uncertainty over raters and clips.

A rating is modelled as system + rater + clip, by least squares: the score of a system is the mean
of its ratings after removal of each rater's and each clip's mean, adjusted for the systems that
this rater or clip has. If every rater rates all systems, it is the mean of rater-centred ratings.
Pairwise votes need no such model: every rater's mean is one half, and the score is the share of
comparisons won.

Uncertainty is that of the pigeonhole bootstrap (Owen 2007): raters and clips are drawn again with
replacement, independently of each other, and a rating counts as often as its rater was drawn times
as often as its clip was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gesturekit.evaluation.statistics.intervals import LEVEL, holm, p_value
from gesturekit.evaluation.statistics.ratings import Ratings

RESAMPLES = 1000
_CELLS = 4_000_000
"""Largest number of weights that are held at a time."""


@dataclass(frozen=True)
class Scores:
    """Scores of systems for one question.

    Attributes:
        systems: names of the systems that have ratings.
        values: (S,) scores, with the mean 0 (0.5 for pairwise votes).
        resampled: (B, S) scores of each bootstrap sample; NaN for a system without any rating.
        differ: (S, S) True for pairs whose scores differ significantly.
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
    at = {name: index for index, name in enumerate(ratings.systems)}
    counts = np.bincount(ratings.system[kept], minlength=len(at))
    names = tuple(name for name in systems if name in at and counts[at[name]])
    order = np.zeros(len(at), int)
    order[[at[name] for name in names]] = range(len(names))
    system = order[ratings.system[kept]]
    rater, clip = (
        np.unique(column[kept], return_inverse=True)[1] for column in (ratings.rater, ratings.clip)
    )
    values, note = ratings.value[kept].astype(float), ""
    if not ratings.paired:
        values, note = _without_raters_and_clips(values, system, rater, clip)
    sums, n = (np.bincount(system, weights) for weights in (values, None))
    return Scores(
        names,
        sums / n,
        _resampled(values, system, rater, clip, seed),
        _differ(values, system, rater, clip),
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
    from scipy.sparse import coo_matrix, csr_matrix, hstack
    from scipy.sparse.linalg import lsqr

    rows = np.arange(len(values))
    parts = [csr_matrix((np.ones(len(values)), (rows, system)))]
    note = []
    for name, column in (("rater", rater), ("clip", clip)):
        if _connects(system, column):
            parts.append(csr_matrix((np.ones(len(values)), (rows, column))))
        else:
            note.append(f"{name}s do not connect the systems: {name} means were not removed")
    centred = values - values.mean()
    effects = lsqr(hstack([coo_matrix(part) for part in parts]).tocsr(), centred, 1e-10, 1e-10)[0]
    n = system.max() + 1
    others = hstack(parts[1:]).tocsr() @ effects[n:] if parts[1:] else 0.0
    scores = np.bincount(system, centred - others) / np.bincount(system)
    return centred - others - scores.mean(), "; ".join(note)


def _connects(system: np.ndarray, column: np.ndarray) -> bool:
    """Return whether all systems are linked by raters (or clips) that have several of them."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    n = system.max() + 1
    size = n + column.max() + 1
    graph = csr_matrix((np.ones(len(system)), (system, n + column)), (size, size))
    return len(set(connected_components(graph, directed=False)[1][:n])) == 1


def _resampled(
    values: np.ndarray, system: np.ndarray, rater: np.ndarray, clip: np.ndarray, seed: int
) -> np.ndarray:
    """Return (B, S) scores of bootstrap samples of raters and clips."""
    from scipy.sparse import csr_matrix

    rng = np.random.default_rng(seed)
    systems, raters, clips = (column.max() + 1 for column in (system, rater, clip))
    cells, shape = (system * clips + clip, rater), (systems * clips, raters)
    sums, counts = (csr_matrix((w, cells), shape) for w in (values, np.ones(len(values))))
    block = max(1, _CELLS // max(shape))
    found = []
    for start in range(0, RESAMPLES, block):
        size = min(block, RESAMPLES - start)
        drawn = rng.multinomial(raters, np.full(raters, 1.0 / raters), size).T.astype(float)
        weights = rng.multinomial(clips, np.full(clips, 1.0 / clips), size).T
        total, n = (
            np.einsum("scb,cb->bs", (table @ drawn).reshape(systems, clips, size), weights)
            for table in (sums, counts)
        )
        with np.errstate(invalid="ignore"):
            found.append(total / n)
    return np.concatenate(found)


def _differ(
    values: np.ndarray, system: np.ndarray, rater: np.ndarray, clip: np.ndarray
) -> np.ndarray:
    """Return (S, S) True for pairs of systems whose scores differ significantly.

    A pair must differ over raters, and over clips where clips have both systems: its p-value is the
    larger one of both. Holm's method is over all pairs.
    """
    over_raters, over_clips = (_p_values(values, system, column) for column in (rater, clip))
    p = np.where(np.isnan(over_raters), np.nan, np.fmax(over_raters, over_clips))
    n = system.max() + 1
    found = np.zeros((n, n), bool)
    found[np.triu_indices(n, 1)] = holm(p) < 1.0 - LEVEL
    return found | found.T


def _p_values(values: np.ndarray, system: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return the p-values (P,) of all pairs of systems, with raters or clips as units.

    Student's t of the differences between both systems' means within a unit, over units that have
    both; NaN with fewer than two. Ratings of one rater, or of one clip, are not independent.
    """
    n, units = system.max() + 1, unit.max() + 1
    cells = unit * n + system
    with np.errstate(invalid="ignore"):
        means = np.bincount(cells, values, units * n) / np.bincount(cells, minlength=units * n)
    means = means.reshape(units, n)
    p = []
    for one, other in combinations(range(n), 2):
        gap = means[:, one] - means[:, other]
        gap = gap[~np.isnan(gap)]
        free = len(gap) - 1
        error = gap.std(ddof=1) / np.sqrt(len(gap)) if free > 0 else np.nan
        p.append(p_value(float(gap.mean()), error, free) if free > 0 else np.nan)
    return np.array(p)
