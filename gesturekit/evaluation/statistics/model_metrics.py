"""Results of one model by metric, from the measurements of its clips and of their set.

The scores that answer the three questions have floors and ceilings, with their spread over takes.
The ceiling is the score of the speaker's other takes. Floors are scores of motion that should fail:
another speaker's, the mean pose, motion that ignores the speech.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS, PATCHES
from gesturekit.evaluation.pairs import Window
from gesturekit.evaluation.results import ClipResult, Interval, Level, MetricResult, ModelResult
from gesturekit.evaluation.statistics.intervals import LEVEL, Takes, interval_of, scaled_like
from gesturekit.evaluation.statistics.thresholds import (
    ABOVE_CHANCE,
    ENOUGH_SECONDS,
    LEARNED_SECONDS,
    LEAST_LIKE,
    LEAST_SECONDS,
    LIKE_SPREADS,
    SAME,
    SATURATED,
)

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
SYNC_SECONDS = 0.4
"""Seconds of arm speed that count as one independent value: the standard deviation of sync over
shifts of a short clip is too small."""

_OF_SPEECH = {
    "sync": ("sync", "sync_z", "sync_lag", "in_time"),
    "bas": ("bas", "bas_z"),
    "bc": ("bc", "bc_z"),
}


def metric_results(
    clips: Sequence[ClipResult],
    of_set: Mapping[str, MetricResult],
    ceilings: Mapping[str, tuple[Interval, str]],
    likeness: MetricResult | None = None,
) -> dict[str, MetricResult]:
    """Return {key of `definitions`: result}.

    Args:
        clips: the clips of a model.
        of_set: metrics of their set, see `measuring.set_metrics`.
        ceilings: the recordings' own values, see `measuring.speaker`.
        likeness: of the model, see `measuring.speaker`.
    """
    found = {}
    for key in DEFINITIONS:
        has = [clip for clip in clips if key in clip.metrics]
        if has:
            found[key] = _mean_result(key, has, len(clips))
    for key, result in of_set.items():
        found[key] = _with_interval(result, found.get(key))
    for key, (own, note) in ceilings.items():
        if key in found:
            notes = "; ".join(filter(None, (found[key].note, note)))
            found[key] = replace(
                found[key], recording=own.value, recording_interval=own, note=notes
            )
    if "novelty" in found and "copying" in found:
        copying = found["copying"]
        new = copying.recording is None or copying.recording > SAME
        found["novelty"] = replace(
            found["novelty"],
            recording=1.0,
            note=copying.note,
            informative=new,
            ceiling=copying.ceiling,
            floors=(Level(TRAINING, 0.0, None, 0),),
        )
        found["copying"] = replace(copying, ceiling=None)
    for key in _not_informative(clips, found) & found.keys():
        found[key] = replace(found[key], informative=False)
    if "in_time" in found:
        own, other = (by_take(clips, key) for key in ("in_time", OTHER_SOUND))
        floors = [level_of(OTHER_UTTERANCE, other)] if len(other) else []
        found["in_time"] = replace(
            found["in_time"],
            ceiling=level_of(OWN, own) if len(own) else None,
            floors=(*floors, Level(MEAN_POSE, 0.0, None, 0)),
        )
    return found if likeness is None else {**found, "likeness": likeness}


def _not_informative(clips: Sequence[ClipResult], found: Mapping[str, MetricResult]) -> set[str]:
    """Return metrics that tell nothing of these recordings: by chance, saturated or too short."""
    keys: set[str] = set()
    for metric, of_speech in _OF_SPEECH.items():
        if metric in found and not above_chance(clips, metric):
            keys.update(of_speech)
    if "cca" in found and (found["cca"].recording or 0.0) > SATURATED:
        keys.add("cca")
    if sum(clip.seconds for clip in clips) < ENOUGH_SECONDS:
        keys.update(key for key in found if DEFINITIONS[key].group == PATCHES)
    if seconds_of(clips) < LEARNED_SECONDS:
        keys |= {"joint_limits", "worst_joint"}
    return keys


def above_chance(clips: Sequence[ClipResult], metric: str, *, of_recordings: bool = True) -> bool:
    """Return whether sync (BAS, BC) of the recordings, or of the model, is above its chance level.

    Its values over circular shifts of the sound give the level and its standard deviation; both
    are pooled over recordings, of samples of which the first is taken.
    """
    first: dict[Window, ClipResult] = {}
    for clip in clips:
        first.setdefault(clip.pair.of, clip)
    above, variance = [], []
    for clip in first.values():
        values = clip.recording if of_recordings else clip.metrics
        value, level, z = (values.get(metric + end) for end in ("", "_chance", "_z"))
        if value is None or level is None or z is None:
            continue
        deviation = (value - level) / z if z else 0.0
        if metric == "sync":
            deviation = max(deviation, np.sqrt(SYNC_SECONDS / clip.seconds))
        if deviation > 0.0:
            above.append(value - level)
            variance.append(deviation**2)
    return bool(above and sum(above) >= ABOVE_CHANCE * np.sqrt(sum(variance)))


def _mean_result(key: str, has: Sequence[ClipResult], total: int) -> MetricResult:
    """Return the mean of a clip metric over takes."""

    def mean(values: Sequence[float], clips: Sequence[ClipResult]) -> Interval:
        return interval_of(values, Takes.of([clip.pair for clip in clips]), DEFINITIONS[key].within)

    own = [clip for clip in has if key in clip.recording]
    interval = mean([clip.recording[key] for clip in own], own) if own else None
    return MetricResult(
        key,
        mean([clip.metrics[key] for clip in has], has),
        recording=None if interval is None else interval.value,
        recording_interval=interval,
        chance=_mean(clip.metrics.get(f"{key}_chance") for clip in has),
        mismatched=_mean(clip.mismatched.get(key) for clip in has),
        note="" if len(has) == total else f"{len(has)} of {total} clips",
    )


def _with_interval(pooled: MetricResult, clips: MetricResult | None) -> MetricResult:
    """Return a pooled result with the width of the interval over its clips, if it has none."""
    if clips is None or pooled.interval.low is not None:
        return pooled
    within = DEFINITIONS[pooled.key].within
    return replace(
        pooled,
        interval=scaled_like(clips.interval, pooled.interval.value, within),
        recording_interval=None
        if pooled.recording is None or clips.recording_interval is None
        else scaled_like(clips.recording_interval, pooled.recording, within),
    )


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def level_of(name: str, values: Sequence[float] | np.ndarray) -> Level:
    """Return the mean and the spread of one value a take."""
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Level(name, float(np.mean(values)), spread, len(values))


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


def by_take(clips: Sequence[ClipResult], key: str, *, generated: bool = False) -> np.ndarray:
    """Return the means by take of a metric of the recordings (or clips) that have it."""
    sides = [(clip.pair, clip.metrics if generated else clip.recording) for clip in clips]
    known = [(pair, values[key]) for pair, values in sides if key in values]
    return Takes.of([pair for pair, _ in known]).means([value for _, value in known])


def seconds_of(clips: Sequence[ClipResult]) -> float:
    """Return the length of clips, one of each recording."""
    return sum({clip.pair.of: clip.seconds for clip in clips}.values())


def add_floors(models: Sequence[ModelResult]) -> None:
    """Add the timing of models that ignore the speech to the floors of the other models.

    Timing and likeness whose ceiling is no higher than a floor are marked as not informative, and
    so is likeness from few seconds.
    """
    blind = {
        model.label: level_of(model.label, by_take(model.clips, "in_time", generated=True))
        for model in models
        if model.label in _BLIND and "in_time" in model.metrics
    }
    for model in models:
        for key in model.metrics.keys() & {"in_time", "likeness"}:
            result = model.metrics[key]
            if key == "in_time":
                others = [floor for label, floor in blind.items() if label != model.label]
                result = replace(result, floors=(*result.floors, *others))
            known = result.informative and reached_floor(result) is None
            known &= key == "in_time" or seconds_of(model.clips) >= LEAST_SECONDS
            model.metrics[key] = replace(result, informative=known)
