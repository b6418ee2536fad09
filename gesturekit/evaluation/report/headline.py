"""The head of a report: three questions with their answers, and warnings about intervals."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence

from gesturekit.evaluation.report.tables import dotted, number
from gesturekit.evaluation.results import Evaluation, Finding, MetricResult, ModelResult
from gesturekit.evaluation.statistics.intervals import Takes
from gesturekit.evaluation.statistics.paired import Contest
from gesturekit.viewer.pages import section

_LEAD = (
    "Each with one figure and its 95 % interval over takes (recording sessions): it holds for "
    "other takes of the same speakers, not for other speakers. The last row has what the "
    "speaker's recordings reach. Each clip is compared with the recording of the same speech, but "
    "recordings differ in speech and mood: a model can be more like the speaker than they are like "
    "each other. Bold: nearer to the recordings than every other model by more than chance."
)
_OWN = {
    "in_time": ("the speaker's own", "Sync of the speaker's own arms, minus chance."),
    "likeness": (
        "recordings like each other",
        "The speaker's recordings, one half judged by the other; 1 is alike in all.",
    ),
    "novelty": (
        "recordings from each other",
        "Other recordings, by definition; below 0.8 is nearer, below 0.5 copied.",
    ),
}
"""Meaning of the recordings' own value of each metric: short, and as a sentence."""


def headline_lines(evaluation: Evaluation) -> list[str]:
    """Return the answers to the three questions as lines of text, model by model."""
    lines = []
    for model in evaluation.models:
        named = f"{model.label}: " if len(evaluation.models) > 1 else ""
        for answer in model.answers:
            result = _shown(model, answer)
            value = "" if result is None else f" ({_result_text(result)})"
            lines.append(f"{named}{answer.question} {answer.sentence}{value}")
    return lines


def headline(evaluation: Evaluation, rows: Mapping[str, Contest]) -> str:
    """Return the section of the three questions as HTML; "" without pooled metrics."""
    models = [model for model in evaluation.models if model.answers]
    if not models:
        return ""
    head = "".join(f"<th>{html.escape(answer.question)}</th>" for answer in models[0].answers)
    body = "".join(
        f"<tr><th>{dotted(evaluation.models.index(model), model.heading)}</th>"
        + "".join(_cell(model, answer, rows) for answer in model.answers)
        + "</tr>"
        for model in models
    )
    table = (
        f"<thead><tr><th></th>{head}</tr></thead><tbody>{body}"
        f"<tr class=own><th>recordings</th>{_own_cells(models)}</tr></tbody>"
    )
    return section(
        "Three questions", _LEAD, f'<div class="scroll"><table class="head">{table}</table></div>'
    )


def interval_warnings(evaluation: Evaluation) -> Iterator[str]:
    """Yield warnings about intervals that are missing, with the data that would give them."""
    said: dict[str, list[str]] = {}
    for model in evaluation.models:
        takes = Takes.of([clip.pair for clip in model.clips])
        if takes.count >= takes.needed:
            continue
        text = (
            f"the clips come from {takes.in_words}: no intervals, and nothing is bold. "
            "Differences between takes (recording sessions) cannot be told from fewer than "
            f"{takes.needed}; more clips or samples (seeds) of the same takes do not change that. "
            f"Hold out {takes.needed} or more takes"
        )
        said.setdefault(text, []).append(model.label)
    for text, labels in said.items():
        yield text if len(said) == 1 else f"{', '.join(labels)}: {text}"


def _cell(model: ModelResult, answer: Finding, rows: Mapping[str, Contest]) -> str:
    result = _shown(model, answer)
    sentence = f"<p>{html.escape(answer.sentence)}</p>"
    if result is None:
        return f"<td>{sentence}</td>"
    row = rows.get(answer.key)
    best = " class=best" if row is not None and row.best == model.label else ""
    value = f'<span class="figure"><span{best}>{number(result.interval.value)}</span></span>'
    return f"<td>{value}<small>{_spread(result)}</small>{sentence}</td>"


def _own_cells(models: Sequence[ModelResult]) -> str:
    """Return the cells of the recordings' own values, each from the first model that has one."""
    cells = ""
    for answer in models[0].answers:
        shown = (_shown(model, answer) for model in models)
        known = (result.recording for result in shown if result is not None)
        own = next((value for value in known if value is not None), None)
        cells += (
            "<td></td>"
            if own is None
            else f'<td><span class="figure">{number(own)}</span><p>{_OWN[answer.key][1]}</p></td>'
        )
    return cells


def _shown(model: ModelResult, answer: Finding) -> MetricResult | None:
    """Return the result of an answer, unless it is not informative."""
    result = model.metrics.get(answer.key)
    return result if result is not None and result.informative else None


def _result_text(result: MetricResult) -> str:
    short = _OWN[result.key][0]
    own = "" if result.recording is None else f"; {short}: {number(result.recording)}"
    return f"{number(result.interval.value)}, {_spread(result)}{own}"


def _spread(result: MetricResult) -> str:
    low, high = result.interval.low, result.interval.high
    if low is None or high is None:
        return "no interval"
    return f"95 % interval {number(low)} to {number(high)}"
