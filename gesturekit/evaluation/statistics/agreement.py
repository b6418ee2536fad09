"""Rank correlation of metrics with people's scores of the same systems.

People's scores are those of `scores`. A metric's score is its value, turned so that higher is
better: negative for "lower", and minus the distance to the recording's value for "reference". Both
are correlated over systems.

The interval is over systems, raters and clips together: each bootstrap sample draws all of them
again, the study's clips for people's scores and the takes of the evaluation for a metric that has
one value a clip; a metric of a whole set stays as it is. Systems are compared on the same takes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.results import Agreement, MetricAgreement, ModelResult, QuestionAgreement
from gesturekit.evaluation.statistics.answers import Ratings
from gesturekit.evaluation.statistics.intervals import FEW, LEVEL, holm
from gesturekit.evaluation.statistics.model_metrics import by_take
from gesturekit.evaluation.statistics.paired import in_common
from gesturekit.evaluation.statistics.scores import RESAMPLES, Scores, scores_of
from gesturekit.wording import counted, listed, printable

RECORDING = "recording"
"""Name by which a study may have the recordings themselves among its systems."""
_FOR_ANSWERS = ("sync_lag", "worst_joint")
"""Metrics that the answers alone need: each metric that is correlated makes the tests stricter."""
LEAST = 3
"""Least number of systems; two can only agree or disagree."""
LEAST_FOR_INTERVAL = 6
"""Least number of systems with an interval. Drawn from five systems, it held a tau of 0.8 in only
89 % of 600 simulated studies; with six, in 96 %."""


def agreement(models: Sequence[ModelResult], ratings: Ratings, seed: int = 0) -> Agreement:
    """Return the agreement of each metric with people, by question; the closest metric first.

    Args:
        models: the evaluated models; the study names them by their labels.
        ratings: the study's ratings or votes. Those of other systems are left out.
        seed: seed of the bootstrap.

    Raises:
        EvaluationError: fewer than 3 of the evaluated models are in the study.
    """
    labels = [model.label for model in models]
    known = shared_systems(labels, ratings)
    left_out = {
        "were in the study and not evaluated": sorted(set(ratings.systems) - set(known)),
        "were evaluated and not in the study": [name for name in labels if name not in known],
    }
    notes = list(ratings.notes)
    for where, names in left_out.items():
        said = listed([printable(name[:40]) for name in names])
        notes += [f"left out, as they {where}: {said}"] if names else []
    found = []
    among = ratings.among(known)
    for index, question in enumerate(ratings.questions):
        kept = among & (ratings.question == index)
        scores = scores_of(ratings, kept, known, seed) if kept.any() else None
        if scores is None or len(scores.systems) < LEAST:
            notes.append(
                f"question {printable(question)!r} left out: ratings of fewer than {LEAST} systems"
            )
            continue
        if scores.note:
            notes.append(f"{printable(question)}: {scores.note}" if question else scores.note)
        found.append(_of_question(question, models, scores, seed))
    return Agreement(tuple(found), tuple(notes))


def conclusion(found: QuestionAgreement) -> str:
    """Return in one sentence which metrics order the models as people do."""
    tested = [
        (one.key, one.of_models, one.p_holm)
        for one in found.metrics
        if one.of_models is not None and one.p_holm is not None
    ]
    about = f" for {printable(found.question)}" if found.question else ""
    sides: dict[str, list[str]] = {"as people do": [], "the other way round": []}
    for key, tau, p in tested:
        if p < 1.0 - LEVEL:
            side = "as people do" if tau > 0 else "the other way round"
            sides[side].append(DEFINITIONS[key].name)
    certain = [
        f"{listed(names)} order{'s' if len(names) == 1 else ''} the models {side}"
        for side, names in sides.items() if names
    ]  # fmt: skip
    if certain:
        return f"Established{about} (Holm, {len(tested)} metrics): {'; '.join(certain)}."
    models = len(found.scores.keys() - {RECORDING})
    return (
        f"No metric is established{about}: of {counted(len(tested), 'metric')}, none orders the "
        f"{counted(models, 'model')} significantly as people do, or the other way round (Holm)."
    )


def shared_systems(labels: Sequence[str], ratings: Ratings) -> list[str]:
    """Return the models, and perhaps the recordings, that evaluation and study have in common.

    Raises:
        EvaluationError: fewer than 3.
    """
    known = [name for name in dict.fromkeys((*labels, RECORDING)) if name in ratings.systems]
    if len(known) < LEAST:
        named = listed([printable(name[:40]) for name in sorted(ratings.systems)])
        raise EvaluationError(
            f"the study has {named}, and the evaluation has "
            f"{listed(list(labels))}: {len(known)} in common, and a correlation needs {LEAST}; "
            "name the folders as the study does (NAME=DIR), and compare all of them"
        )
    return known


def _of_question(
    question: str, models: Sequence[ModelResult], scores: Scores, seed: int
) -> QuestionAgreement:
    """Return the agreement of all metrics with the scores for one question."""
    metrics = []
    for key in (key for key in DEFINITIONS if key not in _FOR_ANSWERS):
        values = metric_values(models, key, scores.systems, seed)
        kept = np.array([i for i, name in enumerate(scores.systems) if name in values], int)
        if len(kept) < LEAST or np.ptp(scores.values[kept]) == 0:
            continue
        metric, *drawn = np.array([values[scores.systems[i]] for i in kept]).T
        if np.ptp(metric) > 0:
            found = agreement_of(key, metric, np.array(drawn), scores, kept, seed)
            known = all(m.metrics[key].informative for m in models if key in m.metrics)
            p = found.p_holm if known else None
            metrics.append(replace(found, informative=known, p_holm=p))
    adjusted = holm([one.p_holm for one in metrics]).tolist()
    metrics = [
        replace(one, p_holm=None if np.isnan(p) else p)
        for one, p in zip(metrics, adjusted, strict=True)
    ]
    return QuestionAgreement(
        question,
        dict(zip(scores.systems, scores.values.tolist(), strict=True)),
        scores.raters,
        scores.clips,
        scores.ratings,
        tuple(sorted(metrics, key=lambda one: -one.kendall)),
    )


def agreement_of(
    key: str, metric: np.ndarray, drawn: np.ndarray, scores: Scores, kept: np.ndarray, seed: int = 0
) -> MetricAgreement:
    """Return the agreement of one metric with people, whose `p_holm` is not yet adjusted.

    Args:
        key: key of `definitions`.
        metric: (k,) the metric of the systems in `kept`, higher is better.
        drawn: (B, k) the metric in each bootstrap sample of takes.
        scores: people's scores.
        kept: (k,) indices of systems in `scores`.
        seed: seed of the bootstrap.
    """
    from scipy.stats import kendalltau, spearmanr

    people, n = scores.values[kept], len(kept)
    made = np.array([scores.systems[i] != RECORDING for i in kept])
    of_models = p = low = high = None
    if made.sum() >= LEAST:
        test = kendalltau(metric[made], people[made])
        if not np.isnan(test.statistic):
            of_models, p = float(test.statistic), float(test.pvalue)
    if n >= LEAST_FOR_INTERVAL:
        low, high = _interval(drawn, scores.resampled[:, kept], seed)
    i, j = np.triu_indices(n, 1)
    certain = scores.differ[np.ix_(kept, kept)][i, j]
    same = (np.sign(metric[i] - metric[j]) * np.sign(people[i] - people[j]))[certain]
    return MetricAgreement(
        key,
        float(kendalltau(metric, people).statistic),
        of_models,
        p,
        low,
        high,
        float(spearmanr(metric, people).statistic),
        float((0.5 + 0.5 * same).mean()) if len(same) else None,
        len(same),
        n,
        chance_range(n),
    )


def _interval(
    metric: np.ndarray, people: np.ndarray, seed: int
) -> tuple[float, float] | tuple[None, None]:
    """Return the 95 % percentile interval of Kendall's tau-b; none without any order.

    Args:
        metric: (B, k) the metric of k systems in each bootstrap sample of takes.
        people: (B, k) people's scores in each bootstrap sample of raters and clips.
        seed: seed of the draws of systems.
    """
    drawn = np.random.default_rng(seed).integers(0, metric.shape[1], metric.shape)
    found = kendall(*(np.take_along_axis(values, drawn, -1) for values in (metric, people)))
    if np.isnan(found).all():
        return None, None
    low, high = np.nanquantile(found, (0.025, 0.975))
    return float(low), float(high)


def kendall(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return Kendall's tau-b (B,) of the rows of two arrays (B, k); NaN for rows without order.

    The same as `scipy.stats.kendalltau`, for many rows at once. NaN is tied with anything.
    """
    i, j = np.triu_indices(one.shape[1], 1)
    a, b = (np.nan_to_num(np.sign(x[:, i] - x[:, j])) for x in (one, other))
    with np.errstate(invalid="ignore"):
        return (a * b).sum(axis=1) / np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))


def chance_range(n: int) -> float:
    """Return the least t so that |tau| > t has a probability of at most 5 % in a random order.

    Args:
        n: number of systems. With fewer than 5, t is 1: any order may be chance.
    """
    orders = np.ones(1)  # share of the orders of n things by their number of inversions
    for k in range(2, n + 1):
        orders = np.convolve(orders, np.full(k, 1.0 / k))
    tau = np.abs(1.0 - 2.0 * np.arange(len(orders)) / (len(orders) - 1))
    return float(min(t for t in tau if orders[tau > t + 1e-9].sum() <= 0.05))


def metric_values(
    models: Sequence[ModelResult], key: str, known: Sequence[str], seed: int
) -> dict[str, np.ndarray]:
    """Return {system: (1 + B,) values of the metric, turned so that higher is better}.

    The first one is the value, the others those of bootstrap samples of takes.
    """
    models = [m for m in models if key in m.metrics and m.label in known]
    own = next((m.metrics[key].recording for m in models
                if m.metrics[key].recording is not None), None)  # fmt: skip
    better = DEFINITIONS[key].better
    if not models or (own is None and better == "reference"):
        return {}
    away = _away(models, key, seed)
    values = {m.label: m.metrics[key].interval.value + away[m.label] for m in models}
    if own is not None and better == "reference":  # the recordings would be first by definition
        return {label: -abs(value - (own + away[RECORDING])) for label, value in values.items()}
    if own is not None and RECORDING in known:
        values.setdefault(RECORDING, own + away[RECORDING])
    sign = -1.0 if better == "lower" else 1.0
    return {label: sign * value for label, value in values.items()}


def _away(models: Sequence[ModelResult], key: str, seed: int) -> Mapping[str, np.ndarray]:
    """Return {system: (1 + B,) differences of bootstrap samples of takes from all takes}.

    Takes are those of recordings of which all clips have a value. The first one is 0, and all are
    with fewer than `FEW` takes.
    """
    clips = dict(zip((model.label for model in models), in_common(key, *models), strict=True))
    values = {label: by_take(some, key, generated=True) for label, some in clips.items()}
    values.setdefault(RECORDING, by_take(clips[models[0].label], key))
    away: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(1 + RESAMPLES))
    if (n := len(values[models[0].label])) >= FEW:
        shares = np.full(n, 1.0 / n)
        drawn = np.random.default_rng(seed).multinomial(n, shares, RESAMPLES) / n
        drawn = np.vstack([shares, drawn])
        away |= {label: drawn @ row - row.mean() for label, row in values.items() if len(row) == n}
    return away
