"""Analysis of a whole study (preferences, alignment, sides), and the conclusions from it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gesturekit.errors import ConfigError
from gesturekit.evaluation.statistics.answers import Answer, Answers
from gesturekit.study.analysis.alignment import Alignment, AlignmentScore, analyse_alignment
from gesturekit.study.analysis.preference import PairScore, Preference, analyse_preference
from gesturekit.study.analysis.significance import ALPHA, Estimate, share
from gesturekit.study.analysis.votes import ROUNDS, Votes
from gesturekit.wording import counted, listed, printable


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
        alignment: matched against mismatched motion; None if there was none.
        reasons: {reason: number of answers that give it}, most frequent first.
        rounds, seed: settings of the bootstrap.
    """

    answers: Answers
    raters: int
    clips: int
    left: Estimate
    preference: Preference | None
    by_style: dict[str, Preference]
    alignment: Alignment | None
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
    kept = answers.kept
    matched = [answer for answer in kept if answer.matched]
    compared = [answer for answer in kept if not answer.matched]
    styles = sorted({answer.style for answer in compared if answer.style})
    by_style = {
        style: analyse_preference(
            [a for a in compared if a.style == style], rounds, seed,
            [rating for rating in answers.ratings if rating.style == style],
        )
        for style in (styles if len(styles) > 1 else ())
    }  # fmt: skip
    # Ratings of different questions have no common mean, and no left side.
    together = compared and not (answers.ratings and by_style)
    nowhere = Estimate(math.nan, math.nan, math.nan)
    return StudyResult(
        answers=answers,
        raters=len({answer.user for answer in kept}),
        clips=len({answer.clip for answer in kept}),
        left=nowhere if answers.ratings else share(*Votes.of(kept).answers),
        preference=analyse_preference(compared, rounds, seed, answers.ratings)
        if together
        else None,
        by_style=by_style,
        alignment=analyse_alignment(matched, rounds, seed) if matched else None,
        reasons=dict(Counter(r for answer in kept for r in answer.reasons).most_common()),
        rounds=rounds,
        seed=seed,
    )


FEW_RATERS = 15
FEW_CLIPS = 10


def conclusions(found: StudyResult) -> list[str]:
    """Return sentences on what may be concluded from a study."""
    answers = len(found.answers.kept)
    said = "comparison" if found.answers.ratings else "answer"
    lines = [
        f"{counted(answers, said)} of {counted(found.raters, 'rater')} on "
        f"{counted(found.clips, 'speech segment')}; "
        f"{counted(len(found.answers.excluded), 'rater')} excluded by attention checks."
    ]
    if found.preference is not None:
        lines += _on_preference(found.preference, "")
    for style, preference in found.by_style.items():
        lines += _on_preference(preference, f"{style}: ")
    if found.alignment is not None:
        lines += _on_alignment(found.alignment)
    return lines


def reservations(found: StudyResult) -> list[str]:
    """Return sentences on what limits the conclusions, and on all that was left out."""
    lines = [f"{note}." for note in found.answers.notes]
    if not found.answers.has_checks:
        lines.append("The files do not say who failed attention checks: nobody was excluded.")
    lines += [f"{line}." for line in careless(found.answers.kept)]
    if found.raters < 2:
        lines.append("A single rater: no intervals and no tests, so that nothing can be concluded.")
    elif found.raters < FEW_RATERS:
        lines.append(
            f"{found.raters} raters are few: intervals are rough, and most likely too narrow."
        )
    if found.clips < FEW_CLIPS:
        lines.append(
            f"{counted(found.clips, 'speech segment')}: findings may hold for these clips only."
        )
    for preference in [found.preference] if found.preference else found.by_style.values():
        lines += _limits_of(preference)
    if found.left.low > 0.5 or found.left.high < 0.5:
        lines.append(
            f"{_percent(found.left)} of preferences are for the left side: raters favour it, or "
            "systems were not shown on both sides equally often."
        )
    return lines


SAME_ANSWER, LEAST_ANSWERS = 0.9, 10
"""Share of a rater's answers that are the same one, and the number of answers, from which the rater
is named."""
HASTY = 0.4
"""Share of the raters' usual time below which a rater is named."""


def careless(answers: Sequence[Answer]) -> Iterator[str]:
    """Yield sentences on raters who gave one answer throughout, or took far less time than others.

    They are named and not left out: whom to exclude is decided before the study.
    """
    by_rater: dict[str, list[Answer]] = {}
    for answer in answers:
        by_rater.setdefault(answer.user, []).append(answer)
    same = []
    for user, given in by_rater.items():
        most = Counter(answer.score for answer in given).most_common(1)[0][1]
        if len(given) >= LEAST_ANSWERS and most >= SAME_ANSWER * len(given):
            same.append(f"{printable(user)} ({most} of {len(given)})")
    if same:
        yield f"The same answer almost throughout: {listed(same)}"
    times = {
        user: float(np.median(taken))
        for user, given in by_rater.items()
        if (taken := [answer.seconds for answer in given if answer.seconds is not None])
    }
    usual = float(np.median(list(times.values()))) if times else 0.0
    hasty = [f"{printable(u)} ({t:.0f} s)" for u, t in times.items() if t < HASTY * usual]
    if hasty:
        yield f"Far less time than usual (a median of {usual:.0f} s an answer): {listed(hasty)}"


def _limits_of(preference: Preference) -> Iterator[str]:
    if preference.not_compared:
        pairs = [f"{a} and {b}" for a, b in preference.not_compared]
        yield f"Never compared: {listed(pairs, 12)}."
    if preference.separate:
        groups = "; ".join(listed(group, 12) for group in preference.separate)
        yield f"No comparison connects these groups, so that there is no common rating: {groups}."
    elif not preference.bounded:
        yield (
            "Some systems won, or lost, every comparison with the others: their ratings have no "
            "finite value; read their order, not the numbers."
        )


def _on_preference(preference: Preference, prefix: str) -> Iterator[str]:
    names = [system.name for system in preference.systems]
    merit = "mean rating" if preference.rated else "merit score"
    measure = merit if preference.separate else "Elo rating"
    yield f"{prefix}Order by {measure}, best first: {listed(names, 20)}."
    unclear = []
    for pair in sorted(preference.pairs, key=lambda p: (names.index(p.a), names.index(p.b))):
        if is_significant(pair.p_holm):
            yield prefix + _found(pair)
        else:
            unclear.append(
                f"{pair.a} and {pair.b} ({_percent(pair.win_rate)}, {p_text(pair.p_holm)})"
            )
    if unclear:
        yield (
            f"{prefix}No difference was found between {listed(unclear, 12)}. This does not show "
            "that they are equally good."
        )


def _found(pair: PairScore) -> str:
    # The mean score, which is tested, and the number of wins can disagree: one side may win more
    # clearly.
    better, worse = (pair.a, pair.b) if pair.mean > 0 else (pair.b, pair.a)
    rate = pair.win_rate
    if better != pair.a:
        rate = Estimate(1 - rate.value, 1 - rate.high, 1 - rate.low)
    return f"{better} is preferred to {worse}: win rate {_percent(rate)}, {p_text(pair.p_holm)}."


def _on_alignment(alignment: Alignment) -> Iterator[str]:
    for score in alignment.systems:
        yield _alignment_sentence(score)
    different = [
        f"{a} and {b} ({p_text(p)})" for a, b, _, p in alignment.differences if is_significant(p)
    ]
    if different:
        yield f"Systems differ in how often their matched motion is preferred: {listed(different)}."
    elif alignment.differences:
        yield "No difference between systems in alignment was found."


def _alignment_sentence(score: AlignmentScore) -> str:
    rate = f"{_percent(score.score)}, {p_text(score.p_holm)}"
    if not is_significant(score.p_holm):
        return (
            f"{score.name}: raters did not tell its motion from that of other speech "
            f"(alignment {rate}; chance 50 %)."
        )
    above = "fits its speech better" if score.mean > 0 else "fits its speech worse"
    return f"{score.name}: its motion {above} than its motion of other speech (alignment {rate})."


def is_significant(p: float) -> bool:
    """Return whether an adjusted p-value is below the level of 0.05; False for NaN."""
    return p < ALPHA


def p_text(p: float) -> str:
    """Return a p-value as it is written in papers."""
    if math.isnan(p):
        return "no test"
    return "p < .001" if p < 0.001 else f"p = {p:.3f}".replace("0.", ".", 1)


def _percent(rate: Estimate) -> str:
    if math.isnan(rate.value):
        return "only ties"
    text = f"{100 * rate.value:.0f} %"
    if math.isnan(rate.low):
        return text
    return f"{text} [{100 * rate.low:.0f}, {100 * rate.high:.0f}]"
