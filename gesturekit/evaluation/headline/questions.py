"""Three questions that head a report, answered with one figure and one sentence each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gesturekit.evaluation.headline.likeness import (
    ASPECTS,
    MEASURES,
    USUAL_ONE_NN,
    credits,
    likeness,
)
from gesturekit.evaluation.intervals import Interval, draws, half_width, means_by
from gesturekit.evaluation.results import Answer, ClipResult, MetricResult
from gesturekit.wording import listed

IN_TIME, LIKE, NEW = (
    "In time with the speech?",
    "Moves like this speaker?",
    "Is it new?",
)
TIMED, LOOSE, TOO_MUCH = 0.7, 0.3, 1.3
"""Shares of the recordings' sync above chance: in time, loosely in time, more than the speaker."""
ALIKE, PARTLY = 0.85, 0.6
"""Likeness for yes; and for partly, relative to that of the speaker's other recordings."""
COPIED, NEAR, NOW_AND_THEN = 0.5, 0.8, 0.6
"""Ratios to the distance of held-out recordings below which a model mostly copies, is nearer than
they are (medians), or copies occasionally (5 % quantile)."""
NOTICED = 0.6
"""Credit of an aspect below which it is named."""

Figures = Mapping[str, MetricResult]


def answers(clips: Sequence[ClipResult], figures: Figures) -> list[Answer]:
    """Return the answers to the three questions.

    Args:
        clips: the clips of a model.
        figures: its figures by key of `definitions`.
    """
    return [_timing(figures), _likeness(clips, figures), _novelty(figures)]


def likeness_result(
    clips: Sequence[ClipResult], own_one_nn: float | None, own: float | None, seed: int
) -> MetricResult | None:
    """Return the likeness of a model's clips with its interval over recordings.

    Args:
        clips: the clips.
        own_one_nn: 1-NN accuracy of the recordings among each other, or None.
        own: likeness of other recordings.
        seed: of the bootstrap.
    """
    measure = likeness_of(clips, USUAL_ONE_NN if own_one_nn is None else own_one_nn)
    units = len({clip.pair.stem for clip in clips})
    value = float(measure(np.full((1, units), 1 / units))[0])
    if np.isnan(value):
        return None
    low = high = None
    if units > 1:
        spread = float(half_width(measure(draws(units, seed)), units))
        low, high = max(0.0, value - spread), min(1.0, value + spread)
    note = "" if own is None else "recording: one half against the other"
    interval = Interval(value, low, high, len(clips), units, "recordings")
    return MetricResult("likeness", interval, recording=own, note=note)


def likeness_of(
    clips: Sequence[ClipResult], own_one_nn: float
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of weights (B, R) of recordings, sorted by name, to likenesses (B,)."""
    ours, own = _measures(clips)

    def measured(weights: np.ndarray) -> np.ndarray:
        sides = ({key: weights @ v for key, v in side.items()} for side in (ours, own))
        found = likeness(*sides, own_one_nn)
        return np.full(len(weights), np.nan) if found is None else found

    return measured


def _measures(
    clips: Sequence[ClipResult],
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return {measure: (R,) means by recording} of the model and of the recordings."""
    stems = [clip.pair.stem for clip in clips]
    ours, own = {}, {}
    for key in MEASURES:
        if all(key in clip.figures for clip in clips):
            ours[key] = means_by(stems, np.array([clip.figures[key] for clip in clips]))
        if all(key in clip.recording for clip in clips):
            own[key] = means_by(stems, np.array([clip.recording[key] for clip in clips]))
    return ours, own


def _timing(figures: Figures) -> Answer:
    figure = figures.get("in_time")
    if figure is None or figure.recording is None:
        return Answer(
            IN_TIME, "in_time", "not measured", "Not measured: no speech with arms to move."
        )
    if not figure.informative:
        text = (
            "Not informative here: the recordings' own sync is less than 3 standard errors above "
            "chance. Their arms do not follow this speech, or there is too little of it."
        )
        return Answer(IN_TIME, "in_time", "not informative here", text)
    share = figure.interval.value / figure.recording
    low = figure.interval.low
    beyond = low is not None and low <= 0.0 and share < TIMED
    if share < LOOSE or beyond:
        return Answer(IN_TIME, "in_time", "no", "Not in time with the speech.")
    if share < TIMED:
        return Answer(IN_TIME, "in_time", "partly", "Loosely in time with the speech.")
    if share > TOO_MUCH:
        text = "In time with the speech, more strictly than the speaker."
        return Answer(IN_TIME, "in_time", "partly", text)
    return Answer(IN_TIME, "in_time", "yes", "As much in time with the speech as the speaker.")


def _likeness(clips: Sequence[ClipResult], figures: Figures) -> Answer:
    figure = figures.get("likeness")
    if figure is None:
        return Answer(LIKE, "likeness", "not measured", "Not measured: no body parts to compare.")
    one_nn = figures.get("one_nn")
    own_one_nn = USUAL_ONE_NN if one_nn is None or one_nn.recording is None else one_nn.recording
    means = ({k: v.mean() for k, v in side.items()} for side in _measures(clips))
    found = credits(*means, own_one_nn)
    missed = sorted((a for a in ASPECTS if a in found and found[a] < NOTICED), key=found.get)
    differs = f"; what differs: {listed(missed, 4)}" if missed else ""
    value = figure.interval.value
    top = 1.0 if figure.recording is None else min(1.0, figure.recording)
    if value >= min(ALIKE, top) and not missed:
        return Answer(LIKE, "likeness", "yes", "Moves like this speaker.")
    if value >= PARTLY * top:
        much = "mostly" if value >= min(ALIKE, top) else "somewhat"
        return Answer(LIKE, "likeness", "partly", f"Moves {much} like this speaker{differs}.")
    return Answer(LIKE, "likeness", "no", f"Does not move like this speaker{differs}.")


def _novelty(figures: Figures) -> Answer:
    figure, low = figures.get("novelty"), figures.get("copying_low")
    if figure is None:
        text = "Not measured: the clips are too short, or the rig's arms and legs are not known."
        return Answer(NEW, "novelty", "not measured", text)
    among = "training motion" if "training split" in figure.note else "the recordings"
    if not figure.informative:
        text = (
            f"Not informative here: the recordings themselves are the same as {among}, or do not "
            "move. Look for one recording in two splits."
        )
        return Answer(NEW, "novelty", "not informative here", text)
    now_and_then = low is not None and low.recording and (
        low.interval.value < NOW_AND_THEN * low.recording
    )  # fmt: skip
    if figure.interval.value < COPIED:
        return Answer(NEW, "novelty", "no", f"Mostly copied from {among}{_seeds(figures)}.")
    if figure.interval.value < NEAR:
        text = f"Nearer to {among} than other recordings are: partly copied, or less lively"
        return Answer(NEW, "novelty", "no", f"{text}{_seeds(figures)}.")
    if now_and_then:
        text = f"New, but occasionally copied from {among}{_seeds(figures)}."
        return Answer(NEW, "novelty", "partly", text)
    return Answer(
        NEW, "novelty", "yes", f"New: as far from {among} as other recordings{_seeds(figures)}."
    )


def _seeds(figures: Figures) -> str:
    """Return how much the samples of one recording differ, in words; "" with one sample."""
    figure = figures.get("inter_diversity")
    if figure is None or not figure.recording:
        return ""
    share = figure.interval.value / figure.recording
    return f"; two samples of one speech differ {100 * share:.0f} % as much as two recordings do"
