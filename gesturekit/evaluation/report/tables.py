"""The report's tables, as HTML."""

from __future__ import annotations

import html

from gesturekit.evaluation.definitions import GROUPS, PATCHES, Definition
from gesturekit.evaluation.intervals import Interval
from gesturekit.evaluation.report.plots import colour
from gesturekit.evaluation.results import Evaluation, MetricResult, ModelResult
from gesturekit.wording import counted

_ARROWS = {
    "higher": ("↑", "higher is better"),
    "lower": ("↓", "lower is better"),
    "reference": ("≈", "as the recording is best"),
}
_MOST_CLIPS = 300
_PER_CLIP = (
    "sync", "sync_z", "bc", "arm_speed", "jerk", "foot_skate", "hellinger", "coverage",
    "local_diversity",
)  # fmt: skip


def section(title: str, lead: str, body: str) -> str:
    """Return a section of the page; `lead` and `body` are HTML."""
    lead = f'<p class="lead">{lead}</p>' if lead else ""
    return f"<section><h2>{title}</h2>{lead}{body}</section>"


def number(value: float) -> str:
    """Format a value with about three significant digits."""
    size = abs(value)
    if size < 1e-6:
        return "0"
    if size >= 1000:
        return f"{value:,.0f}".replace(",", "\u202f")
    if size >= 100:
        return f"{value:.0f}"
    if size >= 10:
        return f"{value:.1f}"
    if size >= 0.1:
        return f"{value:.2f}"
    return f"{value:.2g}"


def figures(evaluation: Evaluation) -> str:
    """Return the table of all metrics of all models, with recordings and chance levels."""
    models = evaluation.models
    head = "".join(
        f'<th class="number"><span class="dot" style="background:{colour(i)}"></span>'
        f"{html.escape(model.label)}</th>"
        for i, model in enumerate(models)
    )
    rows = []
    for group in GROUPS:
        definitions = [d for d in evaluation.definitions() if d.group == group]
        if definitions:
            span = 3 + len(models)
            rows.append(f'<tr><th class="group" colspan="{span}">{group}</th></tr>')
        for definition in definitions:
            key = definition.key
            cells = [_figure_cell(m.figures.get(key), definition, models) for m in models]
            cells.append(_recording_cell(models, key))
            rows.append(f"<tr>{_measure_cells(definition)}{''.join(cells)}</tr>")
    lead = (
        "Mean over recordings; below it the 95 % bootstrap interval and the number of clips (of "
        "windows or 10 s clips for Fréchet distances). "
        "↑ higher is better, ↓ lower is better, ≈ as the recording is best. Chance is the same "
        "motion's value with its sound shifted, or with other recordings: only a value above it "
        "is informative."
    )
    return section(
        "Figures",
        lead,
        f'<div class="scroll"><table><thead><tr><th>Measure</th><th></th>{head}'
        f'<th class="number">Recording</th></tr></thead><tbody>{"".join(rows)}</tbody></table>'
        "</div>",
    )


def has_samples(evaluation: Evaluation) -> bool:
    """True if a recording has several samples, so that means over samples are defined."""
    return evaluation.protocol == "multires" or any(
        interval.n > 1
        for model in evaluation.models
        for found in model.by_recording.values()
        for interval in found.values()
    )


def _measure_cells(definition: Definition) -> str:
    arrow, meaning = _ARROWS[definition.better]
    unit = f", {definition.unit}" if definition.unit else ""
    bound = ' class="bound"' if definition.fps_bound else ""
    return (
        f"<th>{html.escape(definition.name + unit)}"
        f"<small{bound}>{html.escape(definition.variant)}</small></th>"
        f'<td title="{meaning}">{arrow}</td>'
    )


def _figure_cell(
    figure: MetricResult | None, definition: Definition, models: list[ModelResult]
) -> str:
    if figure is None:
        return '<td class="number">–<small>not measured</small></td>'
    best = " class=best" if len(models) > 1 and _is_best(figure, definition, models) else ""
    below = [_bounds(figure.interval)]
    if figure.chance is not None:
        below.append(f"chance {number(figure.chance)}")
    if figure.mismatched is not None:
        below.append(f"other recordings {number(figure.mismatched)}")
    if figure.note:
        below.append(figure.note)
    small = "".join(f"<small>{html.escape(line)}</small>" for line in below)
    return f'<td class="number"><span{best}>{number(figure.interval.value)}</span>{small}</td>'


def _bounds(interval: Interval) -> str:
    n = f"n = {interval.n}"
    if interval.low is None or interval.high is None:
        return n
    return f"{number(interval.low)} … {number(interval.high)}, {n}"


def _is_best(figure: MetricResult, definition: Definition, models: list[ModelResult]) -> bool:
    def badness(one: MetricResult) -> float:
        value = one.interval.value
        if definition.better == "reference":
            return abs(value - one.recording) if one.recording is not None else 0.0
        return value if definition.better == "lower" else -value

    every = [m.figures[figure.key] for m in models if figure.key in m.figures]
    values = [badness(one) for one in every]
    return badness(figure) == min(values) and max(values) > min(values)


def _recording_cell(models: list[ModelResult], key: str) -> str:
    """Return the cell of the recordings' value, from the first model that has one."""
    for model in models:
        figure = model.figures.get(key)
        if figure is not None and figure.recording is not None:
            return f'<td class="number">{number(figure.recording)}</td>'
    return "<td></td>"


def recordings(evaluation: Evaluation) -> str:
    """Return the table of patch metrics for each recording: means over samples (eq. 18)."""
    models = [model for model in evaluation.models if model.by_recording]
    stems = sorted({stem for model in models for stem in model.by_recording})
    definitions = [d for d in evaluation.definitions() if d.group == PATCHES]
    definitions = [
        d for d in definitions if any(d.key in f for m in models for f in m.by_recording.values())
    ]
    if not models or not has_samples(evaluation):
        return ""
    head = "".join(
        f'<th class="number">{html.escape(d.name)}{", %" if d.unit else ""}</th>'
        for d in definitions
    )
    rows = []
    for stem in stems:
        for model in models:
            index = evaluation.models.index(model)
            found = model.by_recording.get(stem, {})
            cells = "".join(
                f'<td class="number">{number(found[d.key].value)}'
                f"<small>{_bounds(found[d.key])}</small></td>"
                if d.key in found
                else "<td></td>"
                for d in definitions
            )
            rows.append(
                f"<tr><th>{html.escape(stem)}</th>"
                f'<td><span class="dot" style="background:{colour(index)}"></span>'
                f"{html.escape(model.label)}</td>{cells}</tr>"
            )
    return section(
        "Recording by recording",
        "Expectation over the samples of each recording (eq. 18 of Moreno-Villamarín et al. "
        "2024), with the 95 % interval over samples.",
        f"<details{' open' if len(rows) <= 24 else ''}><summary>"
        f"{counted(len(rows), 'row')}</summary>"
        f'<div class="scroll"><table><thead><tr><th>Recording</th><th>Model</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div></details>",
    )


def per_clip(evaluation: Evaluation) -> str:
    """Return the table of all clips."""
    definitions = [d for d in evaluation.definitions() if d.key in _PER_CLIP]
    head = "".join(
        f'<th class="number">{html.escape(d.name)}'
        f"{f'<small>{html.escape(d.unit)}</small>' if d.unit else ''}</th>"
        for d in definitions
    )
    rows = []
    for index, model in enumerate(evaluation.models):
        for clip in model.clips[:_MOST_CLIPS]:
            cells = "".join(
                f'<td class="number">{number(clip.figures[d.key])}'
                + (
                    f"<small>{number(clip.recording[d.key])} rec.</small>"
                    if d.key in clip.recording
                    else ""
                )
                + "</td>"
                if d.key in clip.figures
                else "<td></td>"
                for d in definitions
            )
            notes = f"<small>{html.escape('; '.join(clip.notes))}</small>" if clip.notes else ""
            rows.append(
                f'<tr><th><span class="dot" style="background:{colour(index)}"></span>'
                f"{html.escape(clip.pair.name)}{notes}</th>"
                f'<td class="number">{clip.seconds:.1f} s</td>{cells}</tr>'
            )
    lead = "Each clip's own figures; 'rec.' is what its recording has. The JSON holds all of them."
    return section(
        "Clip by clip",
        lead,
        f"<details{' open' if len(rows) <= 12 else ''}><summary>"
        f"{counted(len(rows), 'clip')}</summary>"
        f'<div class="scroll"><table><thead><tr><th>Clip</th><th></th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div></details>",
    )


def excluded(evaluation: Evaluation) -> str:
    """Return the table of clips and metrics left out, with reasons."""
    rows = "".join(
        f"<tr><th>{html.escape(item.name)}</th><td>{html.escape(model.label)}</td>"
        f"<td>{html.escape(item.what)}</td><td>{html.escape(item.reason)}</td></tr>"
        for model in evaluation.models
        for item in model.excluded
    )
    if not rows:
        return section("Left out", "Nothing: every metric was computed for every clip.", "")
    return section(
        "Left out, and why",
        "",
        '<div class="scroll"><table><thead><tr><th>Clip</th><th>Model</th><th>What</th>'
        f"<th>Reason</th></tr></thead><tbody>{rows}</tbody></table></div>",
    )
