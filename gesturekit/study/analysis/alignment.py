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
from gesturekit.study.analysis.preference import PairScore, compare
from gesturekit.study.analysis.significance import Estimate, mean_test
from gesturekit.study.analysis.votes import Votes


@dataclass(frozen=True)
class AlignmentScore(PairScore):
    """Alignment of one system: its matched motion `a` against its motion of other speech `b`.

    Attributes:
        score: alignment score, 0 to 1; interval by bootstrap over raters and clips.
    """

    score: Estimate

    @property
    def name(self) -> str:
        """The system."""
        return self.a


@dataclass(frozen=True)
class Alignment:
    """Alignment of all systems, best first.

    Attributes:
        systems: scores.
        differences: (a, b, p, p_holm) of the test between the mean scores of two systems.
    """

    systems: tuple[AlignmentScore, ...]
    differences: tuple[tuple[str, str, float, float], ...]


def analyse_alignment(answers: Sequence[Answer], rounds: int, seed: int) -> Alignment:
    """Analyse answers that compare matched with mismatched motion of one system each.

    Args:
        answers: at least one; all have `matched`.
        rounds: rounds of the bootstrap over raters and clips.
        seed: the same seed gives the same intervals.
    """
    names = sorted({answer.matched for answer in answers if answer.matched})
    votes = Votes.of(answers)
    own = {name: _matched(votes, name) for name in names}
    found = [_score(votes, own[name], rounds, seed) for name in names]
    adjusted = holm([score.p for score in found]).tolist()
    scores = [replace(score, p_holm=p) for score, p in zip(found, adjusted, strict=True)]
    scores.sort(key=lambda score: (-score.score.value, score.name))
    pairs = list(combinations(scores, 2))
    p_values = [_difference(own[a.name], own[b.name]) for a, b in pairs]
    differences = [
        (a.name, b.name, p, p_holm)
        for (a, b), p, p_holm in zip(pairs, p_values, holm(p_values), strict=True)
    ]
    return Alignment(tuple(scores), tuple(differences))


def _matched(votes: Votes, name: str) -> Votes:
    """Return the votes on a system; positive scores are for its matched motion."""
    return votes.between(votes.systems.index(name), votes.systems.index(name + MISMATCHED))


def _difference(one: Votes, other: Votes) -> float:
    """Return the p-value of "both mean scores are equal"."""
    scores, rater, clip = map(np.concatenate, zip(one.answers, other.answers, strict=True))
    return mean_test(scores, rater, clip, np.arange(len(scores)) < len(one.score))


def _score(votes: Votes, own: Votes, rounds: int, seed: int) -> AlignmentScore:
    matched, other = int(own.first[0]), int(own.second[0])

    def alignment(counts: np.ndarray) -> np.ndarray:
        clear, slight, ties = np.moveaxis(counts, 1, 0)
        won, lost = (
            2.0 * clear[:, i, j] + slight[:, i, j] + 0.5 * ties[:, i, j]
            for i, j in ((matched, other), (other, matched))
        )
        with np.errstate(invalid="ignore"):
            return (won / (won + lost))[:, None]

    (score,) = own.estimates(alignment, rounds, seed)
    return AlignmentScore(**vars(compare(votes, matched, other)), score=score)
