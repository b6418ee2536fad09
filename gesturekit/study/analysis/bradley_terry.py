"""Bradley-Terry model: strengths of systems from paired comparisons, and Elo ratings."""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import connected_components

from gesturekit.study.analysis.votes import Votes

WEIGHTS = {"clear": 4.0, "slight": 2.0, "tie": 1.0}
"""Weight of an answer, as in GENEA's analysis; a tie counts for either system."""
SCALE, MEAN = 400.0, 1000.0
_RIDGE = 1e-6  # keeps the strength of a system that lost every comparison finite
_MOST_STEPS = 100


def weighted_wins(votes: Votes) -> np.ndarray:
    """Return the weighted wins (R, k, k) of i over j of each rater."""
    return (
        WEIGHTS["clear"] * votes.clear
        + WEIGHTS["slight"] * votes.slight
        + WEIGHTS["tie"] * votes.ties
    )


def fit(wins: np.ndarray) -> np.ndarray:
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


def groups(wins: np.ndarray) -> list[list[int]]:
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
