"""The head of a report: three questions with their answers, and warnings about intervals."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence

from gesturekit.evaluation.report.plots import colour
from gesturekit.evaluation.report.tables import dotted, number
from gesturekit.evaluation.results import Evaluation, Finding, Level, MetricResult, ModelResult
from gesturekit.evaluation.statistics.intervals import Takes
from gesturekit.evaluation.statistics.levels import level_name
from gesturekit.evaluation.statistics.paired import Contest
from gesturekit.viewer.pages import section

_LEAD = (
    "Each answer rests on one figure. On its line, the dot is the model; the green mark is the "
    "ceiling, the value of the speaker's own recordings; grey marks are floors, the values of "
    "motion that should fail. Bands are one standard deviation between takes (recording sessions) "
    "to either side. Without a dot, the question cannot be answered on this corpus. The 95 % "
    "interval holds for other takes of the same speakers, not for other speakers. Bold: nearer to "
    "the recordings than every other model by more than chance."
)

_WIDTH, _HEIGHT, _MARGIN = 260, 30, 6  # pixels of the line of a score


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
    head = "".join(_column_head(answer, models) for answer in models[0].answers)
    body = "".join(
        f"<tr><th>{dotted(evaluation.models.index(model), model.heading)}</th>"
        + "".join(_cell(model, answer, models, rows) for answer in model.answers)
        + "</tr>"
        for model in models
    )
    table = f"<thead><tr><th></th>{head}</tr></thead><tbody>{body}</tbody>"
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


def _column_head(answer: Finding, models: Sequence[ModelResult]) -> str:
    """Return the heading of a question, with the floors and the ceiling that all models share."""
    results = [m.metrics[answer.key] for m in models if answer.key in m.metrics]
    return f"<th>{html.escape(answer.question)}{_legend(results[0]) if results else ''}</th>"


def _cell(
    model: ModelResult,
    answer: Finding,
    models: Sequence[ModelResult],
    rows: Mapping[str, Contest],
) -> str:
    result, sentence = model.metrics.get(answer.key), f"<p>{html.escape(answer.sentence)}</p>"
    if result is None:
        return f"<td>{sentence}</td>"
    column = [m.metrics[answer.key] for m in models if answer.key in m.metrics]
    line = _scale(result, column, colour(models.index(model)))
    if _levels(result) != _levels(column[0]):
        line += _legend(result)
    if not result.informative:
        return f"<td>{sentence}{line}</td>"
    row = rows.get(answer.key)
    best = " class=best" if row is not None and row.best == model.label else ""
    value = f'<span class="figure"><span{best}>{number(result.interval.value)}</span></span>'
    bare = all(one.interval.low is None for one in column)
    spread = "" if bare else f" <small>{_spread(result)}</small>"
    return f"<td>{sentence}{value}{spread}{line}</td>"


def _shown(model: ModelResult, answer: Finding) -> MetricResult | None:
    """Return the result of an answer, unless it is not informative."""
    result = model.metrics.get(answer.key)
    return result if result is not None and result.informative else None


def _result_text(result: MetricResult) -> str:
    line = _line_in_words(result)
    return "; ".join(filter(None, (number(result.interval.value), _spread(result), line)))


def _spread(result: MetricResult) -> str:
    low, high = result.interval.low, result.interval.high
    if low is None or high is None:
        return "no interval"
    return f"95 % interval {number(low)} to {number(high)}"


def _levels(result: MetricResult) -> list[Level]:
    """Return floors and ceiling."""
    return [*result.floors, *([result.ceiling] if result.ceiling else [])]


def _scale(result: MetricResult, column: Sequence[MetricResult], ink: str) -> str:
    """Return the line of a score as SVG; "" without levels.

    Bands are as wide as the spread over takes. An uninformative score is not drawn.

    Args:
        result: the score.
        column: the scores of all models, whose lines have one scale.
        ink: colour of the model.
    """
    levels = _levels(result)
    if not levels:
        return ""
    every = [level for one in column for level in _levels(one)]
    known = [level.value + sign * (level.spread or 0.0) for level in every for sign in (-1, 1)]
    known += [one.interval.value for one in column if one.informative]
    score = [result.interval.value] if result.informative else []
    low, high = min(0.0, *known), max(1e-6, *known)

    def place(value: float) -> float:
        return _MARGIN + (_WIDTH - 2 * _MARGIN) * (value - low) / (high - low)

    parts = [f'<line x1="{_MARGIN}" x2="{_WIDTH - _MARGIN}" y1="15" y2="15" class="axis"/>']
    for level in levels:
        kind, at = "ceiling" if level is result.ceiling else "floor", place(level.value)
        spread = (level.spread or 0.0) * (_WIDTH - 2 * _MARGIN) / (high - low)
        parts.append(
            f'<g class="{kind}"><title>{html.escape(_level_line(level))}</title>'
            f'<rect x="{at - spread:.1f}" width="{2 * spread:.1f}" y="9" height="12"/>'
            f'<line x1="{at:.1f}" x2="{at:.1f}" y1="5" y2="25"/></g>'
        )
    dot = f'cy="15" r="5" style="fill:{ink}"'
    parts += [f'<circle cx="{place(value):.1f}" {dot}/>' for value in score]
    return f'<svg class="scale" viewBox="0 0 {_WIDTH} {_HEIGHT}">{"".join(parts)}</svg>'


def _legend(result: MetricResult) -> str:
    """Return the floors and the ceiling of a score in words."""
    kinds = (("floor", result.floors), ("ceiling", (result.ceiling,) if result.ceiling else ()))
    return "".join(
        f'<small class="{kind}">{kind}: {html.escape("; ".join(map(_level_line, levels)))}</small>'
        for kind, levels in kinds
        if levels
    )


def _level_line(level: Level) -> str:
    """Return a level in words, such as "another speaker 0.41 ± 0.06 (4 takes)"."""
    spread = "" if level.spread is None else f" ± {number(level.spread)}"
    unit = "piece" if level.pieces else "take"
    count = f" ({level.n} {unit}{'s' if level.n > 1 else ''})" if level.n else ""
    return f"{level_name(level)} {number(level.value)}{spread}{count}"


def _line_in_words(result: MetricResult) -> str:
    """Return floors and ceiling for a terminal, such as "floor: mean pose 0.1; ceiling: ..."."""
    floors = ", ".join(map(_level_line, result.floors))
    parts = [f"floor: {floors}"] if floors else []
    if result.ceiling is not None:
        parts.append(f"ceiling: {_level_line(result.ceiling)}")
    return "; ".join(parts)
