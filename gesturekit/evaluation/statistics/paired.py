"""Differences of models, recording by recording: which values of a report may be bold.

Models are ordered by the distance of their value to the recordings' own. The nearest one is bold
only if its value differs from that of every other model by more than chance: the bootstrap over
recordings draws the same ones for both models, each with all its samples; Student's t of the
difference over its standard error gives a p-value, and the p-values of all rows are adjusted by
Holm's procedure. It must be the nearer one in three of four resamples as well: two models may
differ and be about as far from the recordings on either side. A value that has a chance level must
be above it, and so must the recordings' own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.results import ClipResult, ModelResult
from gesturekit.evaluation.statistics.intervals import LEVEL, draws, holm, means_by, standard_error
from gesturekit.evaluation.statistics.likeness import MEASURES
from gesturekit.evaluation.statistics.questions import likeness_of, own_one_nn

NEARER = 0.75
"""Smallest share of resamples in which the best model must be nearer to the recordings."""
SEED = 0
"""Seed of the bootstrap: reports of the same values have the same bold."""

_Replicates = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Maps weights of recordings (B, R) to a model's values (B,) and their distances (B,)."""


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


def _direction(key: str, own: float, values: Sequence[float]) -> str:
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
    found = [_difference(key, first, other) for other in others]
    if None in found:
        return None
    return max(*found, _chance(key, first))


def _difference(key: str, one: ModelResult, other: ModelResult) -> float | None:
    """Return the two-sided p-value of the difference of two models' values, the nearer one first.

    1 if it is not nearer in `NEARER` of the resamples.
    """
    both = [_by_recording(model) for model in (one, other)]
    names = sorted(
        name for name in both[0].keys() & both[1].keys()
        if all(_has(key, side[name]) for side in both)
    )  # fmt: skip
    if len(names) < 2:
        return None
    weights = draws(len(names), SEED)
    once = np.full((1, len(names)), 1 / len(names))
    resampled, values = [], []
    for model, side in zip((one, other), both, strict=True):
        measure = _replicates(key, model, [clip for name in names for clip in side[name]])
        resampled.append(measure(weights))
        values.append(measure(once)[0][0])
    if (resampled[0][1] < resampled[1][1]).mean() < NEARER:
        return 1.0
    spread = float(standard_error(resampled[0][0] - resampled[1][0], len(names)))
    return p_value(values[0] - values[1], spread, len(names))


def p_value(difference: float, error: float, units: int) -> float:
    """Return the two-sided p-value of a difference by Student's t with units - 1 degrees."""
    from scipy.stats import t

    if error < 1e-12 * max(abs(difference), 1e-12):
        return 1.0 if abs(difference) < 1e-12 else 0.0
    return float(2.0 * t.sf(abs(difference) / error, units - 1))


def _replicates(key: str, model: ModelResult, clips: Sequence[ClipResult]) -> _Replicates:
    if key == "likeness":
        measure = likeness_of(clips, own_one_nn(model.metrics))
        return lambda weights: ((found := measure(weights)), 1.0 - found)
    stems = [clip.pair.stem for clip in clips]
    ours = means_by(stems, np.array([clip.metrics[key] for clip in clips]))
    theirs = np.full(len(ours), model.metrics[key].recording)
    if all(key in clip.recording for clip in clips):
        theirs = means_by(stems, np.array([clip.recording[key] for clip in clips]))
    return lambda weights: (
        (found := weights @ ours),
        distance(key, found, weights @ theirs),
    )


def _has(key: str, clips: Sequence[ClipResult]) -> bool:
    """True if the row can be computed for each of the clips."""
    if key == "likeness":
        return any(measure in clips[0].metrics for measure in MEASURES)
    return all(key in clip.metrics for clip in clips)


def _by_recording(model: ModelResult) -> dict[str, list[ClipResult]]:
    found: dict[str, list[ClipResult]] = {}
    for clip in model.clips:
        found.setdefault(clip.pair.stem, []).append(clip)
    return found


def _chance(key: str, model: ModelResult) -> float:
    """Return the p-value against the chance level, one-sided; 0 of metrics that have none."""
    from scipy.stats import t

    by_stem = [
        [value for clip in clips for value in _above_chance(key, clip)]
        for clips in _by_recording(model).values()
    ]
    units = np.array([np.mean(values) for values in by_stem if values])
    if not len(units):
        return 0.0
    if len(units) < 2:
        return 1.0
    error = units.std(ddof=1) / np.sqrt(len(units))
    return float(t.sf(units.mean() / max(error, 1e-12), len(units) - 1))


def _above_chance(key: str, clip: ClipResult) -> Iterator[float]:
    """Yield how far a clip's value is above its chance level, or other recordings' level."""
    value = clip.metrics.get(key)
    if value is None:
        return
    if key.endswith("_z") or key == "in_time":
        yield value
        return
    levels = [clip.metrics.get(f"{key}_chance"), clip.mismatched.get(key)]
    known = [level for level in levels if level is not None]
    if known:
        yield value - max(known)
