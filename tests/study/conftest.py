"""Simulated answers."""

from collections.abc import Callable

import numpy as np
import pytest

from gesturekit.evaluation import Answer
from gesturekit.study import Votes

ANSWER_BOUNDS = (0.3, 1.2)  # of a preference's size: below equal, slight, clear


@pytest.fixture(scope="session")
def simulate() -> Callable[..., Votes]:
    """simulate(strengths, raters=40, answers=36, spread=0.3, seed=0): votes of simulated raters.

    Each rater has strengths of the systems of its own, normal around those given; answers follow
    the logistic law of Bradley and Terry.
    """

    def make(strengths, raters=40, answers=36, spread=0.3, seed=0) -> Votes:
        rng, k = np.random.default_rng(seed), len(strengths)
        own = np.asarray(strengths) + spread * rng.standard_normal((raters, k))
        pairs = np.array([(i, j) for i in range(k) for j in range(k) if i != j])
        shown = pairs[rng.integers(len(pairs), size=(raters, answers))]
        row = np.arange(raters)[:, None]
        difference = own[row, shown[..., 0]] - own[row, shown[..., 1]]
        difference = difference + rng.logistic(size=difference.shape)
        size = np.digitize(np.abs(difference), ANSWER_BOUNDS)
        better = np.where(difference > 0, shown[..., 0], shown[..., 1])
        worse = shown.sum(axis=-1) - better
        counts = np.zeros((3, raters, k, k))
        np.add.at(counts, (size, np.broadcast_to(row, size.shape), better, worse), 1)
        ties = counts[0] + counts[0].transpose(0, 2, 1)
        names = tuple("abcdefgh"[:k])
        raters = tuple(f"r{r:05d}" for r in range(raters))
        return Votes(names, raters, counts[2], counts[1], ties)

    return make


@pytest.fixture(scope="session")
def answers_of() -> Callable[[Votes], list[Answer]]:
    """answers_of(votes): the answers that give these votes, sides in turn."""

    def make(votes: Votes) -> list[Answer]:
        found = []
        for score, counts in ((2, votes.clear), (1, votes.slight), (0, np.triu(votes.ties))):
            for r, i, j in np.argwhere(counts):
                for n in range(int(counts[r, i, j])):
                    a, b, s = votes.systems[i], votes.systems[j], score
                    if (n + r) % 2:
                        a, b, s = b, a, -s
                    found.append(Answer(votes.raters[r], f"clip{len(found) % 36}", a, b, s))
        return found

    return make
