"""Floors and ceilings of the scores that answer the three questions, with their spread over takes.

The ceiling is the score of the speaker's other takes. Floors are scores of motion that should fail:
another speaker's, the mean pose, motion that ignores the speech.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gesturekit.evaluation.results import ClipResult, Level, MetricResult, ModelResult
from gesturekit.evaluation.statistics.intervals import LEVEL, Takes
from gesturekit.evaluation.statistics.thresholds import LEAST_LIKE, LIKE_SPREADS

CEILING, MEAN_POSE, OTHER_UTTERANCE = (
    "the speaker's other takes",
    "mean pose",
    "another utterance",
)
"""Names of levels."""
OWN = "the speaker's own"
"""Name of the ceiling of timing: recordings with their own speech."""
FLATTERED = "pieces of one take, more alike than takes are"
"""Name of a ceiling where the speaker has a single take."""
TRAINING = "training motion"
"""Name of the floor of novelty."""
OTHER_SOUND = "in_time_mismatched"
"""Key, among a recording's metrics, of its timing with the sounds of other recordings."""
_BLIND = ("speech_blind", "other_utterance")
"""Labels of models that ignore the speech, and are floors of timing. They are none of likeness: who
speaks of something else moves like the speaker all the same."""


def level_of(name: str, values: Sequence[float] | np.ndarray, *, pieces: bool = False) -> Level:
    """Return the mean and the spread of one value a take."""
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Level(name, float(np.mean(values)), spread, len(values), pieces)


def level_name(level: Level) -> str:
    """Return the name of a level; that of a ceiling from pieces says so."""
    return FLATTERED if level.pieces and level.name == CEILING else level.name


def level_text(level: Level) -> str:
    """Return a level in words, such as "another speaker (0.41 ± 0.06)"."""
    spread = "" if level.spread is None else f" ± {level.spread:.2f}"
    return f"{level_name(level)} ({level.value:.2f}{spread})"


def on_its_floor(result: MetricResult) -> Level | None:
    """Return the highest floor if a score is no higher, by one standard error of the floor."""
    floor = max(result.floors, key=lambda level: level.value, default=None)
    if floor is None:
        return None
    error = (floor.spread or 0.0) / np.sqrt(max(floor.n, 1))
    return floor if result.interval.value <= floor.value + error else None


def reached_floor(result: MetricResult) -> Level | None:
    """Return the highest floor that is not below the ceiling, so that a score says nothing.

    It is below if Student's t of the two means, with the spread of takes pooled, is significant at
    5 %, one-sided; without any spread, if its value is. A floor of likeness is below if it is less
    than what a motion like the speaker has.
    """
    ceiling = result.ceiling
    if result.key == "likeness":
        reached = [floor for floor in result.floors if floor.value >= least_likeness(ceiling)]
        return max(reached, key=lambda level: level.value, default=None)
    reached = [] if ceiling is None else [f for f in result.floors if not _differ(ceiling, f)]
    return max(reached, key=lambda level: level.value, default=None)


def least_likeness(ceiling: Level | None) -> float:
    """Return the least likeness of a motion like the speaker: that of 19 of 20 other takes."""
    if ceiling is None:
        return LEAST_LIKE
    return max(LEAST_LIKE, ceiling.value - LIKE_SPREADS * (ceiling.spread or 0.0))


def _differ(ceiling: Level, floor: Level) -> bool:
    from scipy.stats import t

    gap = ceiling.value - floor.value
    levels = (ceiling, floor)
    sides = [(level.n - 1, level.spread) for level in levels if level.spread is not None]
    free = sum(n for n, _ in sides)
    if not free:
        return gap > 0.0
    variance = sum(n * spread**2 for n, spread in sides) / free
    means = sum(1.0 / level.n for level in (ceiling, floor) if level.n)
    return bool(gap > t.ppf(LEVEL, free) * np.sqrt(variance * means))


def with_timing_levels(result: MetricResult, clips: Sequence[ClipResult]) -> MetricResult:
    """Return the timing of a model with the speaker's own as ceiling, and its floors."""
    own = _by_take(clips, "in_time")
    other = _by_take(clips, OTHER_SOUND)
    floors = [level_of(OTHER_UTTERANCE, other)] if len(other) else []
    ceiling = level_of(OWN, own) if len(own) else None
    return replace(result, ceiling=ceiling, floors=(*floors, Level(MEAN_POSE, 0.0, None, 0)))


def _by_take(clips: Sequence[ClipResult], key: str, *, generated: bool = False) -> np.ndarray:
    """Return the means by take of a metric of the recordings (or clips) that have it."""
    sides = [(clip.pair, clip.metrics if generated else clip.recording) for clip in clips]
    known = [(pair, values[key]) for pair, values in sides if key in values]
    if not known:
        return np.empty(0)
    return Takes.of([pair for pair, _ in known]).means([value for _, value in known])


def add_speech_blind_floors(models: Sequence[ModelResult]) -> None:
    """Add the timing of models that ignore the speech to the floors of the other models."""
    floors = {
        model.label: level_of(model.label, _by_take(model.clips, "in_time", generated=True))
        for model in models
        if model.label in _BLIND and "in_time" in model.metrics
    }
    for model in models:
        timing = model.metrics.get("in_time")
        if timing is not None:
            others = [floor for label, floor in floors.items() if label != model.label]
            model.metrics["in_time"] = replace(timing, floors=(*timing.floors, *others))


def mark_reached_floors(models: Sequence[ModelResult]) -> None:
    """Mark timing and likeness whose ceiling is no higher than a floor as not informative."""
    for model in models:
        for key in model.metrics.keys() & {"in_time", "likeness"}:
            if reached_floor(model.metrics[key]) is not None:
                model.metrics[key] = replace(model.metrics[key], informative=False)
