"""Differences of models, take by take: which values of a report may be bold.

Models are ordered by the distance of their value to the recordings' own. The nearest one is bold
only if its value differs from that of every other model by more than chance: Student's t of the
difference of both models' means in each take gives a p-value (within speakers, on at least `FEW`
takes; see `intervals`), and the p-values of all rows are adjusted by Holm's procedure. It must
also be nearer with a one-sided p-value of at most .25: two models may differ and be about as far
from the recordings on either side. A value that has a chance level must be above it, and so must
the recordings' own.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS, Definition
from gesturekit.evaluation.pairs import grouped
from gesturekit.evaluation.results import ClipResult, MetricResult, ModelResult
from gesturekit.evaluation.statistics.intervals import (
    FEW,
    LEVEL,
    Takes,
    holm,
    pseudo_values,
    standard_error,
)
from gesturekit.evaluation.statistics.likeness import pseudo_values_of
from gesturekit.evaluation.statistics.model_metrics import by_take

NEARER = 0.75
"""Smallest confidence with which the best model must be nearer to the recordings."""


@dataclass(frozen=True)
class Row:
    """A metric with the results of all models: a row of the report.

    Attributes:
        definition: of the metric.
        results: results of each model; None where it was not measured.
        own: the recordings' own value, or None.
        distances: {model: distance of its value to it}; the least is the best.
        direction: "higher" or "lower" where no model is beyond the recordings' own value, so that
            more, or less, is nearer to it; else "reference".
        best: the model that is nearest by more than chance, or None.
        p: p-value of the best against the nearest other model, adjusted for the number of rows;
            None where it was not tested.
    """

    definition: Definition
    results: tuple[MetricResult | None, ...]
    own: float | None
    distances: Mapping[str, float]
    direction: str
    best: str | None = None
    p: float | None = None

    @property
    def known(self) -> list[MetricResult]:
        """The results of the models that have any."""
        return [result for result in self.results if result is not None]


def contests(
    models: Sequence[ModelResult], definitions: Iterable[Definition] = DEFINITIONS.values()
) -> dict[str, Row]:
    """Return {key: row} of the metrics that a model has."""
    rows = {}
    for definition in definitions:
        key = definition.key
        known = [model for model in models if key in model.metrics]
        values = {model.label: model.metrics[key].interval.value for model in known}
        own = next((own for m in known if (own := m.metrics[key].recording) is not None), None)
        distances, direction, p = dict[str, float](), definition.better, None
        if own is not None:
            distances = {label: float(distance(key, v, own)) for label, v in values.items()}
            direction = _direction(key, own, values.values())
            p = _tested(key, known, distances)
        if known:
            results = tuple(model.metrics.get(key) for model in models)
            rows[key] = Row(definition, results, own, distances, direction, p=p)
    adjusted = holm([row.p for row in rows.values()]).tolist()
    for (key, row), p in zip([*rows.items()], adjusted, strict=True):
        if row.p is not None:
            best = min(row.distances, key=row.distances.__getitem__) if p < 1.0 - LEVEL else None
            rows[key] = replace(row, best=best, p=p)
    return rows


def distance(key: str, value: np.ndarray | float, own: np.ndarray | float) -> np.ndarray:
    """Return how far values are from the recordings' own, in the unit of the metric."""
    gap = np.asarray(value) - own
    if key == "likeness":
        return 1.0 - np.asarray(value)
    enough = DEFINITIONS[key].enough
    if enough == "at least":
        return np.maximum(0.0, -gap)
    return np.maximum(0.0, gap) if enough == "at most" else np.abs(gap)


def _direction(key: str, own: float, values: Collection[float]) -> str:
    better = DEFINITIONS[key].better
    margin = 1e-6 * max(abs(own), 1e-6)
    if better == "higher" and all(value <= own + margin for value in values):
        return "higher"
    if better == "lower" and all(value >= own - margin for value in values):
        return "lower"
    return "reference"


def _tested(
    key: str, models: Sequence[ModelResult], distances: Mapping[str, float]
) -> float | None:
    """Return the p-value of the nearest model against all others; None if it cannot be taken."""
    if len(models) < 2 or not DEFINITIONS[key].tested or not models[0].metrics[key].informative:
        return None
    first, *others = sorted(models, key=lambda model: distances[model.label])
    found = [p for other in others if (p := _difference(key, first, other)) is not None]
    if len(found) < len(others):
        return None
    return max(*found, _chance(key, first))


def _difference(key: str, one: ModelResult, other: ModelResult) -> float | None:
    """Return the two-sided p-value of the difference of two models' values, the nearer one first.

    1 if it is not surely enough the nearer one (`NEARER`); None with too few takes.
    """
    if key == "likeness":
        ours, theirs = (pseudo_values_of(m.metrics[key].groups) for m in (one, other))
        takes = sorted(ours.keys() & theirs.keys())
        values = [np.array([side[take] for take in takes]) for side in (ours, theirs)]
        distances = [-side for side in values]
        speakers = np.unique([group for group, _ in takes], return_inverse=True)[1]
    else:
        sides = in_common(key, one, other)
        speakers = Takes.of([clip.pair for clip in sides[0]]).speakers
        if len(speakers) < FEW:
            return None
        found = [_take_values(key, m, clips) for m, clips in zip((one, other), sides, strict=True)]
        values, distances = [ours for ours, _ in found], [away for _, away in found]
    p = p_of_difference(values[0], values[1], speakers)
    farther = p_of_difference(distances[1], distances[0], speakers, above=True)
    return p if p is None or (farther is not None and farther <= 1.0 - NEARER) else 1.0


def in_common(key: str, *models: ModelResult) -> list[list[ClipResult]]:
    """Return models' clips of the recordings of which each clip of all models has the value."""
    found = [grouped((clip.pair.stem, clip) for clip in model.clips) for model in models]
    stems = sorted(
        stem for stem in set.intersection(*map(set, found))
        if all(key in clip.metrics for clips in found for clip in clips[stem])
    )  # fmt: skip
    return [[clip for stem in stems for clip in clips[stem]] for clips in found]


def _take_values(
    key: str, model: ModelResult, clips: Sequence[ClipResult]
) -> tuple[np.ndarray, np.ndarray]:
    """Return a model's values (R,) by take, and their distances to the recordings'.

    The distances are pseudo-values of the jackknife.
    """
    ours, theirs = by_take(clips, key, generated=True), by_take(clips, key)
    if not all(key in clip.recording for clip in clips):
        theirs = np.full(len(ours), model.metrics[key].recording)
    return ours, pseudo_values(
        lambda weights: distance(key, weights @ ours, weights @ theirs), len(ours)
    )


def p_of_difference(
    one: np.ndarray, other: np.ndarray, speakers: np.ndarray, *, above: bool = False
) -> float | None:
    """Return the p-value of the mean difference of two models, take by take.

    Args:
        one: (R,) a value a take.
        other: (R,) those of the other model for the same takes.
        speakers: (R,) number of each take's speaker, from 0.
        above: test only that `one` is above `other`; else the test is two-sided.

    Returns:
        None with too few takes; see `gesturekit.evaluation.statistics.intervals`.
    """
    from scipy.stats import t

    found = standard_error(one - other, speakers)
    if found is None:
        return None
    mean, (error, free) = float((one - other).mean()), found
    if error >= 1e-12 * max(abs(mean), 1e-12):
        statistic = mean / error
    else:  # all takes agree
        statistic = 0.0 if abs(mean) < 1e-12 else math.copysign(math.inf, mean)
    return float(t.sf(statistic, free) if above else 2.0 * t.sf(abs(statistic), free))


def _chance(key: str, model: ModelResult) -> float:
    """Return the p-value against the chance level, one-sided; 0 of metrics that have none.

    The level is the higher one of that of shifted sound and that of other recordings.
    """
    pairs, above = [], []
    for clip in model.clips:
        levels = [clip.metrics.get(f"{key}_chance"), clip.mismatched.get(key)]
        known = [level for level in levels if level is not None]
        if key.endswith("_z") or key == "in_time":
            known = [0.0]
        if key in clip.metrics and known:
            pairs.append(clip.pair)
            above.append(clip.metrics[key] - max(known))
    if not pairs:
        return 0.0
    takes = Takes.of(pairs)
    p = p_of_difference(takes.means(above), np.zeros(takes.count), takes.speakers, above=True)
    return 1.0 if p is None else p
