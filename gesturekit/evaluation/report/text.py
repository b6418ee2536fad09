"""Results as text: answers and tables for the terminal, and the table as CSV, Markdown, LaTeX."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.report.rows import (
    Row,
    interval_warnings,
    level_in_words,
    number,
    rows_by_group,
    spread_in_words,
)
from gesturekit.evaluation.results import (
    NOT_ASKED,
    Evaluation,
    MetricAgreement,
    MetricResult,
    QuestionAgreement,
)
from gesturekit.evaluation.statistics.agreement import conclusion
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
_COMPARED = ("fps", "protocol")


def headline_lines(evaluation: Evaluation) -> list[str]:
    """Return the answers to the three questions as lines of text, model by model."""
    lines = []
    for model in evaluation.models:
        named = f"{model.label}: " if len(evaluation.models) > 1 else ""
        for answer in model.answers:
            result = None if answer.state == NOT_ASKED else model.metrics.get(answer.key)
            value = _score_in_words(result) if result is not None and result.informative else ""
            lines.append(f"{named}{answer.question} {answer.sentence}{value}")
    return lines


def _score_in_words(result: MetricResult) -> str:
    """Return a score with its interval, floors and ceiling, in brackets."""
    floors = ", ".join(map(level_in_words, result.floors))
    parts = [number(result.interval.value), spread_in_words(result.interval)]
    parts += [f"floor: {floors}"] if floors else []
    parts += [f"ceiling: {level_in_words(result.ceiling)}"] if result.ceiling else []
    return f" ({'; '.join(parts)})"


def terminal_lines(evaluation: Evaluation) -> list[str]:
    """Return the three questions and the table for a terminal.

    The table is in groups: direction, values, recording and chance.
    """
    groups = rows_by_group(evaluation)
    labels = [printable(model.heading) for model in evaluation.models]
    table = [["", "", *labels, "recording", "chance"]]
    for group, rows in groups.items():
        table.append([f"{group}:"])
        for name, *cells in (row.cells("*{}".format) for row in rows):
            table.append([f"  {name}", *cells])
    bare = _without_interval(evaluation, [row for rows in groups.values() for row in rows])
    return [*headline_lines(evaluation), *aligned(table), evaluation.basis, *bare]


def aligned(table: list[list[str]]) -> Iterator[str]:
    """Yield the rows of a table with columns of equal width; rows of one cell may run on."""
    from tqdm.utils import disp_len  # wide characters, as in Chinese names, take two columns

    whole = [row for row in table if len(row) > 1]
    widths = [max(map(disp_len, column)) for column in zip(*whole, strict=True)]
    for row in table:
        yield "  ".join(cell + " " * (w - disp_len(cell)) for cell, w in zip(row, widths)).rstrip()


def _without_interval(evaluation: Evaluation, rows: list[Row]) -> list[str]:
    """Return a line that names the metrics without an interval, when others have one."""
    bare = [
        row.definition.name
        for row in rows
        if any(f.interval.low is None and f.informative for f in row.known)
    ]
    if not bare or len(bare) == len(rows) or any(interval_warnings(evaluation)):
        return []
    return [
        f"No interval, and never bold: {', '.join(bare)}: one value of the whole set of clips, "
        "from too few takes, or at the bound of its range."
    ]


def note_lines(evaluation: Evaluation) -> Iterator[str]:
    """Yield notes on the metrics; metrics left out for the same reason share a line."""
    yield from (f"Warning: {warning}." for warning in interval_warnings(evaluation))
    if evaluation.agreement is not None:
        yield from (f"Note: study: {note}" for note in evaluation.agreement.notes)
    for model in evaluation.models:
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


def summary_line(evaluation: Evaluation, report: Path | None) -> str:
    """Return the last line: how many clips were measured, and where all results are."""
    clips = sum(len(model.clips) for model in evaluation.models)
    left_out = sum(item.what == "clip" for model in evaluation.models for item in model.excluded)
    where = f"; all of it in {report}" if report else "; --out report.html shows each"
    return f"{counted(clips, 'clip')} measured, {left_out} left out{where}"


def agreement_lines(evaluation: Evaluation) -> list[str]:
    """Return the agreement with a study as lines; none without a study."""
    agreement = evaluation.agreement
    questions = () if agreement is None else agreement.questions
    return [line for question in questions for line in _agreement(question)]


def _agreement(found: QuestionAgreement) -> Iterator[str]:
    """Yield the table of one question of a study, after an empty line."""
    order = sorted(found.scores, key=lambda name: -found.scores[name])
    scores = ", ".join(f"{printable(name)} {found.scores[name]:+.3g}" for name in order)
    question = f" on {printable(found.question)}" if found.question else ""
    yield from (
        "",
        f"Agreement with people{question}: {counted(found.raters, 'rater')}, "
        f"{counted(found.clips, 'clip')}, {counted(found.ratings, 'rating')}.",
        f"People's scores: {scores}.",
    )
    if not found.metrics:
        yield "No metric can be compared: the values, or people's scores, are all equal."
        return
    for n, chance in sorted({(one.n, one.chance) for one in found.metrics}, reverse=True):
        yield (
            f"Chance, {n} systems: 95 % of random orders have a tau between {-chance:+.2f} and "
            f"{chance:+.2f}; pairwise accuracy 50 %."
            + ("" if chance < 1 else " These are too few systems: any order may be chance.")
        )
    yield conclusion(found)
    head = ["  Metric", "Kendall's tau [95 %]", "without recordings", "p (Holm)"]
    head += ["Spearman's rho", "pairs in order", "systems"]
    yield from aligned([head, *map(_agreement_row, found.metrics)])


def _agreement_row(metric: MetricAgreement) -> list[str]:
    """Return the cells of one metric's agreement with people."""
    interval = "" if metric.low is None else f" [{metric.low:+.2f}, {metric.high:+.2f}]"
    p = "" if metric.p_holm is None else f"{metric.p_holm:.3f}"
    pairs = "none differ" if metric.accuracy is None else f"{metric.accuracy:.0%} of {metric.pairs}"
    return [
        f"  {DEFINITIONS[metric.key].name}",
        f"{metric.kendall:+.2f}{interval}",
        "" if metric.of_models is None else f"{metric.of_models:+.2f}",
        p if metric.informative else "not informative",
        f"{metric.spearman:+.2f}",
        pairs,
        str(metric.n),
    ]


def differences(evaluation: Evaluation, before: Mapping[str, Any]) -> Iterator[str]:
    """Yield the differences of an evaluation from earlier results, a line each.

    Models are compared by label; where both have only one, these are compared. A change outside the
    earlier interval is marked.

    Args:
        evaluation: the results of now.
        before: see `gesturekit.evaluation.results.read_results`.
    """
    after = evaluation.to_json()
    for name in _COMPARED:
        if after[name] != before.get(name):
            yield f"{name}: {before.get(name)} before, {after[name]} now: not comparable"
    old, new = (
        {str(model["label"]): model["figures"] for model in values["models"]}
        for values in (before, after)
    )
    if len(old) == len(new) == 1:
        old = dict(zip(new, old.values(), strict=True))
    for label in [*new, *(name for name in old if name not in new)]:
        if label not in old or label not in new:
            yield f"{label}: only {'now' if label in new else 'before'}"
            continue
        lines = list(_changed_values(old[label], new[label]))
        yield f"{label}: {f'{len(lines)} of {len(new[label])} values differ' if lines else 'equal'}"
        yield from lines


def _changed_values(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each value of a model that differs, is new or is gone."""
    for key in [*new, *(key for key in old if key not in new)]:
        name = DEFINITIONS[key].name if key in DEFINITIONS else key
        if key not in old or key not in new:
            yield f"  {name}: only {'now' if key in new else 'before'}"
            continue
        was, now = float(old[key]["value"]), float(new[key]["value"])
        if number(was) == number(now):
            continue
        low, high = old[key].get("low"), old[key].get("high")
        outside = low is not None and high is not None and not low <= now <= high
        unit = f" {new[key]['unit']}" if new[key]["unit"] else ""
        mark = ", outside the earlier interval" if outside else ""
        yield f"  {name}: {number(was)} before, {number(now)}{unit} now{mark}"


def markdown(evaluation: Evaluation) -> str:
    """Return the table in Markdown, one heading line a group."""
    labels = [_markdown(model.heading) for model in evaluation.models]
    head = ["Metric", "", *labels, "Recording", "Chance"]
    lines = [f"| {' | '.join(head)} |", f"|---|---|{'---:|' * (len(head) - 2)}"]
    for group, rows in rows_by_group(evaluation).items():
        lines.append(f"| **{group}** |{' |' * (len(head) - 1)}")
        for name, *cells in (row.cells("**{}**".format) for row in rows):
            lines.append(f"| {' | '.join((_markdown(name), *cells))} |")
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
    for group, rows in rows_by_group(evaluation).items():
        lines += [r"\midrule", rf"\multicolumn{{{width}}}{{l}}{{\textit{{{_latex(group)}}}}} \\"]
        for name, *cells in (row.cells(r"\textbf{{{}}}".format, _latex) for row in rows):
            lines.append(" & ".join([_latex(name), *cells]) + r" \\")
    return "\n".join((*lines, r"\bottomrule", r"\end{tabular}", ""))


def csv_text(evaluation: Evaluation) -> str:
    """Return one line for each model and metric, with `CSV_COLUMNS` and all digits."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CSV_COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in (row for rows in rows_by_group(evaluation).values() for row in rows):
        for i, result in enumerate(row.results):
            if result is not None:
                decided = {"best": i == row.best, "p": row.contest and row.contest.p}
                label = {"model": evaluation.models[i].label}
                writer.writerow(label | row.definition.to_json() | result.to_json() | decided)
    return text.getvalue()


def report_lines(evaluation: Evaluation) -> list[str]:
    """Return the verdicts and all tables for a terminal."""
    return [*evaluation.verdicts(), *terminal_lines(evaluation), *agreement_lines(evaluation)]


WRITERS: Mapping[str, Callable[[Evaluation], str]] = {
    "json": Evaluation.json_text,
    "csv": csv_text,
    "markdown": markdown,
    "latex": latex,
}
"""Functions that return all results (json), or the table, as text, by name of the form."""


def _caption(evaluation: Evaluation) -> str:
    return (
        f"{evaluation.basis} Mean and 95 % interval over takes. Bold: nearer to the recordings' "
        "own value than every other model (paired over takes, Holm over rows). "
        "Metrics of the whole set of clips have one value without an interval, never bold. "
        "No arrow: a model is beyond the recordings' own value, which is the goal."
    )


def _markdown(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|#])", r"\\\1", _one_line(text))


def _latex(text: str) -> str:
    return "".join(_LATEX.get(sign, sign) for sign in _one_line(text))


def _one_line(text: str) -> str:
    return "".join(sign if sign.isprintable() or sign == "\u202f" else " " for sign in text)
