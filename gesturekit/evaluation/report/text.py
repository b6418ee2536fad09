"""Results as text: values and rows in words, tables for the terminal, CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jinja2

from gesturekit.evaluation.definitions import DEFINITIONS, GROUPS
from gesturekit.evaluation.pairs import grouped
from gesturekit.evaluation.results import (
    NOT_ASKED,
    Evaluation,
    Interval,
    Level,
    MetricAgreement,
    MetricResult,
)
from gesturekit.evaluation.statistics.agreement import conclusion
from gesturekit.evaluation.statistics.intervals import Takes
from gesturekit.evaluation.statistics.model_metrics import level_name
from gesturekit.evaluation.statistics.paired import Row, contests
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
_PAGE = Path(__file__).parent / "page"


ARROWS = {
    "higher": ("↑", "higher is nearer to the recordings' own value"),
    "lower": ("↓", "lower is nearer to the recordings' own value"),
    "reference": ("", "the recordings' own value is the goal"),
}
"""Sign and meaning of the better direction."""


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
    return f"{value:.2f}" if size >= 0.1 else f"{value:.2g}"


def bounds(interval: Interval | None, form: str = "{} … {}") -> str:
    """Return the bounds of an interval as text; "" without an interval."""
    if interval is None or interval.low is None or interval.high is None:
        return ""
    return form.format(number(interval.low), number(interval.high))


def spread_in_words(interval: Interval) -> str:
    """Return an interval in words, such as "95 % interval 0.4 to 0.6"."""
    return bounds(interval, "95 % interval {} to {}") or "no interval"


def value_text(result: MetricResult | None) -> str:
    """Return a value with its interval, such as "0.50 [0.40, 0.60]"."""
    if result is None:
        return "–"
    if not result.informative:
        return f"{number(result.interval.value)} (not informative)"
    return number(result.interval.value) + bounds(result.interval, " [{}, {}]")


def level_in_words(level: Level) -> str:
    """Return a level in words, such as "another speaker 0.41 ± 0.06 (4 takes)"."""
    spread = "" if level.spread is None else f" ± {number(level.spread)}"
    unit = "piece" if level.pieces else "take"
    count = f" ({level.n} {unit}{'s' if level.n > 1 else ''})" if level.n else ""
    return f"{level_name(level)} {number(level.value)}{spread}{count}"


def shared_remarks(row: Row) -> list[str]:
    """Return the remarks that hold for every model; they stand once, at the name of the metric."""
    first, *others = map(remarks, row.known)
    return [remark for remark in first if all(remark in other for other in others)]


def cells(
    evaluation: Evaluation, row: Row, best: str, escaped: Callable[[str], str] = str
) -> list[str]:
    """Return name, direction, the models' values, that of the recordings, and chance as text.

    Args:
        evaluation: whose models the values are of.
        row: the metric.
        best: format of the value that is bold.
        escaped: changes each text before.
    """
    chance = [v for f in row.known[:1] for v in (f.chance, f.mismatched) if v is not None]
    values = [
        (best if model.label == row.best else "{}").format(escaped(value_text(result)))
        for model, result in zip(evaluation.models, row.results, strict=True)
    ]
    arrow, own = ("", "") if row.own is None else (ARROWS[row.direction][0], number(row.own))
    others = (own, number(max(chance)) if chance else "")
    return [row.definition.title, escaped(arrow), *values, *map(escaped, others)]


def remarks(result: MetricResult) -> list[str]:
    """Return what is to be known about a value: how informative it is, its basis, and its note."""
    informative = "" if result.informative else "not informative here"
    bare = "no interval" if result.interval.low is None else ""
    return list(filter(None, (informative, bare, result.interval.count, result.note)))


def rows_by_group(evaluation: Evaluation) -> dict[str, list[Row]]:
    """Return {group of metrics: its rows} of the groups that have any."""
    rows = contests(evaluation.models, evaluation.definitions()).values()
    groups = {group: [row for row in rows if row.definition.group == group] for group in GROUPS}
    return {group: some for group, some in groups.items() if some}


def interval_warnings(evaluation: Evaluation) -> Iterator[str]:
    """Yield warnings about intervals that are missing, with the data that would give them."""
    takes = [(m.label, Takes.of([clip.pair for clip in m.clips])) for m in evaluation.models]
    few = grouped(((t.in_words, t.needed), label) for label, t in takes if t.count < t.needed)
    for (takes_in_words, needed), labels in few.items():
        named = "" if len(few) == 1 else f"{', '.join(labels)}: "
        yield (
            f"{named}the clips come from {takes_in_words}: no intervals and no tests. "
            "Differences between takes (recording sessions) cannot be estimated from fewer than "
            f"{needed}; more clips or samples (seeds) of the same takes do not change that. "
            f"Hold out {needed} or more takes"
        )


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
        for name, *values in (cells(evaluation, row, "*{}") for row in rows):
            table.append([f"  {name}", *values])
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
        if {result.interval.low is None for result in row.known if result.informative} == {True}
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
        clips = [item for item in model.excluded if item.what == "clip"]
        yield from (f"Left out: {model.label}: {c.name}: clip: {c.reason}" for c in clips)
        metrics = grouped((m.reason, m) for m in model.excluded if m.what != "clip")
        for reason, items in metrics.items():
            names = listed([*dict.fromkeys(item.name for item in items)], 3)
            what = ", ".join(dict.fromkeys(item.what for item in items))
            yield f"Left out: {model.label}: {names}: {what}: {reason}"


def summary_line(evaluation: Evaluation, report: Path | None) -> str:
    """Return the last line: how many clips were measured, and where all results are."""
    clips = sum(len(model.clips) for model in evaluation.models)
    left_out = sum(item.what == "clip" for model in evaluation.models for item in model.excluded)
    where = f"; all of it in {report}" if report else "; --out report.html shows each"
    return f"{counted(clips, 'clip')} measured, {left_out} left out{where}"


def agreement_lines(evaluation: Evaluation) -> list[str]:
    """Return the agreement with a study as lines; none without a study."""
    if evaluation.agreement is None or not evaluation.agreement.questions:
        return []
    environment = templates(_PAGE, autoescape=False)
    environment.globals |= {"counted": counted, "conclusion": conclusion, "aligned": aligned}
    environment.filters |= {"printable": printable, "row": _agreement_row}
    template = environment.get_template("agreement.txt")
    return template.render(questions=evaluation.agreement.questions).rstrip("\n").split("\n")


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
    for label in new | old:
        if label not in old or label not in new:
            yield f"{label}: only {'now' if label in new else 'before'}"
            continue
        lines = list(_changed_values(old[label], new[label]))
        yield f"{label}: {f'{len(lines)} of {len(new[label])} values differ' if lines else 'equal'}"
        yield from lines


def _changed_values(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each value of a model that differs, is new or is gone."""
    for key in {**new, **old}:
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


def templates(folder: Path, *, autoescape: bool = True) -> jinja2.Environment:
    """Return an environment of the templates of a folder, in which names must be known."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=autoescape,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=not autoescape,
        undefined=jinja2.StrictUndefined,
    )


def _table(name: str, escaped: Callable[[str], str], evaluation: Evaluation) -> str:
    """Return the table as a template writes it; names, and values of LaTeX, are escaped."""
    environment = templates(_PAGE, autoescape=False)
    environment.filters["escaped"] = escaped
    groups = rows_by_group(evaluation)
    return environment.get_template(name).render(
        evaluation=evaluation, groups=groups, cells=cells, latex=_latex
    )


def csv_text(evaluation: Evaluation) -> str:
    """Return one line for each model and metric, with `CSV_COLUMNS` and all digits."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CSV_COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in (row for rows in rows_by_group(evaluation).values() for row in rows):
        for i, result in enumerate(row.results):
            if result is not None:
                label = {"model": evaluation.models[i].label}
                decided = {"best": row.best == label["model"], "p": row.p}
                writer.writerow(label | row.definition.to_json() | result.to_json() | decided)
    return text.getvalue()


def report_lines(evaluation: Evaluation) -> list[str]:
    """Return the verdicts and all tables for a terminal."""
    return [*evaluation.verdicts(), *terminal_lines(evaluation), *agreement_lines(evaluation)]


def _markdown(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|#])", r"\\\1", _one_line(text))


def _latex(text: str) -> str:
    return "".join(_LATEX.get(sign, sign) for sign in _one_line(text))


def _one_line(text: str) -> str:
    return "".join(sign if sign.isprintable() or sign == "\u202f" else " " for sign in text)


WRITERS: Mapping[str, Callable[[Evaluation], str]] = {
    "json": Evaluation.json_text,
    "csv": csv_text,
    "markdown": partial(_table, "table.md", _markdown),
    "latex": partial(_table, "table.tex", _latex),
}
"""Functions that return all results (json), or the table, as text, by name of the form."""
