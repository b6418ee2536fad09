"""Analysis of a whole study: comparisons of systems, alignment with speech, and the sides.

Merit scores (Parizet et al. 2005, as in the diffusion paper): a clear preference scores 2 for the
preferred system, a slight one 1; the other system, and ties, score 0. The merit score is the mean
over all answers in which the system was shown.

Alignment with speech is a system's motion against its own motion of other speech (GENEA). The
alignment score is the share of preferences for the matched motion. Clear preferences weigh 2,
slight ones 1; a tie counts half for either side. Chance is 50 %.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from gesturekit.errors import ConfigError, EvaluationError
from gesturekit.evaluation.pairs import grouped
from gesturekit.evaluation.statistics.answers import MISMATCHED, Answer, Answers, Ratings
from gesturekit.evaluation.statistics.intervals import LEVEL, holm
from gesturekit.evaluation.statistics.scores import (
    MOST_COUNTS,
    Estimate,
    mean_estimate,
    mean_test,
    resampled_weights,
    share,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

ROUNDS = 10_000
"""Rounds of the bootstrap, as GENEA's."""
MERIT = np.array([2.0, 1.0, 0.0, 0.0, 0.0])
ELO = np.array([4.0, 2.0, 1.0, 0.0, 0.0])
ALIGNMENT = np.array([2.0, 1.0, 0.5, 0.0, 0.0])
"""Gains of a system from each answer, from its clear preference to that of the other system. Those
of Elo ratings are the weights of GENEA's analysis: a tie counts for either system."""
SCALE, MEAN = 400.0, 1000.0
_RIDGE = 1e-6  # keeps the strength of a system that lost every comparison finite
_MOST_STEPS = 100


@dataclass(frozen=True, eq=False)
class Votes:
    """Answers that compare two systems: n answers to P pairs of k systems.

    Attributes:
        systems: (k,) names, sorted.
        pairs: (P, 2) indices of the systems of each pair that was compared, sorted.
        pair: (n,) index of the pair.
        answer: (n,) 0 the pair's first system clearly better, 1 slightly better, 2 equal, 3 and 4
            its second system.
        value: (n,) what is tested: the score (2 to -2) or, of ratings, the difference; positive for
            the pair's first system.
        rater, clip: (n,) index of the rater and of the speech segment.
    """

    systems: tuple[str, ...]
    pairs: np.ndarray
    pair: np.ndarray
    answer: np.ndarray
    value: np.ndarray
    rater: np.ndarray
    clip: np.ndarray

    @classmethod
    def of(cls, answers: Sequence[Answer]) -> Votes:
        """Return answers as votes.

        Raises:
            EvaluationError: so many raters and systems that the names cannot be right.
        """
        names = np.array([(answer.left, answer.right) for answer in answers])
        systems, sides = np.unique(names, return_inverse=True)
        rater, clip = (
            np.unique(names, return_inverse=True)[1]
            for names in ([a.user for a in answers], [a.clip for a in answers])
        )
        raters = int(rater.max()) + 1
        if raters * len(systems) ** 2 > MOST_COUNTS:
            raise EvaluationError(
                f"{raters} raters and {len(systems)} systems: more than can be analysed. Are "
                "user, model_a and model_b the right columns?"
            )
        pairs, pair = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
        sign = np.where(sides[:, 0] < sides[:, 1], 1, -1)  # -1: the pair's first is on the right
        answer = 2 - sign * np.array([answer.score for answer in answers])
        value = np.array([a.score if a.difference is None else a.difference for a in answers])
        return cls(tuple(map(str, systems)), pairs, pair, answer, sign * value, rater, clip)

    def on(self, pair: int) -> Votes:
        """Return the votes on one pair; raters and clips keep their indices."""
        rows = np.flatnonzero(self.pair == pair)
        kept = {name: getattr(self, name)[rows] for name in ("answer", "value", "rater", "clip")}
        return replace(self, pairs=self.pairs[[pair]], pair=np.zeros_like(rows), **kept)

    @property
    def tested(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values, raters and clips (n,), as `mean_test` takes them."""
        return self.value, self.rater, self.clip

    @property
    def raters(self) -> int:
        """Number of raters."""
        return len(np.unique(self.rater))

    @cached_property
    def _cells(self) -> csr_matrix:
        """Return (5·P, n) with 1 where a vote is an answer of `counts`."""
        from scipy.sparse import csr_matrix

        n = len(self.pair)
        cells = (5 * self.pair + self.answer, np.arange(n))
        return csr_matrix((np.ones(n), cells), (5 * len(self.pairs), n))

    def counted(self, weights: np.ndarray) -> np.ndarray:
        """Return how often (b, P, 5) each pair got each answer, from votes with weights (b, n)."""
        return (self._cells @ weights.T).T.reshape(len(weights), -1, 5)

    @cached_property
    def counts(self) -> np.ndarray:
        """Numbers (1, P, 5) of each answer to each pair."""
        return self.counted(np.ones((1, len(self.pair))))

    def gains(self, counts: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return what each system i gets (b, k, k) from its comparisons with each system j.

        Args:
            counts: (b, P, 5) how often each pair got each answer.
            weights: (5,) what a system gets for each answer, such as `MERIT`.
        """
        k, (first, second) = len(self.systems), self.pairs.T
        found = np.zeros((len(counts), k, k))
        found[:, first, second] = counts @ weights
        found[:, second, first] = counts @ weights[::-1]
        return found

    def estimates(
        self, statistic: Callable[[np.ndarray], np.ndarray], rounds: int, seed: int
    ) -> list[Estimate]:
        """Return a statistic with its 95 % percentile intervals over raters and clips.

        Args:
            statistic: maps counts (b, P, 5) to values (b, s); NaN where undefined.
            rounds: number of bootstrap rounds.
            seed: the same seed gives the same intervals.

        Returns:
            s estimates; without an interval with a single rater.
        """
        values = statistic(self.counts)[0]
        low = high = np.full(len(values), np.nan)
        if self.raters > 1:
            size = len(self.pair) + 3 * len(self.systems) ** 2
            drawn = resampled_weights(self.rater, self.clip, rounds, seed, size)
            found = np.concatenate([statistic(self.counted(weights)) for weights in drawn])
            tail = (1 - LEVEL) / 2
            low, high = np.nanquantile(found, [tail, 1 - tail], axis=0)
        return [Estimate(*map(float, bounds)) for bounds in zip(values, low, high, strict=True)]


def merit_scores(votes: Votes, counts: np.ndarray) -> np.ndarray:
    """Return the merit scores (b, k) of systems from counts (b, P, 5) of answers."""
    gained, shown = (votes.gains(counts, weights).sum(axis=-1) for weights in (MERIT, np.ones(5)))
    with np.errstate(invalid="ignore"):
        return gained / shown


def alignment_scores(counts: np.ndarray) -> np.ndarray:
    """Return alignment scores (b, P) from counts (b, P, 5) of matched : mismatched motion."""
    matched, mismatched = counts @ ALIGNMENT, counts @ ALIGNMENT[::-1]
    with np.errstate(invalid="ignore"):
        return matched / (matched + mismatched)


def fit_strengths(wins: np.ndarray) -> np.ndarray:
    """Fit Bradley-Terry strengths by maximum likelihood (Newton's method).

    P(i beats j) = 1 / (1 + exp(strength_j - strength_i)): a logistic regression without intercept.

    Args:
        wins: (..., k, k) weighted wins of i over j.

    Returns:
        (..., k) strengths in nats, with mean 0.
    """
    games = wins + np.swapaxes(wins, -1, -2)
    strengths, diagonal = np.zeros(wins.shape[:-1]), np.arange(wins.shape[-1])
    for _ in range(_MOST_STEPS):
        p = 1.0 / (1.0 + np.exp(strengths[..., None, :] - strengths[..., :, None]))
        gradient = (wins - games * p).sum(axis=-1) - _RIDGE * strengths
        curvature = games * p * (1.0 - p)
        hessian = -curvature
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
    """Comparison of two systems, or of a system's matched and mismatched motion.

    Attributes:
        a, b: the systems; `a` was preferred more often, or is the matched motion.
        counts: a clearly, a slightly, equal, b slightly, b clearly.
        raters: raters who compared them.
        win_rate: share of preferences for `a`, ties excluded; interval over raters and clips.
        mean: mean score, 2 to -2, or mean difference of ratings; below 0 if raters prefer `b`.
        p: test of the mean over raters and clips; `p_holm` is adjusted for the number of pairs.
        p_tukey: Tukey's test of merit scores; NaN of ratings and of matched motion.
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


Alignment = tuple[tuple[PairScore, Estimate], ...]
"""Comparison of matched with mismatched motion, and alignment score, of each system; best first."""
Differences = tuple[tuple[str, str, float, float], ...]
"""(a, b, p, p_holm) of the tests between the mean scores of two systems' matched motion."""


@dataclass(frozen=True)
class Preference:
    """Result of a preference test.

    Attributes:
        systems: best first, by Elo rating or, where there is none, by merit.
        pairs: all pairs that were compared.
        not_compared: pairs of systems without a single answer.
        anova: F (`f`), `p` and degrees of freedom (`df`) of the one-way ANOVA of merit scores; None
            if scores of a system do not vary, or of ratings.
        separate: groups of systems that no comparison connects, if there are several.
        bounded: False if a system never lost or never won, so that ratings have no finite value.
        rated: True if the answers are ratings.
    """

    systems: tuple[SystemScore, ...]
    pairs: tuple[PairScore, ...]
    not_compared: tuple[tuple[str, str], ...]
    anova: dict[str, Any] | None
    separate: tuple[tuple[str, ...], ...]
    bounded: bool
    rated: bool


def analyse_preference(
    answers: Sequence[Answer], rounds: int, seed: int, ratings: Ratings | None = None
) -> Preference:
    """Analyse answers that compare systems with each other.

    Args:
        answers: at least one.
        rounds: rounds of the bootstrap over raters and clips.
        seed: the same seed gives the same intervals.
        ratings: the ratings that the answers compare; of votes None.
    """
    votes = Votes.of(answers)
    names, k = votes.systems, len(votes.systems)
    wins = votes.gains(votes.counts, ELO)[0]
    compared = wins + wins.T > 0
    n_groups, group = connected_components(compared, directed=False)

    def merit_and_elo(counts: np.ndarray) -> np.ndarray:
        merit = merit_scores(votes, counts)
        if n_groups > 1:
            return merit
        return np.concatenate([merit, elo(fit_strengths(votes.gains(counts, ELO)))], axis=1)

    estimates = votes.estimates(merit_and_elo, rounds, seed)
    elos = estimates[k:] or [Estimate(math.nan)] * k
    merits, shown = estimates[:k], np.bincount(votes.pairs[votes.pair].ravel()).tolist()
    anova = tukey = None
    if ratings is None:
        anova, tukey = _anova(answers)
    else:
        given = [ratings.kept(ratings.system == ratings.systems.index(name)) for name in names]
        merits = [mean_estimate(r.value, r.rater, r.clip) for r in given]
        shown = [len(r.value) for r in given]
    systems = list(map(SystemScore, names, shown, merits, elos))
    systems.sort(key=lambda s: (-(s.merit if n_groups > 1 else s.elo).value, s.name))
    separate = [tuple(n for n, g in zip(names, group) if g == at) for at in range(n_groups)]
    return Preference(
        systems=tuple(systems),
        pairs=tuple(compare(votes, tukey)),
        not_compared=tuple(
            (names[i], names[j]) for i, j in combinations(range(k), 2) if not compared[i, j]
        ),
        anova=anova,
        separate=tuple(separate) if n_groups > 1 else (),
        # Ford's condition for finite strengths: no group never lost to, or tied with, the others.
        bounded=connected_components(wins > 0, connection="strong")[0] == 1,
        rated=ratings is not None,
    )


def compare(votes: Votes, tukey: np.ndarray | None = None) -> list[PairScore]:
    """Return the comparison of the systems of each pair, with p adjusted by Holm's method.

    Args:
        votes: the answers.
        tukey: (k, k) p-values of Tukey's test, if it was made.
    """
    pairs = [votes.on(pair) for pair in range(len(votes.pairs))]
    p_values = [mean_test(*pair.tested) for pair in pairs]
    found = []
    for pair, p, p_holm in zip(pairs, p_values, holm(p_values).tolist(), strict=True):
        ((i, j),) = pair.pairs.tolist()
        a, b, value = pair.systems[i], pair.systems[j], pair.value
        counts = np.bincount(pair.answer, minlength=5).tolist()
        # First is the system that was preferred more often, or the matched motion.
        if sum(counts[:2]) < sum(counts[3:]) and b != a + MISMATCHED:
            a, b, counts, value = b, a, counts[::-1], -value
        found.append(PairScore(
            a, b, tuple(counts), pair.raters, share(value, pair.rater, pair.clip),
            float(value.mean()), p, p_holm, math.nan if tukey is None else float(tukey[i, j]),
        ))  # fmt: skip
    return found


def _anova(answers: Sequence[Answer]) -> tuple[dict[str, Any] | None, np.ndarray | None]:
    """Return the one-way ANOVA of merit scores, and p-values (k, k) of Tukey's test.

    None if scores do not vary within systems, or if Tukey's test lacks answers to a system.
    """
    from scipy.stats import f_oneway, tukey_hsd

    scores = [(answer.left, max(answer.score, 0)) for answer in answers]
    scores += [(answer.right, max(-answer.score, 0)) for answer in answers]
    groups = [np.array(of_system, float) for _, of_system in sorted(grouped(scores).items())]
    if all(np.ptp(values) == 0 for values in groups):
        return None, None
    f, p = f_oneway(*groups)
    tukey = tukey_hsd(*groups).pvalue if min(map(len, groups)) > 1 else None  # as scipy needs
    return {"f": float(f), "p": float(p), "df": [len(groups) - 1, len(scores) - len(groups)]}, tukey


def analyse_alignment(
    answers: Sequence[Answer], rounds: int, seed: int
) -> tuple[Alignment, Differences]:
    """Analyse answers that compare matched with mismatched motion of one system each.

    Args:
        answers: at least one; all have `matched`.
        rounds: rounds of the bootstrap over raters and clips.
        seed: the same seed gives the same intervals.
    """
    votes = Votes.of(answers)
    found = []
    for pair, compared in enumerate(compare(votes)):
        own = votes.on(pair)
        found.append((compared, own.estimates(alignment_scores, rounds, seed)[0], own.tested))
    found.sort(key=lambda one: (-one[1].value, one[0].a))
    names, p_values = [], []
    for (one, _, first), (other, _, second) in combinations(found, 2):
        names.append((one.a, other.a))
        value, rater, clip = map(np.concatenate, zip(first, second, strict=True))
        p_values.append(mean_test(value, rater, clip, np.arange(len(value)) < len(first[0])))
    tests = zip(names, p_values, holm(p_values).tolist(), strict=True)
    return (
        tuple((pair, score) for pair, score, _ in found),
        tuple((*pair, p, p_holm) for pair, p, p_holm in tests),
    )


@dataclass(frozen=True)
class StudyResult:
    """Result of a user study.

    Attributes:
        answers: answers that counted, and notes on the others.
        raters, clips: numbers of raters and of speech segments.
        left: share of preferences for the left side, with its interval; NaN of ratings.
        preference: comparison of systems; None if none were compared, or if ratings answer several
            questions.
        by_style: {style or question: comparison of systems} if there were several.
        alignment, differences: matched against mismatched motion, and systems in that.
        reasons: {reason: number of answers that give it}, most frequent first.
        rounds, seed: settings of the bootstrap.
    """

    answers: Answers
    raters: int
    clips: int
    left: Estimate
    preference: Preference | None
    by_style: dict[str, Preference]
    alignment: Alignment
    differences: Differences
    reasons: dict[str, int]
    rounds: int
    seed: int


def analyse_study(answers: Answers, *, rounds: int = ROUNDS, seed: int = 0) -> StudyResult:
    """Analyse the answers of a study.

    Args:
        answers: the result of `read_answers`.
        rounds: rounds of the bootstrap over raters and clips.
        seed: the same seed gives the same intervals.

    Raises:
        ConfigError: `rounds` is not positive.
        EvaluationError: too many raters and systems.
    """
    if rounds < 1:
        raise ConfigError(f"rounds is {rounds}: the bootstrap needs at least 1, better 10000")
    kept, ratings = answers.kept, answers.ratings
    matched = [answer for answer in kept if answer.matched]
    compared = [answer for answer in kept if not answer.matched]
    styles = sorted({answer.style for answer in compared if answer.style})
    by_style = {}
    for style in styles if len(styles) > 1 else ():
        given = ratings and ratings.kept(ratings.question == ratings.questions.index(style))
        of_style = [answer for answer in compared if answer.style == style]
        by_style[style] = analyse_preference(of_style, rounds, seed, given)
    # Ratings of different questions have no common mean, and no left side.
    together = compared and not (ratings and by_style)
    alignment, differences = analyse_alignment(matched, rounds, seed) if matched else ((), ())
    left = Estimate(math.nan)
    if ratings is None:
        votes = Votes.of(kept)
        left = share(np.array([answer.score for answer in kept]), votes.rater, votes.clip)
    return StudyResult(
        answers=answers,
        raters=len({answer.user for answer in kept}),
        clips=len({answer.clip for answer in kept}),
        left=left,
        preference=analyse_preference(compared, rounds, seed, ratings) if together else None,
        by_style=by_style,
        alignment=alignment,
        differences=differences,
        reasons=dict(Counter(r for answer in kept for r in answer.reasons).most_common()),
        rounds=rounds,
        seed=seed,
    )
