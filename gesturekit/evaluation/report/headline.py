"""The head of a report: three questions with their answers, and warnings about intervals."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping

from gesturekit.evaluation.contest.paired import Contest
from gesturekit.evaluation.intervals import FEW
from gesturekit.evaluation.report.plots import colour
from gesturekit.evaluation.report.tables import number, section
from gesturekit.evaluation.results import Answer, Evaluation, MetricResult, ModelResult

_LEAD = (
    "Each with one figure, its 95 % interval over recordings and the recordings' own value. Bold: "
    "nearer to the recordings than every other model by more than chance."
)


def headline_lines(evaluation: Evaluation) -> list[str]:
    """Return the answers to the three questions as lines of text, model by model."""
    lines = []
    for model in evaluation.models:
        named = f"{model.label}: " if len(evaluation.models) > 1 else ""
        for answer in model.answers:
            figure = _shown(model, answer)
            value = "" if figure is None else f" ({_figure_text(figure)})"
            lines.append(f"{named}{answer.question} {answer.sentence}{value}")
    return lines


def headline(evaluation: Evaluation, rows: Mapping[str, Contest]) -> str:
    """Return the section of the three questions as HTML; "" without measures of life."""
    models = [model for model in evaluation.models if model.answers]
    if not models:
        return ""
    head = "".join(f"<th>{html.escape(answer.question)}</th>" for answer in models[0].answers)
    body = "".join(
        f'<tr><th><span class="dot" style="background:{colour(evaluation.models.index(model))}">'
        f"</span>{html.escape(model.label)}</th>"
        + "".join(_cell(model, answer, rows) for answer in model.answers)
        + "</tr>"
        for model in models
    )
    table = f"<thead><tr><th></th>{head}</tr></thead><tbody>{body}</tbody>"
    return section(
        "Three questions", _LEAD, f'<div class="scroll"><table class="head">{table}</table></div>'
    )


def interval_warnings(evaluation: Evaluation) -> Iterator[str]:
    """Yield warnings about intervals that are missing or rough."""
    for model in evaluation.models:
        who = f"{model.label}: " if len(evaluation.models) > 1 else ""
        recordings = len({clip.pair.stem for clip in model.clips})
        if recordings == 1:
            yield (
                f"{who}a single recording: no intervals, and nothing is bold. How a model does on "
                "others cannot be told from one; more samples (seeds) of it do not change that. "
                "Evaluate on several held-out recordings"
            )
        elif recordings < FEW:
            yield (
                f"{who}intervals come from {recordings} recordings: they are rough. Evaluate on "
                f"{FEW} or more"
            )


def _cell(model: ModelResult, answer: Answer, rows: Mapping[str, Contest]) -> str:
    figure = _shown(model, answer)
    sentence = f"<p>{html.escape(answer.sentence)}</p>"
    if figure is None:
        return f"<td>{sentence}</td>"
    row = rows.get(answer.key)
    best = " class=best" if row is not None and row.best == model.label else ""
    value, _, rest = _figure_text(figure).partition(" ")
    small = f"<small>{html.escape(rest)}</small>"
    shown = f'<span class="figure"><span{best}>{value.rstrip(",;")}</span></span>'
    return f"<td>{shown}{small}{sentence}</td>"


def _shown(model: ModelResult, answer: Answer) -> MetricResult | None:
    """Return the figure of an answer, unless it is not informative."""
    figure = model.figures.get(answer.key)
    return figure if figure is not None and figure.informative else None


def _figure_text(figure: MetricResult) -> str:
    interval = figure.interval
    spread = (
        ", no interval"
        if interval.low is None or interval.high is None
        else f" [{number(interval.low)}, {number(interval.high)}]"
    )
    own = "" if figure.recording is None else f"; recordings {number(figure.recording)}"
    return f"{number(interval.value)}{spread}{own}"
