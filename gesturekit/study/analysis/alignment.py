"""Alignment with speech: a system's motion against its own motion of other speech (GENEA).

The alignment score is the share of preferences for the matched motion. Clear preferences weigh 2,
slight ones 1; a tie counts half for either side. Chance is 50 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from gesturekit.evaluation.statistics.answers import MISMATCHED, Answer
from gesturekit.evaluation.statistics.intervals import holm
from gesturekit.study.analysis.significance import (
    Estimate,
    rater_means,
    rater_test,
    two_proportions,
    wilson,
)
from gesturekit.study.analysis.votes import Votes, interval


@dataclass(frozen=True)
class AlignmentScore:
    """Alignment of one system.

    Attributes:
        name: the system.
        counts: matched clearly better, slightly, equal, mismatched slightly, clearly.
        raters: raters who judged it.
        score: alignment score, 0 to 1; interval by bootstrap over raters.
        win_rate: share of preferences for the matched motion, ties excluded; Wilson interval.
        mean: mean of the raters' mean scores, 2 to -2; below 0 if raters prefer other speech.
        p: t-test of the raters' mean scores against chance; `p_holm` for all systems.
    """

    name: str
    counts: tuple[int, ...]
    raters: int
    score: Estimate
    win_rate: Estimate
    mean: float
    p: float
    p_holm: float


@dataclass(frozen=True)
class Alignment:
    """Alignment of all systems, best first.

    Attributes:
        systems: scores.
        differences: (a, b, p, p_holm) of Barnard's test between the win rates of two systems.
    """

    systems: tuple[AlignmentScore, ...]
    differences: tuple[tuple[str, str, float, float], ...]


def analyse_alignment(answers: Sequence[Answer], rounds: int, seed: int) -> Alignment:
    """Analyse answers that compare matched with mismatched motion of one system each.

    Args:
        answers: at least one; all have `matched`.
        rounds: rounds of the bootstrap over raters.
        seed: the same seed gives the same intervals.
    """
    found = []
    for name in sorted({answer.matched for answer in answers if answer.matched}):
        votes = Votes.of([answer for answer in answers if answer.matched == name])
        found.append(_score(name, votes, rounds, seed))
    adjusted = holm([score.p for score in found]).tolist()
    scores = [replace(score, p_holm=p) for score, p in zip(found, adjusted, strict=True)]
    scores.sort(key=lambda score: (-score.score.value, score.name))
    pairs = list(combinations(scores, 2))
    p_values = [two_proportions(_preferences(a), _preferences(b)) for a, b in pairs]
    differences = [
        (a.name, b.name, p, p_holm)
        for (a, b), p, p_holm in zip(pairs, p_values, holm(p_values), strict=True)
    ]
    return Alignment(tuple(scores), tuple(differences))


def _preferences(score: AlignmentScore) -> tuple[int, int]:
    clear, slight, _, other_slight, other_clear = score.counts
    return clear + slight, other_slight + other_clear


def _score(name: str, votes: Votes, rounds: int, seed: int) -> AlignmentScore:
    own, other = votes.systems.index(name), votes.systems.index(name + MISMATCHED)
    counts = np.stack(
        [
            votes.clear[:, own, other],
            votes.slight[:, own, other],
            votes.ties[:, own, other],
            votes.slight[:, other, own],
            votes.clear[:, other, own],
        ],
        axis=1,
    )

    def share(sums: np.ndarray) -> np.ndarray:
        n = sums @ np.array([2.0, 1.0, 1.0, 1.0, 2.0])
        with np.errstate(invalid="ignore"):
            return (sums @ np.array([2.0, 1.0, 0.5, 0.0, 0.0]) / n)[:, None]

    low, high = interval(counts, share, rounds, np.random.default_rng(seed))
    total = counts.sum(axis=0)
    answers = counts @ np.array([2.0, 1.0, 0.0, -1.0, -2.0]), counts.sum(axis=1)
    return AlignmentScore(
        name=name,
        counts=tuple(int(n) for n in total),
        raters=int((counts.sum(axis=1) > 0).sum()),
        score=Estimate(float(share(total[None])[0, 0]), float(low[0]), float(high[0])),
        win_rate=wilson(total[0] + total[1], total.sum() - total[2]),
        mean=float(rater_means(*answers).mean()),
        p=rater_test(*answers),
        p_holm=float("nan"),
    )
