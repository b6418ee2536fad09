"""Simulated answers."""

from collections.abc import Callable

import numpy as np
import pytest

from gesturekit.evaluation import Answer

ANSWER_BOUNDS = (0.3, 1.2)  # of a preference's size: below equal, slight, clear


@pytest.fixture(scope="session")
def simulate() -> Callable[..., list[Answer]]:
    """simulate(strengths, raters=40, answers=36, spread=0.3, seed=0): answers of simulated raters.

    Each rater has strengths of the systems of its own, normal around those given; answers follow
    the logistic law of Bradley and Terry. Each is on a clip of its own, of 36.
    """

    def make(strengths, raters=40, answers=36, spread=0.3, seed=0) -> list[Answer]:
        rng, k = np.random.default_rng(seed), len(strengths)
        own = np.asarray(strengths) + spread * rng.standard_normal((raters, k))
        pairs = np.array([(i, j) for i in range(k) for j in range(k) if i != j])
        found = []
        for r in range(raters):
            for n, (i, j) in enumerate(pairs[rng.integers(len(pairs), size=answers)]):
                better = own[r, i] - own[r, j] + rng.logistic()
                score = int(np.sign(better)) * int(np.digitize(abs(better), ANSWER_BOUNDS))
                clip = f"clip{(n + 12 * r) % 36}"
                found.append(Answer(f"r{r:05d}", clip, "abcdefgh"[i], "abcdefgh"[j], score))
        return found

    return make
