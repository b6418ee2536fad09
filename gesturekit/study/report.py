"""Report of a user study: conclusions in sentences, one HTML file, and all figures as JSON.

`page/report.html` holds the tables of the page and its text on the method.
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from markupsafe import Markup

from audio_features.atomic import write_text
from gesturekit.evaluation.pairs import grouped
from gesturekit.evaluation.report.plots import (
    STYLE,
    draw_rows,
    name_rows,
    new_figure,
    shortened,
    svg_text,
)
from gesturekit.evaluation.report.text import templates
from gesturekit.evaluation.results import json_text
from gesturekit.evaluation.statistics.answers import Answer
from gesturekit.evaluation.statistics.intervals import LEVEL
from gesturekit.evaluation.statistics.scores import Estimate
from gesturekit.study.analysis import Preference, StudyResult
from gesturekit.viewer.pages import plots_section
from gesturekit.wording import counted, listed, printable

FEW_RATERS = 15
FEW_CLIPS = 10
SAME_ANSWER, LEAST_ANSWERS = 0.9, 10
"""Share of a rater's answers that are the same one, and the number of answers, from which the rater
is named."""
HASTY = 0.4
"""Share of the raters' usual time below which a rater is named."""
_ANSWERS = ("#2f6f9f", "#8bb8d9", "#9aa4ae", "#e5b08f", "#c8643a")
"""Colours of the answers from clearly the first to clearly the second system, readable on light
and on dark pages."""
_INK, _GREY = "#3f87bb", "#7b8794"
_LOOK = dict.fromkeys(("axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), _GREY)


def conclusions(found: StudyResult) -> list[str]:
    """Return sentences on what may be concluded from a study."""
    said = "answer" if found.answers.ratings is None else "comparison"
    lines = [
        f"{counted(len(found.answers.kept), said)} of {counted(found.raters, 'rater')} on "
        f"{counted(found.clips, 'speech segment')}; "
        f"{counted(len(found.answers.excluded), 'rater')} excluded by attention checks."
    ]
    if found.preference is not None:
        lines += _on_preference(found.preference)
    for style, preference in found.by_style.items():
        lines += [f"{style}: {line}" for line in _on_preference(preference)]
    return [*lines, *_on_alignment(found)]


def _on_preference(preference: Preference) -> Iterator[str]:
    names = [system.name for system in preference.systems]
    merit = "mean rating" if preference.rated else "merit score"
    measure = merit if preference.separate else "Elo rating"
    yield f"Order by {measure}, best first: {listed(names, 20)}."
    unclear = []
    for pair in sorted(preference.pairs, key=lambda p: (names.index(p.a), names.index(p.b))):
        rate, p = pair.win_rate, p_text(pair.p_holm)
        if not is_significant(pair.p_holm):
            unclear.append(f"{pair.a} and {pair.b} ({_percent(rate)}, {p})")
        # The mean score, which is tested, and the number of wins can disagree: one side may win
        # more clearly.
        elif pair.mean > 0:
            yield f"{pair.a} is preferred to {pair.b}: win rate {_percent(rate)}, {p}."
        else:
            other = _percent(Estimate(1 - rate.value, 1 - rate.high, 1 - rate.low))
            yield f"{pair.b} is preferred to {pair.a}: win rate {other}, {p}."
    if unclear:
        yield (
            f"No difference was found between {listed(unclear, 12)}. This does not show that they "
            "are equally good."
        )


def _on_alignment(found: StudyResult) -> Iterator[str]:
    for pair, score in found.alignment:
        rate = f"(alignment {_percent(score)}, {p_text(pair.p_holm)}"
        said = f"raters did not tell its motion from that of other speech {rate}; chance 50 %)."
        if is_significant(pair.p_holm):
            fits = "better" if pair.mean > 0 else "worse"
            said = f"its motion fits its speech {fits} than its motion of other speech {rate})."
        yield f"{pair.a}: {said}"
    different = [
        f"{a} and {b} ({p_text(p)})" for a, b, _, p in found.differences if is_significant(p)
    ]
    if different:
        yield f"Systems differ in how often their matched motion is preferred: {listed(different)}."
    elif found.differences:
        yield "No difference between systems in alignment was found."


def reservations(found: StudyResult) -> list[str]:
    """Return sentences on what limits the conclusions, and on all that was left out."""
    lines = [f"{note}." for note in found.answers.notes]
    if not found.answers.has_checks:
        lines.append("The files do not say who failed attention checks: nobody was excluded.")
    lines += _on_careless_raters(found.answers.kept)
    if found.raters < 2:
        lines.append("A single rater: no intervals and no tests, so that nothing can be concluded.")
    elif found.raters < FEW_RATERS:
        lines.append(
            f"{found.raters} raters are few: intervals are rough, and most likely too narrow."
        )
    if found.clips < FEW_CLIPS:
        lines.append(
            f"{counted(found.clips, 'speech segment')}: findings may hold for these clips only."
        )
    for preference in [found.preference] if found.preference else found.by_style.values():
        lines += _limits_of(preference)
    if found.left.low > 0.5 or found.left.high < 0.5:
        lines.append(
            f"{_percent(found.left)} of preferences are for the left side: raters favour it, or "
            "systems were not shown on both sides equally often."
        )
    return lines


def _on_careless_raters(answers: Sequence[Answer]) -> Iterator[str]:
    """Yield sentences on raters who gave one answer throughout, or took far less time than others.

    They are named and not left out: whom to exclude is decided before the study.
    """
    same, times = [], {}
    for user, given in grouped((answer.user, answer) for answer in answers).items():
        most = Counter(answer.score for answer in given).most_common(1)[0][1]
        if len(given) >= LEAST_ANSWERS and most >= SAME_ANSWER * len(given):
            same.append(f"{printable(user)} ({most} of {len(given)})")
        if taken := [answer.seconds for answer in given if not math.isnan(answer.seconds)]:
            times[user] = float(np.median(taken))
    if same:
        yield f"The same answer almost throughout: {listed(same)}."
    usual = float(np.median([*times.values()])) if times else 0.0
    hasty = [f"{printable(u)} ({t:.0f} s)" for u, t in times.items() if t < HASTY * usual]
    if hasty:
        yield f"Far less time than usual (a median of {usual:.0f} s an answer): {listed(hasty)}."


def _limits_of(preference: Preference) -> Iterator[str]:
    if preference.not_compared:
        pairs = [f"{a} and {b}" for a, b in preference.not_compared]
        yield f"Never compared: {listed(pairs, 12)}."
    if preference.separate:
        groups = "; ".join(listed(group, 12) for group in preference.separate)
        yield f"No comparison connects these groups, so that there is no common rating: {groups}."
    elif not preference.bounded:
        yield (
            "Some systems won, or lost, every comparison with the others: their ratings have no "
            "finite value; read their order, not the numbers."
        )


def is_significant(p: float) -> bool:
    """Return whether an adjusted p-value is below the level of 0.05; False for NaN."""
    return p < 1.0 - LEVEL


def p_text(p: float) -> str:
    """Return a p-value as it is written in papers."""
    if math.isnan(p):
        return "no test"
    return "p < .001" if p < 0.001 else f"p = {p:.3f}".replace("0.", ".", 1)


def _percent(rate: Estimate) -> str:
    if math.isnan(rate.value):
        return "only ties"
    bounds = "" if math.isnan(rate.low) else f" [{100 * rate.low:.0f}, {100 * rate.high:.0f}]"
    return f"{100 * rate.value:.0f} %{bounds}"


def write_study_report(
    found: StudyResult, path: str | os.PathLike[str], *, title: str = "User study"
) -> None:
    """Write the report of a study.

    Args:
        found: the result of `analyse_study`.
        path: the .html file to write.
        title: its heading.
    """
    environment = templates(Path(__file__).parent / "page")
    environment.tests |= {"nan": math.isnan, "significant": is_significant}
    environment.filters |= {
        "p": p_text,
        "fixed": lambda value, digits, factor: f"{factor * value:.{digits}f}",
    }
    values = {
        "title": title,
        "study": found,
        "conclusions": conclusions(found),
        "reservations": reservations(found),
        "plots": Markup(plots_section(all_plots(found))),
    }
    write_text(path, environment.get_template("report.html").render(values))


def write_json(found: StudyResult, path: str | os.PathLike[str]) -> None:
    """Write all figures of a study as JSON; undefined ones are null."""
    aligned = [asdict(pair) | {"score": asdict(score)} for pair, score in found.alignment]
    values = {
        "format": 1,
        "answers": len(found.answers.kept),
        "raters": found.raters,
        "clips": found.clips,
        "excluded": found.answers.excluded,
        "conclusions": conclusions(found),
        "reservations": reservations(found),
        "left": asdict(found.left),
        "preference": found.preference and _figures(found.preference),
        "by_style": {name: _figures(one) for name, one in found.by_style.items()},
        "alignment": {"systems": aligned, "differences": found.differences} if aligned else None,
        "reasons": found.reasons,
        "comments": found.answers.comments,
        "rounds": found.rounds,
        "seed": found.seed,
    }
    plain = json.loads(json.dumps(values), parse_constant=lambda _: None)  # without NaN
    write_text(path, json_text(plain))


def _figures(preference: Preference) -> dict[str, Any]:
    values = asdict(preference)
    return {name: values[name] for name in ("systems", "pairs", "not_compared", "anova")}


@matplotlib.style.context([STYLE, _LOOK])
def all_plots(found: StudyResult) -> dict[str, str]:
    """Return {title: SVG text} of all plots that have data."""
    plots = {}
    if found.preference is not None:
        systems, pairs = found.preference.systems, found.preference.pairs
        if not found.preference.separate:
            ratings = {system.name: system.elo for system in systems}
            plots["Elo ratings with 95 % intervals"] = _points(ratings, 1000, "Elo rating")
        merits = {system.name: system.merit for system in systems}
        what = "mean rating" if found.preference.rated else "merit score"
        plots[f"{what.capitalize()}s with 95 % intervals"] = _points(merits, None, what)
        plots["Answers to each pair, from the first clearly better to the second"] = _bars(
            {f"{pair.a} : {pair.b}": pair.counts for pair in pairs}
        )
    if found.alignment:
        scores = {pair.a: score for pair, score in found.alignment}
        title = "Alignment with 95 % intervals; the line is chance"
        plots[title] = _points(scores, 50, "alignment, %", factor=100)
        plots["Answers, from matched motion clearly better to mismatched"] = _bars(
            {pair.a: pair.counts for pair, _ in found.alignment}
        )
    return plots


def _points(
    estimates: dict[str, Estimate], middle: float | None, label: str, factor: float = 1
) -> str:
    """Return the SVG of values with their intervals, times a factor, a row each."""
    figure = new_figure(0.9 + 0.36 * len(estimates))
    axes = figure.subplots()
    names = [shortened(name, 44) for name in estimates]
    bars = [[(factor * e.value, factor * e.low, factor * e.high)] for e in estimates.values()]
    draw_rows(axes, names, bars, [_INK], 0.0)
    if middle is not None:
        axes.axvline(middle, color=_GREY, lw=1.2, ls="--")
    axes.set_xlabel(label)
    axes.grid(axis="x", color=_GREY, alpha=0.3)
    return svg_text(figure)


def _bars(rows: dict[str, tuple[int, ...]]) -> str:
    """Return the SVG of numbers of answers as shares of their row."""
    figure = new_figure(0.9 + 0.36 * len(rows))
    axes = figure.subplots()
    for row, counts in enumerate(rows.values()):
        shares = 100 * np.asarray(counts, dtype=float) / sum(counts)
        left = np.concatenate([[0.0], np.cumsum(shares)[:-1]])
        axes.barh([row] * 5, shares, left=left, color=_ANSWERS, height=0.66)
    axes.axvline(50, color=_GREY, lw=1.2, ls="--")
    axes.set_xlim(0, 100)
    axes.set_xlabel("share of answers, %")
    name_rows(axes, [shortened(name, 44) for name in rows])
    return svg_text(figure)
