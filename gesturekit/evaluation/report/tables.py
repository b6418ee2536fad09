"""The report's tables, as HTML."""

from __future__ import annotations

import html
from collections.abc import Mapping

from gesturekit.evaluation.definitions import (
    FRECHET,
    GROUPS,
    HEADLINE,
    PATCHES,
    SPEECH,
    Definition,
)
from gesturekit.evaluation.report.plots import colour
from gesturekit.evaluation.results import Evaluation, Interval, MetricResult, ModelResult
from gesturekit.evaluation.statistics.paired import Contest
from gesturekit.viewer.pages import section, table
from gesturekit.wording import counted

ARROWS = {
    "higher": ("↑", "higher is nearer to the recordings' own value"),
    "lower": ("↓", "lower is nearer to the recordings' own value"),
    "reference": ("", "the recordings' own value is the goal"),
}
_OPEN = (HEADLINE, SPEECH, PATCHES, FRECHET)  # groups of the papers' tables; the rest is folded
_MOST_CLIPS = 300


def dotted(index: int, name: str) -> str:
    """Return the name of a model, or of its clip, behind a dot of the model's colour."""
    return f'<span class="dot" style="background:{colour(index)}"></span>{html.escape(name)}'


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


def metrics(evaluation: Evaluation, contests: Mapping[str, Contest]) -> str:
    """Return the tables of all metrics of all models, group by group, with the recordings' own.

    Args:
        evaluation: the result of `evaluate`.
        contests: {key: its row's order and bold}.
    """
    models = evaluation.models
    head = "".join(
        f'<th class="number">{dotted(i, model.heading)}</th>' for i, model in enumerate(models)
    )
    head += '<th class="number">Recordings</th>'
    groups = []
    for group in GROUPS:
        rows = []
        for definition in (d for d in evaluation.definitions() if d.group == group):
            key = definition.key
            row = contests.get(key)
            shared = _shared_remarks(models, key)
            cells = [_metric_cell(model, key, row, shared) for model in models]
            cells.append(_recording_cell(models, key))
            rows.append(f"<tr>{_measure_cells(definition, row, shared)}{''.join(cells)}</tr>")
        if rows:
            groups.append(
                f"<details{' open' if group in _OPEN else ''}><summary>{group}</summary>"
                + table(f"<th>Measure</th><th></th>{head}", "".join(rows))
                + f"<p><small>{html.escape(evaluation.basis)}</small></p></details>"
            )
    lead = (
        "Mean over takes; below it the 95 % interval over takes (over windows or 10 s clips for "
        "Fréchet distances) and, below the name of the metric, what the values of all models rest "
        "on. The recordings are measured as well: where a metric compares with recordings, another "
        "one, or one half against the other. Their own value is the goal: an arrow says where it "
        "lies, unless a model is beyond it. Bold: nearer to it than every other model by more than "
        "chance (paired over recordings, Holm over all rows), and above chance. Metrics of a whole "
        "set have one value: many have no interval, and none is ever bold. Chance is the same "
        "motion's value with its sound shifted, or with other recordings."
    )
    return section("Figures", lead, "".join(groups))


def has_samples(evaluation: Evaluation) -> bool:
    """True if a recording has several samples, so that means over samples are defined."""
    return evaluation.protocol == "multires" or any(
        interval.n > 1
        for model in evaluation.models
        for found in model.by_recording.values()
        for interval in found.values()
    )


def _remarks(result: MetricResult) -> list[str]:
    """Return what is to be known about a value: how informative it is, its basis, and its note."""
    informative = "" if result.informative else "not informative here"
    bare = "no interval" if result.interval.low is None else ""
    return list(filter(None, (informative, bare, result.interval.count, result.note)))


def _shared_remarks(models: list[ModelResult], key: str) -> list[str]:
    """Return the remarks on a metric that hold for every model; they stand once, at its name."""
    first, *others = [_remarks(m.metrics[key]) for m in models if key in m.metrics]
    return [remark for remark in first if all(remark in other for other in others)]


def _measure_cells(definition: Definition, row: Contest | None, shared: list[str]) -> str:
    arrow, meaning = ARROWS[definition.better if row is None else row.direction]
    bound = ' class="bound"' if definition.fps_bound else ""
    return (
        f"<th>{html.escape(definition.title)}"
        f"<small{bound}>{html.escape(definition.variant)}</small>{_small(shared)}</th>"
        f'<td title="{meaning}">{arrow}</td>'
    )


def _small(lines: list[str]) -> str:
    return "".join(f"<small>{html.escape(line)}</small>" for line in lines)


def _metric_cell(model: ModelResult, key: str, row: Contest | None, shared: list[str]) -> str:
    result = model.metrics.get(key)
    if result is None:
        return '<td class="number">–<small>not measured</small></td>'
    best = " class=best" if row is not None and row.best == model.label else ""
    below = [_bounds(result.interval)]
    if result.chance is not None:
        below.append(f"chance {number(result.chance)}")
    if result.mismatched is not None:
        below.append(f"with other recordings {number(result.mismatched)}")
    below += [remark for remark in _remarks(result) if remark not in shared]
    value = f"<span{best}>{number(result.interval.value)}</span>"
    return f'<td class="number">{value}{_small(list(filter(None, below)))}</td>'


def _bounds(interval: Interval) -> str:
    if interval.low is None or interval.high is None:
        return ""
    return f"{number(interval.low)} … {number(interval.high)}"


def _recording_cell(models: list[ModelResult], key: str) -> str:
    """Return the cell of the recordings' value, from the first model that has one."""
    for model in models:
        result = model.metrics.get(key)
        if result is not None and result.recording is not None:
            own = result.recording_interval
            bounds = [_bounds(own)] if own is not None and own.low is not None else []
            return f'<td class="number">{number(result.recording)}{_small(bounds)}</td>'
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
                f"{_small([_bounds(found[d.key]), found[d.key].count])}</td>"
                if d.key in found
                else "<td></td>"
                for d in definitions
            )
            rows.append(
                f"<tr><th>{html.escape(stem)}</th><td>{dotted(index, model.label)}</td>{cells}</tr>"
            )
    return section(
        "Recording by recording",
        "Expectation over the samples of each recording (eq. 18 of Moreno-Villamarín et al. "
        "2024), with the 95 % interval over samples.",
        f"<details{' open' if len(rows) <= 24 else ''}><summary>"
        f"{counted(len(rows), 'row')}</summary>"
        f"{table(f'<th>Recording</th><th>Model</th>{head}', ''.join(rows))}</details>",
    )


def per_clip(evaluation: Evaluation) -> str:
    """Return the table of all clips."""
    definitions = [d for d in evaluation.definitions() if "clips" in d.shown]
    head = "".join(
        f'<th class="number">{html.escape(d.name)}'
        f"{f'<small>{html.escape(d.unit)}</small>' if d.unit else ''}</th>"
        for d in definitions
    )
    rows = []
    for index, model in enumerate(evaluation.models):
        for clip in model.clips[:_MOST_CLIPS]:
            cells = "".join(
                f'<td class="number">{number(clip.metrics[d.key])}'
                + (
                    f"<small>{number(clip.recording[d.key])} rec.</small>"
                    if d.key in clip.recording
                    else ""
                )
                + "</td>"
                if d.key in clip.metrics
                else "<td></td>"
                for d in definitions
            )
            notes = f"<small>{html.escape('; '.join(clip.notes))}</small>" if clip.notes else ""
            rows.append(
                f"<tr><th>{dotted(index, clip.pair.name)}{notes}</th>"
                f'<td class="number">{clip.seconds:.1f} s</td>{cells}</tr>'
            )
    lead = "Each clip's own figures; 'rec.' is what its recording has. The JSON holds all of them."
    return section(
        "Clip by clip",
        lead,
        f"<details{' open' if len(rows) <= 12 else ''}><summary>"
        f"{counted(len(rows), 'clip')}</summary>"
        f"{table(f'<th>Clip</th><th></th>{head}', ''.join(rows))}</details>",
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
    head = "<th>Clip</th><th>Model</th><th>What</th><th>Reason</th>"
    return section("Left out, and why", "", table(head, rows))
