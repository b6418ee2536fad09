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
WEIGHTS = np.array([4.0, 2.0, 1.0])
"""Weights of a clear and a slight preference and of a tie, as in GENEA's analysis; a tie counts for
either system."""
SCALE, MEAN = 400.0, 1000.0
_RIDGE = 1e-6  # keeps the strength of a system that lost every comparison finite
_MOST_STEPS = 100


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
        if raters * len(systems) ** 2 > MOST_COUNTS:
            raise EvaluationError(
                f"{raters} raters and {len(systems)} systems: more than can be analysed. Are "
                "user, model_a and model_b the right columns?"
            )
        score = np.array([answer.score for answer in answers])
        value = np.array([a.score if a.difference is None else a.difference for a in answers])
        first, second = shown.reshape(-1, 2).T
        return cls(tuple(map(str, systems)), first, second, score, value, rater, clip)

    def between(self, one: int, other: int) -> Votes:
        """Return the votes on two systems; positive scores are for `one`."""
        forward = (self.first == one) & (self.second == other)
        kept = forward | ((self.first == other) & (self.second == one))
        sign = np.where(forward, 1, -1)[kept]
        first, second = (np.full(len(sign), system) for system in (one, other))
        score, value = (sign * values[kept] for values in (self.score, self.value))
        return Votes(self.systems, first, second, score, value, self.rater[kept], self.clip[kept])

    @property
    def answers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values, raters and clips (n,), as `mean_test` and `share` take them."""
        return self.value, self.rater, self.clip

    @property
    def n_raters(self) -> int:
        """Number of raters."""
        return len(np.unique(self.rater))

    @cached_property
    def _cells(self) -> csr_matrix:
        """Return (n, 3·k·k) with 1 at the cell of `counts` that each vote is counted in."""
        from scipy.sparse import csr_matrix

        k = len(self.systems)
        better = np.where(self.score >= 0, self.first, self.second)
        worse = self.first + self.second - better
        cells = ((2 - np.abs(self.score)) * k + better) * k + worse
        rows = np.arange(len(better))
        return csr_matrix((np.ones(len(rows)), (rows, cells)), (len(rows), 3 * k * k))

    def counted(self, weights: np.ndarray) -> np.ndarray:
        """Return counts (b, 3, k, k) of votes with weights (b, n).

        They are of clear and slight preferences of i to j, and of ties of both.
        """
        k = len(self.systems)
        counts = (self._cells.T @ weights.T).T.reshape(-1, 3, k, k)
        counts[:, 2] += counts[:, 2].swapaxes(1, 2)
        return counts

    @cached_property
    def counts(self) -> np.ndarray:
        """Numbers (3, k, k) of clear and slight preferences of i to j, and of ties of both."""
        return self.counted(np.ones((1, len(self.score))))[0]

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
            size = len(self.score) + self._cells.shape[1]
            drawn = resampled_weights(self.rater, self.clip, rounds, seed, size)
            found = np.concatenate([statistic(self.counted(weights)) for weights in drawn])
            tail = (1 - LEVEL) / 2
            low, high = np.nanquantile(found, [tail, 1 - tail], axis=0)
        return [Estimate(*map(float, bounds)) for bounds in zip(values, low, high, strict=True)]


def merit_scores(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return merit scores (..., k) and numbers of answers (..., k) from counts of `Votes`."""
    clear, slight, ties = np.moveaxis(counts, -3, 0)
    preferences = clear + slight
    shown = (preferences + preferences.swapaxes(-1, -2) + ties).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (2 * clear + slight).sum(axis=-1) / shown, shown


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
    p_tukey: float = math.nan


@dataclass(frozen=True)
class AlignmentScore(PairScore):
    """Alignment of one system: its matched motion `a` against its motion of other speech `b`.

    Attributes:
        score: alignment score, 0 to 1; interval by bootstrap over raters and clips.
    """

    score: Estimate = Estimate(math.nan)


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
    names, k, wins = votes.systems, len(votes.systems), weighted_wins(votes.counts)
    n_groups, group = connected_components(wins + wins.T > 0, directed=False)

    def merit_and_elo(counts: np.ndarray) -> np.ndarray:
        merit, _ = merit_scores(counts)
        if n_groups > 1:
            return merit
        return np.concatenate([merit, elo(fit_strengths(weighted_wins(counts)))], axis=1)

    estimates = votes.estimates(merit_and_elo, rounds, seed)
    elos = estimates[k:] or [Estimate(math.nan)] * k
    merits, shown = estimates[:k], merit_scores(votes.counts)[1].astype(int).tolist()
    anova, tukey = None, np.full((k, k), np.nan)
    if ratings is None:
        anova, tukey = _anova(votes)
    else:
        given = [ratings.kept(ratings.system == ratings.systems.index(name)) for name in names]
        merits = [mean_estimate(r.value, r.rater, r.clip) for r in given]
        shown = [len(r.value) for r in given]
    systems = list(map(SystemScore, names, shown, merits, elos))
    systems.sort(key=lambda s: (-(s.merit if n_groups > 1 else s.elo).value, s.name))
    compared = np.triu(votes.counts.sum(axis=0) + votes.counts[:2].sum(axis=0).T, 1)
    won = votes.counts[:2].sum(axis=0)
    pairs = [
        replace(compare(votes, *((i, j) if won[i, j] >= won[j, i] else (j, i))),
                p_tukey=float(tukey[i, j]))
        for i, j in zip(*np.nonzero(compared), strict=True)
    ]  # fmt: skip
    adjusted = holm([pair.p for pair in pairs]).tolist()
    separate = [tuple(n for n, g in zip(names, group) if g == at) for at in range(n_groups)]
    return Preference(
        systems=tuple(systems),
        pairs=tuple(replace(pair, p_holm=p) for pair, p in zip(pairs, adjusted, strict=True)),
        not_compared=tuple(
            (names[i], names[j]) for i, j in combinations(range(k), 2) if not compared[i, j]
        ),
        anova=anova,
        separate=tuple(separate) if n_groups > 1 else (),
        # Ford's condition for finite strengths: no group never lost to, or tied with, the others.
        bounded=connected_components(wins > 0, connection="strong")[0] == 1,
        rated=ratings is not None,
    )


def compare(votes: Votes, a: int, b: int) -> PairScore:
    """Return the comparison of two systems, given by their indices; p is not adjusted."""
    pair = votes.between(a, b)
    p = mean_test(*pair.answers)
    counts = tuple(int((pair.score == score).sum()) for score in (2, 1, 0, -1, -2))
    return PairScore(
        votes.systems[a], votes.systems[b], counts, pair.n_raters, share(*pair.answers),
        float(pair.value.mean()), p, p,
    )  # fmt: skip


def _anova(votes: Votes) -> tuple[dict[str, Any] | None, np.ndarray]:
    """Return the one-way ANOVA of merit scores, and p-values (k, k) of Tukey's test.

    None if scores do not vary within systems; NaN if a system has a single answer.
    """
    from scipy.stats import f_oneway, tukey_hsd

    k, system = len(votes.systems), np.concatenate([votes.first, votes.second])
    scores = np.maximum(np.concatenate([votes.score, -votes.score]), 0).astype(float)
    groups = [scores[system == index] for index in range(k)]
    tukey = np.full((k, k), np.nan)
    if all(np.ptp(values) == 0 for values in groups):
        return None, tukey
    f, p = f_oneway(*groups)
    if min(map(len, groups)) > 1:  # as scipy needs
        tukey = tukey_hsd(*groups).pvalue
    return {"f": float(f), "p": float(p), "df": [k - 1, len(scores) - k]}, tukey


def analyse_alignment(
    answers: Sequence[Answer], rounds: int, seed: int
) -> tuple[tuple[AlignmentScore, ...], tuple[tuple[str, str, float, float], ...]]:
    """Analyse answers that compare matched with mismatched motion of one system each.

    Args:
        answers: at least one; all have `matched`.
        rounds: rounds of the bootstrap over raters and clips.
        seed: the same seed gives the same intervals.

    Returns:
        the scores, best first, and (a, b, p, p_holm) of the tests between the mean scores of two
        systems.
    """
    votes, scores, own = Votes.of(answers), [], {}
    for name in sorted({answer.matched for answer in answers if answer.matched}):
        matched, other = (votes.systems.index(system) for system in (name, name + MISMATCHED))
        own[name] = votes.between(matched, other)

        def alignment(counts: np.ndarray, matched: int = matched, other: int = other) -> np.ndarray:
            weights = counts * np.array([2.0, 1.0, 0.5])[:, None, None]
            won, lost = (weights.sum(axis=1)[:, i, j]
                         for i, j in ((matched, other), (other, matched)))  # fmt: skip
            with np.errstate(invalid="ignore"):
                return (won / (won + lost))[:, None]

        (score,) = own[name].estimates(alignment, rounds, seed)
        scores.append(AlignmentScore(**vars(compare(votes, matched, other)), score=score))
    adjusted = holm([score.p for score in scores]).tolist()
    scores = [replace(score, p_holm=p) for score, p in zip(scores, adjusted, strict=True)]
    scores.sort(key=lambda score: (-score.score.value, score.a))
    pairs = list(combinations((score.a for score in scores), 2))
    p_values = []
    for pair in pairs:
        one, other = (own[name].answers for name in pair)
        value, rater, clip = map(np.concatenate, zip(one, other, strict=True))
        p_values.append(mean_test(value, rater, clip, np.arange(len(value)) < len(one[0])))
    tests = zip(pairs, p_values, holm(p_values).tolist(), strict=True)
    return tuple(scores), tuple((*pair, p, p_holm) for pair, p, p_holm in tests)


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
        alignment, differences: matched against mismatched motion; see `analyse_alignment`.
        reasons: {reason: number of answers that give it}, most frequent first.
        rounds, seed: settings of the bootstrap.
    """

    answers: Answers
    raters: int
    clips: int
    left: Estimate
    preference: Preference | None
    by_style: dict[str, Preference]
    alignment: tuple[AlignmentScore, ...]
    differences: tuple[tuple[str, str, float, float], ...]
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
    return StudyResult(
        answers=answers,
        raters=len({answer.user for answer in kept}),
        clips=len({answer.clip for answer in kept}),
        left=Estimate(math.nan) if ratings else share(*Votes.of(kept).answers),
        preference=analyse_preference(compared, rounds, seed, ratings) if together else None,
        by_style=by_style,
        alignment=alignment,
        differences=differences,
        reasons=dict(Counter(r for answer in kept for r in answer.reasons).most_common()),
        rounds=rounds,
        seed=seed,
    )
