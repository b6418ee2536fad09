"""Table of the metrics that notice known-bad motion, and of those that are blind to it."""

from __future__ import annotations

from collections.abc import Iterator

from gesturekit.evaluation.definitions import HEADLINE, Definition
from gesturekit.evaluation.report.bad_motion import RECORDING, Sanity
from gesturekit.evaluation.results import MetricResult, ModelResult
from gesturekit.wording import listed

NOTICED, BLIND, FOOLED, SILENT = "+", ".", "!", " "
"""Marks: noticed; blind; rated better than the recording itself; nothing measured or to say."""
LEGEND = (
    "+ notices it, . is blind to it, ! rates it better than the recording itself (as the metric is "
    "published); blank: not measured, or not informative on these recordings"
)
CHANGE = 0.2
"""A metric detects bad motion if its value differs from the recordings' own by more than this
ratio."""
TIMED = 0.5
"""A speech metric detects bad motion below this share of the recordings' own value above chance."""
UNLIKE, NEAR = 0.05, 0.8
"""Loss of likeness, and ratio of distances to training motion, that count as detection."""


def marks(sanity: Sanity) -> dict[str, dict[str, str]]:
    """Return {key of `definitions`: {bad motion: mark}}."""
    evaluation = sanity.evaluation
    recording, *bad = evaluation.models
    return {
        d.key: {m.label: mark(d, m.metrics.get(d.key), recording) for m in bad}
        for d in evaluation.definitions()
    }


def mark(definition: Definition, result: MetricResult | None, recording: ModelResult) -> str:
    """Return the mark of one metric for one bad motion.

    Args:
        definition: of the metric.
        result: the bad motion's result, or None.
        recording: the results of the recordings themselves.
    """
    own = recording.metrics.get(definition.key)
    if result is None or own is None or not result.informative:
        return SILENT
    if own.recording is None and definition.enough:
        return SILENT
    value, itself = result.interval.value, own.interval.value
    sign = {"higher": 1.0, "lower": -1.0, "reference": 0.0}[definition.better]
    if sign * (value - itself) > CHANGE * abs(itself) + 1e-6:
        return FOOLED
    return NOTICED if _notices(definition, result, own) else BLIND


def _notices(definition: Definition, result: MetricResult, own: MetricResult) -> bool:
    key = definition.key
    value, itself = result.interval.value, own.interval.value
    if key == "likeness":
        return value < itself - UNLIKE
    if key in ("novelty", "copying", "copying_low"):
        return value < NEAR * itself
    if key == "in_time" or key.endswith("_z"):
        return value < TIMED * itself
    if result.chance is not None and own.chance is not None:
        return value - result.chance < TIMED * (itself - own.chance)
    goal = itself if own.recording is None else own.recording
    if definition.enough == "at least":
        return value < (1.0 - CHANGE) * goal
    if definition.enough == "at most":
        return value > (1.0 + CHANGE) * goal
    return key not in ("calm_lively_slope",) and abs(value - goal) > CHANGE * abs(goal) + 1e-9


def table_lines(sanity: Sanity) -> Iterator[str]:
    """Yield the table for a terminal: one row a metric, one numbered column a bad motion."""
    evaluation = sanity.evaluation
    names = [model.label for model in evaluation.models if model.label != RECORDING]
    found = marks(sanity)
    yield "What each metric notices of known-bad motion"
    yield from (f"  {n}  {name}" for n, name in enumerate(names, 1))
    width = max(len(d.name) for d in evaluation.definitions())
    yield f"{'':{width}}  {' '.join(f'{n:>2}' for n in range(1, len(names) + 1))}"
    group = ""
    for d in evaluation.definitions():
        if d.group != group:
            group = d.group
            yield f"{group}:"
        signs = " ".join(f"{found[d.key][name]:>2}" for name in names)
        yield f"{d.name:{width}}  {signs}".rstrip()
    yield LEGEND


def noticed_by(sanity: Sanity) -> dict[str, list[str]]:
    """Return {bad motion: keys of the headline metrics that notice it}."""
    found = marks(sanity)
    keys = [d.key for d in sanity.evaluation.definitions() if d.group == HEADLINE]
    return {
        model.label: [key for key in keys if found[key][model.label] == NOTICED]
        for model in sanity.evaluation.models
        if model.label != RECORDING
    }


def conclusion(sanity: Sanity) -> str:
    """Return what the three headline metrics notice together, in one sentence."""
    found = noticed_by(sanity)
    missed = [name for name, keys in found.items() if not keys]
    timed = sanity.evaluation.models[0].metrics.get("in_time")
    why = "" if timed is not None and timed.informative else (
        " (In time with the speech: cannot be answered on this corpus.)"
    )  # fmt: skip
    if not missed:
        return f"The three headline figures together notice all {len(found)} bad motions.{why}"
    return (
        f"The three headline figures together notice {len(found) - len(missed)} of {len(found)} "
        f"bad motions, but not: {listed(missed, 5)}.{why}"
    )
