"""Verdict: one line in words that heads the report.

Such as "Half of the speaker's reach, hardly ever at rest, in time with the speech."
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from gesturekit.evaluation.headline.questions import COPIED, NEAR, NOW_AND_THEN
from gesturekit.evaluation.results import MetricResult

ALIKE = (0.8, 1.25)
"""Ratios to the recording's reach and fast gestures that count as equal."""
RESTS_ALIKE = (0.7, 1.4)
"""Ratios to the recording's share of rests that count as equal."""
HARDLY_EVER = 0.35
"""Below this ratio to the recording's share of rests, hands hardly ever rest."""
FEW_RESTS = 2.0
"""Percentage of rests in the recordings below which rests are not reported."""
FROZEN = 5.0
"""Hands count as frozen if they are nearly still in this many more percent of frames than the
recording's."""
MOTIONLESS = 90.0
"""Percentage of frames with nearly still hands above which the verdict reports nothing else."""
IN_TIME = 0.7
"""Motion with at least this share of the recording's sync above chance is in time with the
speech."""
BY_CHANCE = 0.3
"""Motion with less than this share of the recording's sync above chance is not in time."""
LEAST_SYNC = 0.1
"""Recordings with less sync above chance than this do not move with their speech."""
FOLLOWS = 0.4
"""Correlation of calm and lively stretches above which they count as those of the speaker."""

_RATIOS = {
    0.1: "a tenth of",
    0.25: "a quarter of",
    1 / 3: "a third of",
    0.5: "half of",
    2 / 3: "two thirds of",
    0.75: "three quarters of",
    1.5: "one and a half times",
    2.0: "twice",
    3.0: "three times",
    4.0: "four times",
}


def verdict(figures: Mapping[str, MetricResult]) -> str:
    """Return a sentence about reach, speed, rests, timing and copying; "" if nothing is known.

    Args:
        figures: results of a model by key of `definitions`, each with the recording's value.
    """
    still = figures.get("near_still")
    if still is not None and still.interval.value >= MOTIONLESS:
        return "The hands hardly move."
    phrases = [*_movement(figures), *_rests(figures), *_timing(figures), *_copying(figures)]
    text = ", ".join(phrases)
    return f"{text[0].upper()}{text[1:]}." if text else ""


def in_words(ratio: float) -> str:
    """Return a ratio other than 1 in words, such as "half of"; the nearest one with a name."""
    if ratio < 0.07:
        return "next to nothing of"
    if ratio > 5.0:
        return "many times"
    return _RATIOS[min(_RATIOS, key=lambda named: abs(np.log(named / ratio)))]


def _movement(figures: Mapping[str, MetricResult]) -> Iterator[str]:
    reach, fast = _ratio(figures, "reach"), _ratio(figures, "hand_q90")
    if reach is not None:
        share = "" if _within(reach, ALIKE) else f"{in_words(reach)} "
        yield f"{share}the speaker's reach"
    if fast is not None and not _within(fast, ALIKE):
        yield f"fast gestures at {in_words(fast)} the speaker's speed"


def _rests(figures: Mapping[str, MetricResult]) -> Iterator[str]:
    rest, still = figures.get("rest"), figures.get("near_still")
    if still is not None and still.interval.value > (still.recording or 0.0) + FROZEN:
        yield f"hands frozen in {still.interval.value:.0f} % of the time"
    elif rest is not None and (rest.recording or 0.0) >= FEW_RESTS:
        ratio = rest.interval.value / rest.recording
        if ratio < HARDLY_EVER:
            yield "hardly ever at rest"
        elif ratio < RESTS_ALIKE[0]:
            yield "seldom at rest"
        elif ratio > RESTS_ALIKE[1]:
            yield "at rest more often than the speaker"
        else:
            yield "at rest as often as the speaker"


def _timing(figures: Mapping[str, MetricResult]) -> Iterator[str]:
    calm, sync = figures.get("calm_lively_r"), figures.get("sync")
    if calm is not None and calm.informative and calm.interval.value < FOLLOWS:
        yield "calm and lively at other times than the speaker"
    if sync is None or sync.recording is None:
        return
    levels = [level for level in (sync.mismatched, sync.chance) if level is not None]
    chance = max(levels, default=0.0)
    ours, own = sync.interval.value - chance, sync.recording - chance
    if own < LEAST_SYNC:
        yield "speech that hardly moves the speaker's arms either"
    elif not sync.informative:
        return
    elif ours >= IN_TIME * own:
        yield "in time with the speech"
    elif ours >= BY_CHANCE * own:
        yield "loosely in time with the speech"
    else:
        yield "not in time with the speech"


def _copying(figures: Mapping[str, MetricResult]) -> Iterator[str]:
    median, low = _ratio(figures, "copying"), _ratio(figures, "copying_low")
    if median is not None and median < COPIED:
        yield "mostly copied from recordings"
    elif (_ratio(figures, "reach") or 1.0) < ALIKE[0]:
        return  # small motion is near to any
    elif median is not None and median < NEAR:
        yield "partly copied from recordings"
    elif low is not None and low < NOW_AND_THEN:
        yield "occasionally copied from recordings"


def _ratio(figures: Mapping[str, MetricResult], key: str) -> float | None:
    """Return a value over the recording's; None without either."""
    figure = figures.get(key)
    if figure is None or not figure.recording:
        return None
    return figure.interval.value / figure.recording


def _within(ratio: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= ratio <= limits[1]
