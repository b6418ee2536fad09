"""Analysis of a whole study: who was left out, preferences, alignment, and the sides."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from gesturekit.errors import ConfigError
from gesturekit.evaluation.statistics.answers import Answers
from gesturekit.study.analysis.alignment import Alignment, analyse_alignment
from gesturekit.study.analysis.preference import Preference, analyse_preference
from gesturekit.study.analysis.significance import Estimate, statsmodels_module, wilson
from gesturekit.study.analysis.votes import ROUNDS


@dataclass(frozen=True)
class StudyResult:
    """Result of a user study.

    Attributes:
        answers: answers that counted, and notes on the others.
        raters, clips: numbers of raters and of speech segments.
        left: share of preferences for the left side; Wilson interval.
        preference: comparison of systems; None if none were compared.
        by_style: {style: comparison of systems} if several styles were asked for.
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
        rounds: rounds of the bootstrap over raters.
        seed: the same seed gives the same intervals.

    Raises:
        ConfigError: `rounds` is not positive, or statsmodels is not installed.
        EvaluationError: too many raters and systems.
    """
    if rounds < 1:
        raise ConfigError(f"rounds is {rounds}: the bootstrap needs at least 1, better 10000")
    statsmodels_module("api")
    kept = answers.kept
    matched = [answer for answer in kept if answer.matched]
    compared = [answer for answer in kept if not answer.matched]
    styles = sorted({answer.style for answer in compared if answer.style})
    sides = [answer.score > 0 for answer in kept if answer.score]
    by_style = {
        style: analyse_preference([a for a in compared if a.style == style], rounds, seed)
        for style in (styles if len(styles) > 1 else ())
    }
    return StudyResult(
        answers=answers,
        raters=len({answer.user for answer in kept}),
        clips=len({answer.clip for answer in kept}),
        left=wilson(sum(sides), len(sides)),
        preference=analyse_preference(compared, rounds, seed) if compared else None,
        by_style=by_style,
        alignment=analyse_alignment(matched, rounds, seed) if matched else None,
        reasons=dict(Counter(r for answer in kept for r in answer.reasons).most_common()),
        rounds=rounds,
        seed=seed,
    )
