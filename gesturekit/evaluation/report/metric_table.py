"""The table of all metrics as text: for the terminal, CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from audio_features.atomic import write_text
from gesturekit.evaluation.definitions import GROUPS, Definition
from gesturekit.evaluation.report.headline import headline_lines, interval_warnings
from gesturekit.evaluation.report.tables import ARROWS, number
from gesturekit.evaluation.results import Evaluation, MetricResult
from gesturekit.evaluation.statistics.paired import Contest, contests
from gesturekit.wording import counted, listed, printable

CSV_COLUMNS = (
    "model", "key", "name", "group", "unit", "better", "value", "low", "high", "n", "units", "over",
    "recording", "recording_low", "recording_high", "chance", "mismatched", "informative", "best",
    "p", "note",
)  # fmt: skip

_LATEX = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "≈": r"$\approx$",
    "²": r"$^2$",
    "³": r"$^3$",
    "–": "--",
    "−": r"$-$",
    "\u202f": r"\,",
}


@dataclass(frozen=True)
class Row:
    """A metric: its result for each model, None where it was not measured.

    Attributes:
        definition: of the metric.
        metrics: results of each model.
        contest: order and bold of the models; None without a value of the recordings.
        best: index of the model whose value is bold, or None.
    """

    definition: Definition
    metrics: tuple[MetricResult | None, ...]
    contest: Contest | None = None
    best: int | None = None

    @property
    def name(self) -> str:
        """Name and unit."""
        return self.definition.title

    @property
    def arrow(self) -> str:
        """Sign of the better direction; none where a model is beyond the recordings' own."""
        return ARROWS["reference" if self.contest is None else self.contest.direction][0]

    def cells(self, best: Callable[[str], str]) -> list[str]:
        """Return the models' values as text; `best` marks the one that is bold."""
        return [
            best(text) if i == self.best else text
            for i, text in enumerate(map(_value_text, self.metrics))
        ]

    @property
    def recording(self) -> str:
        """The recordings' own value; "" if it has none."""
        values = (result.recording for result in self.metrics if result is not None)
        return next((number(value) for value in values if value is not None), "")

    @property
    def chance(self) -> str:
        """The higher one of the chance level and that of other recordings, of the first model."""
        known = [f for f in self.metrics if f is not None]
        levels = [v for f in known[:1] for v in (f.chance, f.mismatched) if v is not None]
        return number(max(levels)) if levels else ""


def rows_by_group(evaluation: Evaluation) -> Iterator[tuple[str, list[Row]]]:
    """Yield each group of metrics that has any, with its rows."""
    found = contests(evaluation.models)
    labels = [model.label for model in evaluation.models]
    for group in GROUPS:
        rows = []
        for d in (d for d in evaluation.definitions() if d.group == group):
            metrics = tuple(model.metrics.get(d.key) for model in evaluation.models)
            contest = found.get(d.key)
            best = None if contest is None or contest.best is None else labels.index(contest.best)
            rows.append(Row(d, metrics, contest, best))
        if rows:
            yield group, rows


def terminal_lines(evaluation: Evaluation) -> list[str]:
    """Return the three questions and the table for a terminal.

    The table is in groups: direction, values, recording and chance.
    """
    from tqdm.utils import disp_len

    labels = [printable(model.heading) for model in evaluation.models]
    table: list[list[str]] = [["", "", *labels, "recording", "chance"]]
    for group, rows in rows_by_group(evaluation):
        table.append([f"{group}:"])
        table += [
            [f"  {row.name}", row.arrow, *row.cells(_starred), row.recording, row.chance]
            for row in rows
        ]
    # Wide characters, as in Chinese names, take two columns; headings of groups may run on.
    whole = [row for row in table if len(row) > 1]
    widths = [max(disp_len(row[i]) for row in whole) for i in range(len(table[0]))]
    lines = [
        "  ".join(cell + " " * (w - disp_len(cell)) for cell, w in zip(row, widths)).rstrip()
        for row in table
    ]
    basis = evaluation.basis
    return [*headline_lines(evaluation), *lines, basis, *_without_interval(evaluation)]


def _without_interval(evaluation: Evaluation) -> list[str]:
    """Return a line that names the metrics without an interval, when others have one."""
    rows = [row for _, rows in rows_by_group(evaluation) for row in rows]
    bare = [
        row.definition.name
        for row in rows
        if any(f is not None and f.interval.low is None and f.informative for f in row.metrics)
    ]
    if not bare or len(bare) == len(rows) or any(interval_warnings(evaluation)):
        return []
    return [
        f"No interval, and never bold: {', '.join(bare)}: one value of the whole set of clips, "
        "from too few takes, or at the bound of its range."
    ]


def note_lines(found: Evaluation) -> Iterator[str]:
    """Yield notes on the metrics; metrics left out for the same reason share a line."""
    yield from (f"Warning: {warning}." for warning in interval_warnings(found))
    if found.agreement is not None:
        yield from (f"Note: study: {note}" for note in found.agreement.notes)
    for model in found.models:
        yield from (f"Note: {model.label}: {note}" for note in model.notes)
        metrics: dict[str, tuple[list[str], list[str]]] = {}
        for item in model.excluded:
            if item.what == "clip":
                yield f"Left out: {model.label}: {item.name}: clip: {item.reason}"
                continue
            names, left_out = metrics.setdefault(item.reason, ([], []))
            names.append(item.name)
            left_out.append(item.what)
        for reason, (names, left_out) in metrics.items():
            what, of = ", ".join(dict.fromkeys(left_out)), listed(list(dict.fromkeys(names)), 3)
            yield f"Left out: {model.label}: {of}: {what}: {reason}"


def summary_line(found: Evaluation, report: Path | None) -> str:
    """Return the last line: how many clips were measured, and where all results are."""
    clips = sum(len(model.clips) for model in found.models)
    left_out = sum(item.what == "clip" for model in found.models for item in model.excluded)
    where = f"; all of it in {report}" if report else "; --out report.html shows each"
    return f"{counted(clips, 'clip')} measured, {left_out} left out{where}"


def markdown(evaluation: Evaluation) -> str:
    """Return the table in Markdown, one heading line a group."""
    labels = [_markdown(model.heading) for model in evaluation.models]
    head = ["Metric", "", *labels, "Recording", "Chance"]
    lines = [f"| {' | '.join(head)} |", f"|---|---|{'---:|' * (len(head) - 2)}"]
    for group, rows in rows_by_group(evaluation):
        lines.append(f"| **{group}** |{' |' * (len(head) - 1)}")
        for row in rows:
            cells = [_markdown(row.name), row.arrow, *row.cells("**{}**".format)]
            lines.append(f"| {' | '.join((*cells, row.recording, row.chance))} |")
    return "\n".join((*lines, "", _caption(evaluation), ""))


def latex(evaluation: Evaluation) -> str:
    """Return the table in LaTeX (booktabs), without a float around it."""
    labels = [_latex(model.heading) for model in evaluation.models]
    width = len(labels) + 4
    lines = [
        f"% {_latex(_caption(evaluation))}",
        rf"\begin{{tabular}}{{ll{'r' * (width - 2)}}}",
        r"\toprule",
        " & ".join(["Metric", "", *labels, "Recording", "Chance"]) + r" \\",
    ]
    for group, rows in rows_by_group(evaluation):
        lines += [r"\midrule", rf"\multicolumn{{{width}}}{{l}}{{\textit{{{_latex(group)}}}}} \\"]
        for row in rows:
            cells = [row.name, row.arrow, *map(_value_text, row.metrics), row.recording, row.chance]
            cells = [_latex(cell) for cell in cells]
            if row.best is not None:
                cells[2 + row.best] = rf"\textbf{{{cells[2 + row.best]}}}"
            lines.append(" & ".join(cells) + r" \\")
    return "\n".join((*lines, r"\bottomrule", r"\end{tabular}", ""))


def csv_text(evaluation: Evaluation) -> str:
    """Return one line for each model and metric, with `CSV_COLUMNS` and all digits."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CSV_COLUMNS, lineterminator="\n")
    writer.writeheader()
    for group, rows in rows_by_group(evaluation):
        for row in rows:
            for model, result in zip(evaluation.models, row.metrics):
                if result is None:
                    continue
                definition, interval = row.definition, result.interval
                values = {
                    "model": model.label,
                    "group": group,
                    **{k: getattr(definition, k) for k in ("key", "name", "unit", "better")},
                    **{k: getattr(interval, k) for k in ("value", "low", "high")},
                    **{k: getattr(interval, k) for k in ("n", "units", "over")},
                    **{k: getattr(result, k) for k in ("recording", "chance", "mismatched")},
                    "recording_low": result.recording_interval and result.recording_interval.low,
                    "recording_high": result.recording_interval and result.recording_interval.high,
                    "informative": result.informative,
                    "best": row.contest is not None and row.contest.best == model.label,
                    "p": row.contest and row.contest.p,
                    "note": result.note,
                }
                writer.writerow({k: "" if v is None else v for k, v in values.items()})
    return text.getvalue()


WRITERS: Mapping[str, Callable[[Evaluation], str]] = {
    "csv": csv_text,
    "markdown": markdown,
    "latex": latex,
}
"""Functions that return the table as text, by name of the form."""


def write_table(evaluation: Evaluation, path: str | os.PathLike[str], form: str) -> None:
    """Write the table of all metrics to a file; `form` is a name in `WRITERS`."""
    write_text(path, WRITERS[form](evaluation))


def _value_text(result: MetricResult | None) -> str:
    if result is None:
        return "–"
    interval = result.interval
    if not result.informative:
        return f"{number(interval.value)} (not informative)"
    if interval.low is None or interval.high is None:
        return number(interval.value)
    return f"{number(interval.value)} [{number(interval.low)}, {number(interval.high)}]"


def _caption(evaluation: Evaluation) -> str:
    return (
        f"{evaluation.basis} Mean and 95 % interval over takes. Bold: nearer to the recordings' "
        "own value than every other model (paired over takes, Holm over rows). "
        "Metrics of the whole set of clips have one value without an interval, never bold. "
        "No arrow: a model is beyond the recordings' own value, which is the goal."
    )


def _starred(text: str) -> str:
    return f"*{text}"


def _markdown(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|#])", r"\\\1", _one_line(text))


def _latex(text: str) -> str:
    return "".join(_LATEX.get(sign, sign) for sign in _one_line(text))


def _one_line(text: str) -> str:
    return "".join(sign if sign.isprintable() or sign == "\u202f" else " " for sign in text)
