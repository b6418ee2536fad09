"""Rank correlation of metrics with people's preferences between the same models.

People's score of a model is the share of its comparisons that it wins, a tie counting half. A
metric's score is its value, turned so that higher is better: negative for "lower", and minus the
distance to the recording's value for "reference". Both are correlated over models.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.results import Agreement, ModelResult
from gesturekit.evaluation.statistics.answers import Answer
from gesturekit.wording import listed

RECORDING = "recording"
"""Name by which a study may have the recordings themselves among its models."""
LEAST = 3
"""Least number of models; two can only agree or disagree."""
RESAMPLES = 500


def agreement(
    models: Sequence[ModelResult], answers: Sequence[Answer], seed: int = 0
) -> list[Agreement]:
    """Return the agreement of each metric with people, the closest first.

    Args:
        models: the evaluated models; the study names them by their labels.
        answers: the study's results. Those on other models are left out.
        seed: seed of the bootstrap.

    Raises:
        EvaluationError: fewer than 3 of the evaluated models are in the study.
    """
    known = shared_models([model.label for model in models], answers)
    answers = [a for a in answers if a.left in known and a.right in known]
    wins, users = _wins(answers, known)
    drawn = np.random.default_rng(seed).integers(0, len(users), (RESAMPLES, len(users)))
    people = _scores(wins.sum(axis=0))
    resampled = [_scores(wins[at].sum(axis=0)) for at in drawn]
    found = []
    for key in DEFINITIONS:
        values = _metric_scores(models, key, known)
        kept = [i for i, name in enumerate(known) if name in values]
        metric = np.array([values[known[i]] for i in kept])
        if len(kept) < LEAST or np.ptp(metric) == 0 or np.ptp(people[kept]) == 0:
            continue
        tau, rho = _correlations(metric, people[kept])
        each = [_correlations(metric, scores[kept])[0] for scores in resampled]
        low, high = np.nanquantile(each, (0.025, 0.975))
        chosen = {known[i] for i in kept}
        n = sum(a.left in chosen and a.right in chosen for a in answers)
        found.append(Agreement(key, tau, rho, float(low), float(high), len(kept), len(users), n))
    return sorted(found, key=lambda one: -one.kendall)


def shared_models(labels: Sequence[str], answers: Sequence[Answer]) -> list[str]:
    """Return the models, and perhaps the recordings, that evaluation and study have in common.

    Raises:
        EvaluationError: fewer than 3.
    """
    named = {name for answer in answers for name in (answer.left, answer.right)}
    known = [name for name in (*labels, RECORDING) if name in named]
    if len(known) < LEAST:
        raise EvaluationError(
            f"the study compares {listed(sorted(named))}, and the evaluation has "
            f"{listed(list(labels))}: {len(known)} in common, and a correlation needs {LEAST}; "
            "name the folders as the study does (NAME=DIR), and compare all of them"
        )
    return known


def _wins(answers: Sequence[Answer], models: Sequence[str]) -> tuple[np.ndarray, list[str]]:
    """Return (users, 2, models) wins and comparisons, and the names of the users."""
    users = sorted({answer.user for answer in answers})
    counts = np.zeros((len(users), 2, len(models)))
    for answer in answers:
        row = counts[users.index(answer.user)]
        sides = [models.index(name) for name in (answer.left, answer.right)]
        share = 0.5 + 0.5 * float(np.sign(answer.score))
        row[0, sides] += (share, 1.0 - share)
        row[1, sides] += 1.0
    return counts, users


def _scores(counts: np.ndarray) -> np.ndarray:
    """Return the share of comparisons that each model wins; NaN without any."""
    with np.errstate(invalid="ignore"):
        return counts[0] / counts[1]


def _metric_scores(
    models: Sequence[ModelResult], key: str, known: Sequence[str]
) -> Mapping[str, float]:
    """Return {model: value of the metric, turned so that higher is better}."""
    metrics = {m.label: m.metrics[key] for m in models if key in m.metrics and m.label in known}
    values = {label: result.interval.value for label, result in metrics.items()}
    own = next((f.recording for f in metrics.values() if f.recording is not None), None)
    better = DEFINITIONS[key].better
    if better == "reference":  # the recordings would come first by definition
        return {} if own is None else {label: -abs(v - own) for label, v in values.items()}
    if own is not None and RECORDING in known:
        values.setdefault(RECORDING, own)
    sign = -1.0 if better == "lower" else 1.0
    return {label: sign * value for label, value in values.items()}


def _correlations(metric: np.ndarray, people: np.ndarray) -> tuple[float, float]:
    """Return Kendall's tau-b and Spearman's rho; NaN for scores that are all equal."""
    from scipy.stats import kendalltau, spearmanr

    both = np.isfinite(people)
    if both.sum() < 2 or np.ptp(people[both]) == 0 or np.ptp(metric[both]) == 0:
        return float("nan"), float("nan")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        tau = kendalltau(metric[both], people[both]).statistic
        rho = spearmanr(metric[both], people[both]).statistic
    return float(tau), float(rho)
