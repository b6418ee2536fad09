"""Results of one model by metric, from the measurements of its clips and of their set."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS, PATCHES
from gesturekit.evaluation.pairs import Window
from gesturekit.evaluation.results import ClipResult, Interval, Level, MetricResult
from gesturekit.evaluation.statistics.intervals import Takes, interval_of, scaled_like
from gesturekit.evaluation.statistics.levels import TRAINING, with_timing_levels
from gesturekit.evaluation.statistics.thresholds import (
    ABOVE_CHANCE,
    ENOUGH_SECONDS,
    SAME,
    SATURATED,
)

SYNC_SECONDS = 0.4
"""Seconds of arm speed that count as one independent value: the standard deviation of sync over
shifts of a short clip is too small."""

_OF_SPEECH = {"sync": ("sync", "sync_z", "in_time"), "bas": ("bas", "bas_z"), "bc": ("bc", "bc_z")}


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
    for metric, keys in _OF_SPEECH.items():
        if metric in found and not above_chance(clips, metric):
            found |= {k: replace(found[k], informative=False) for k in keys if k in found}
    cca = found.get("cca")
    if cca is not None and cca.recording is not None and cca.recording > SATURATED:
        found["cca"] = replace(cca, informative=False)
    if sum(clip.seconds for clip in clips) < ENOUGH_SECONDS:
        few = [key for key in found if DEFINITIONS[key].group == PATCHES]
        found |= {key: replace(found[key], informative=False) for key in few}
    if "in_time" in found:
        found["in_time"] = with_timing_levels(found["in_time"], clips)
    return found if likeness is None else {**found, "likeness": likeness}


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
