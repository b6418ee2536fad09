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

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.results import ClipResult, ModelResult
from gesturekit.evaluation.statistics.intervals import (
    FEW,
    LEVEL,
    Takes,
    holm,
    p_value,
    pseudo_values,
    standard_error,
)
from gesturekit.evaluation.statistics.likeness import pseudo_values_of

NEARER = 0.75
"""Smallest confidence with which the best model must be nearer to the recordings."""


@dataclass(frozen=True)
class Contest:
    """One row of a report: its models in order.

    Attributes:
        key: key of `definitions`.
        own: the recordings' own value.
        distances: {model: distance of its value to it}; the least is the best.
        direction: "higher" or "lower" where no model is beyond the recordings' own value, so that
            more, or less, is nearer to it; else "reference".
        best: the model that is nearest by more than chance, or None.
        p: p-value of the best against the nearest other model, adjusted for the number of rows;
            None where it was not tested.
    """

    key: str
    own: float
    distances: Mapping[str, float]
    direction: str
    best: str | None = None
    p: float | None = None


def contests(models: Sequence[ModelResult]) -> dict[str, Contest]:
    """Return {key: contest} of all rows whose recordings' own value is known."""
    rows, tested = {}, {}
    for key in DEFINITIONS:
        metrics = {m.label: m.metrics[key] for m in models if key in m.metrics}
        own = next((f.recording for f in metrics.values() if f.recording is not None), None)
        if own is None:
            continue
        values = {label: result.interval.value for label, result in metrics.items()}
        distances = {label: float(distance(key, value, own)) for label, value in values.items()}
        rows[key] = Contest(key, own, distances, _direction(key, own, values.values()))
        p = _tested(key, [m for m in models if key in m.metrics], distances)
        if p is not None:
            tested[key] = p
    for key, adjusted in zip(tested, holm(list(tested.values())), strict=True):
        row = rows[key]
        nearest = min(row.distances, key=row.distances.__getitem__)
        best = nearest if adjusted < 1.0 - LEVEL else None
        rows[key] = Contest(key, row.own, row.distances, row.direction, best, float(adjusted))
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

    1 if it is not surely enough the nearer one (`NEARER`).
    """
    if key == "likeness":
        return _likeness_difference(one, other)
    both = [_by_recording(model) for model in (one, other)]
    names = sorted(
        name for name in both[0].keys() & both[1].keys()
        if all(_has(key, side[name]) for side in both)
    )  # fmt: skip
    if not names:
        return None
    found = [
        _take_values(key, model, [clip for name in names for clip in side[name]])
        for model, side in zip((one, other), both, strict=True)
    ]
    (ours, our_distances, takes), (theirs, their_distances, _) = found
    p = p_of_difference(ours, theirs, takes.speakers)
    if p is None:
        return None
    farther = p_of_difference(their_distances, our_distances, takes.speakers, above=True)
    return p if farther is not None and farther <= 1.0 - NEARER else 1.0


def _likeness_difference(one: ModelResult, other: ModelResult) -> float | None:
    """Return the p-value of the difference of two likenesses, take by take."""
    ours, theirs = (pseudo_values_of(model.metrics["likeness"].groups) for model in (one, other))
    takes = sorted(ours.keys() & theirs.keys())
    names = sorted({group for group, _ in takes})
    one_by_take, other_by_take = (
        np.array([side[take] for take in takes]) for side in (ours, theirs)
    )
    speakers = np.array([names.index(group) for group, _ in takes], int)
    p = p_of_difference(one_by_take, other_by_take, speakers)
    if p is None:
        return None
    nearer = p_of_difference(one_by_take, other_by_take, speakers, above=True)
    return p if nearer is not None and nearer <= 1.0 - NEARER else 1.0


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
    difference = one - other
    error = standard_error(difference, speakers)
    if error is None:
        return None
    two_sided = p_value(float(difference.mean()), *error)
    if not above:
        return two_sided
    return two_sided / 2.0 if difference.mean() > 0.0 else 1.0 - two_sided / 2.0


def _take_values(
    key: str, model: ModelResult, clips: Sequence[ClipResult]
) -> tuple[np.ndarray, np.ndarray, Takes]:
    """Return a model's values (R,) by take, their distances to the recordings', and the takes.

    The distances are pseudo-values of the jackknife.
    """
    takes = Takes.of([clip.pair for clip in clips])
    if takes.count < FEW:  # not tested
        return np.zeros(takes.count), np.zeros(takes.count), takes
    ours = takes.means([clip.metrics[key] for clip in clips])
    theirs = np.full(len(ours), model.metrics[key].recording)
    if all(key in clip.recording for clip in clips):
        theirs = takes.means([clip.recording[key] for clip in clips])
    distances = pseudo_values(
        lambda weights: distance(key, weights @ ours, weights @ theirs), takes.count
    )
    return ours, distances, takes


def _has(key: str, clips: Sequence[ClipResult]) -> bool:
    """True if the row can be computed for each of the clips."""
    return all(key in clip.metrics for clip in clips)


def _by_recording(model: ModelResult) -> dict[str, list[ClipResult]]:
    found: dict[str, list[ClipResult]] = {}
    for clip in model.clips:
        found.setdefault(clip.pair.stem, []).append(clip)
    return found


def _chance(key: str, model: ModelResult) -> float:
    """Return the p-value against the chance level, one-sided; 0 of metrics that have none."""
    known = [
        (clip, value) for clip in model.clips if (value := _above_chance(key, clip)) is not None
    ]
    if not known:
        return 0.0
    takes = Takes.of([clip.pair for clip, _ in known])
    above = takes.means([value for _, value in known])
    p = p_of_difference(above, np.zeros(takes.count), takes.speakers, above=True)
    return 1.0 if p is None else p


def _above_chance(key: str, clip: ClipResult) -> float | None:
    """Return how far a clip's value is above its chance level, or other recordings' level."""
    value = clip.metrics.get(key)
    if value is None or key.endswith("_z") or key == "in_time":
        return value
    levels = [clip.metrics.get(f"{key}_chance"), clip.mismatched.get(key)]
    known = [level for level in levels if level is not None]
    return value - max(known) if known else None
