"""Likeness: one number between 0 and 1 for how much a motion moves like the speaker.

A motion gets a credit, 0 to 1, for each of nine aspects: for hand speed, rests, reach, contrast,
smoothness and feet that of ratios to the recordings it is compared with (1 within 0.8 to 1.25, 0
beyond 0.4 and 2.5, falling linearly in the logarithm between), for postures and movements that of
the 1-NN test, for direction of time and left and right that of windows that are nearer to the
recordings than to the same played backwards or mirrored. Its score is the geometric mean of two:
that of the credits of movement, and the lower credit of postures and movements and of left and
right. So neither noise with the speaker's statistics nor recorded postures without the
speaker's movement come to a high score.

Likeness is this score over that of recordings of the speaker that are compared with the same
recordings, where no aspect counts more than the speaker's own: an average is not better than a
person.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.results import GroupLikeness, Interval, Level, MetricResult
from gesturekit.evaluation.statistics.intervals import FEW, LEAST_FREEDOM, bounds_about
from gesturekit.evaluation.statistics.model_metrics import CEILING
from gesturekit.evaluation.statistics.thresholds import (
    FORWARD,
    FULL_CREDIT,
    LEAST_CREDIT,
    LEAST_OWN,
    NO_CREDIT,
    SATURATED,
    SIDED,
)

ASPECTS: dict[str, tuple[str, ...]] = {
    aspect: tuple(key for key, d in DEFINITIONS.items() if d.aspect == aspect)
    for aspect in (
        "hand speed",
        "rests",
        "reach",
        "contrast of calm and lively",
        "smoothness",
        "feet",
        "postures and movements",
    )
} | {"direction of time": ("forward",), "left and right": ("sided",)}
"""Keys of `definitions` of each aspect; `forward` and `sided` are the percentages of windows that
are nearer to recordings than to the same played backwards, and mirrored."""
RATIOS = {k: d.ratio_floor for k, d in DEFINITIONS.items() if d.ratio_floor is not None}
"""Metrics that are compared as ratios, and what is added to both values."""
TWO_SAMPLE = ("postures and movements", "left and right")
"""Aspects that tell windows of motion from those of the recordings."""

Credits = dict[str, float]
"""{aspect: credit}"""


def credits(ours: Mapping[str, float], theirs: Mapping[str, float]) -> Credits:
    """Return the credit of each aspect that is known, 0 to 1.

    Args:
        ours: {key of `definitions`: value} of the motion.
        theirs: the same of the recordings; only those in `RATIOS` are needed.
    """
    found = {}
    for aspect, keys in ASPECTS.items():
        known = [key for key in keys if key in ours and (key not in RATIOS or key in theirs)]
        if known:
            found[aspect] = float(np.mean([_credit(k, ours[k], theirs.get(k)) for k in known]))
    return found


def score(found: Mapping[str, float]) -> float:
    """Return the score of credits, which count as `LEAST_CREDIT` at least."""
    least = {aspect: max(credit, LEAST_CREDIT) for aspect, credit in found.items()}
    movement = [credit for aspect, credit in least.items() if aspect not in TWO_SAMPLE]
    windows = [credit for aspect, credit in least.items() if aspect in TWO_SAMPLE]
    sides = [float(np.exp(np.mean(np.log(movement))))] if movement else []
    sides += [min(windows)] if windows else []
    return float(np.prod(sides) ** (1.0 / len(sides)))


def relative(ours: Mapping[str, float], own: Mapping[str, float]) -> GroupLikeness | None:
    """Return the likeness of a motion to the speaker, both compared with the same recordings.

    An aspect that only the speaker has, such as the contrast of hands that never move, has the
    credit 0. None without any aspect.

    Args:
        ours: credits of the motion.
        own: credits of the speaker's own recordings.
    """
    if not own:
        return None
    capped = {aspect: min(ours.get(aspect, 0.0), credit) for aspect, credit in own.items()}
    shares = {
        aspect: max(capped[aspect], LEAST_CREDIT) / max(credit, LEAST_CREDIT)
        for aspect, credit in own.items()
    }
    return GroupLikeness("", (), score(capped) / score(own), score(own), shares)


def _credit(key: str, ours: float, theirs: float | None) -> float:
    if key == "one_nn":
        credit = 2.0 * (1.0 - ours)
    elif key == "forward":
        credit = ours / FORWARD
    elif key == "sided":
        credit = (ours - SIDED[0]) / (SIDED[1] - SIDED[0])
    else:
        floor, full, none = RATIOS[key], np.log(FULL_CREDIT), np.log(NO_CREDIT)
        ratio = abs(np.log((ours + floor) / ((theirs or 0.0) + floor)))
        credit = (none - ratio) / (none - full)
    return float(np.clip(credit, 0.0, 1.0))


def likeness_result(
    groups: Sequence[GroupLikeness], levels: Mapping[str, Level], clips: int
) -> MetricResult | None:
    """Return the likeness of a model, averaged over groups by their takes, with its interval.

    Not informative where the speaker's own score is so low that nothing can be compared with it.

    Args:
        groups: measured by `measuring.speaker`; none gives None.
        levels: ceiling and floors by name.
        clips: number of clips of the model.
    """
    if not groups:
        return None
    weights = [len(group.takes) for group in groups]
    value, own = (
        float(np.average([getattr(group, name) for group in groups], weights=weights))
        for name in ("value", "own")
    )
    takes, pieces = sum(weights), all(group.pieces for group in groups)
    error = None if pieces or value > SATURATED else standard_error_of(groups)
    low, high = error and bounds_about(value, *error, (0.0, 1.0)) or (None, None)
    speakers = len({group.name.partition(",")[0] for group in groups})
    compared = "pieces of takes" if pieces else "takes"
    return MetricResult(
        "likeness",
        Interval(value, low, high, clips, 1 if pieces else takes, "takes", speakers),
        recording=1.0,
        note=f"shares of the score of the speaker's other {compared}, {own:.2f}",
        informative=own >= LEAST_OWN,
        ceiling=levels.get(CEILING),
        floors=tuple(level for name, level in levels.items() if name != CEILING),
        groups=tuple(groups),
    )


def standard_error_of(groups: Sequence[GroupLikeness]) -> tuple[float, int] | None:
    """Return the standard error of likeness and its degrees of freedom; None with too few takes.

    The jackknife over the takes with clips of the model, plus that over the takes that these are
    compared with (Efron and Stein 1981; two samples).
    """
    weights = np.array([len(group.takes) for group in groups], float)
    free = int(sum(max(0, len(group.without) - 1) for group in groups))
    if weights.sum() < FEW or free < LEAST_FREEDOM:
        return None
    variance = [
        sum(_jackknife(v) for v in ([*group.without.values()], group.without_reference))
        for group in groups
    ]
    return float(np.sqrt(variance @ (weights / weights.sum()) ** 2)), free


def _jackknife(without: Sequence[float]) -> float:
    """Return the variance of a statistic, given its values without each unit."""
    n = len(without)
    return (n - 1) * float(np.var(without)) if n > 1 else 0.0


def aspects_of(groups: Sequence[GroupLikeness]) -> dict[str, float]:
    """Return {aspect: credit over the speaker's own}, averaged over groups by their takes."""
    found = {}
    for aspect in ASPECTS:
        known = [(g.aspects[aspect], len(g.takes)) for g in groups if aspect in g.aspects]
        if known:
            values, weights = zip(*known, strict=True)
            found[aspect] = float(np.average(values, weights=weights))
    return found


def pseudo_values_of(groups: Sequence[GroupLikeness]) -> dict[tuple[str, str], float]:
    """Return the jackknife's pseudo-value of each (group, take) with clips of the model."""
    total = sum(len(group.takes) for group in groups)
    return {
        (group.name, take): group.value + (len(group.takes) - 1) * (group.value - without)
        for group in groups
        for take, without in group.without.items()
        if total >= FEW
    }
