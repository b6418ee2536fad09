"""Plots of a study's report, as SVG that is readable on light and on dark pages."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib.figure
import numpy as np

from gesturekit.evaluation.report.plots import new_figure, svg_text
from gesturekit.study.analysis.result import StudyResult
from gesturekit.study.analysis.significance import Estimate

# Clear, slight, equal, slight, clear.
_ANSWERS = ("#2f6f9f", "#8bb8d9", "#9aa4ae", "#e5b08f", "#c8643a")
_INK, _GREY = "#3f87bb", "#7b8794"


def all_plots(found: StudyResult) -> dict[str, str]:
    """Return {title: SVG text} of all plots that have data."""
    plots = {}
    preference, alignment = found.preference, found.alignment
    if preference is not None:
        names = [system.name for system in preference.systems]
        if not preference.separate:
            ratings = [system.elo for system in preference.systems]
            plots["Elo ratings with 95 % intervals"] = _points(names, ratings, 1000, "Elo rating")
        merits = [system.merit for system in preference.systems]
        what = "mean rating" if preference.rated else "merit score"
        plots[f"{what.capitalize()}s with 95 % intervals"] = _points(names, merits, None, what)
        rows = [(f"{p.a} : {p.b}", p.counts) for p in preference.pairs]
        plots["Answers to each pair, from the first clearly better to the second"] = _bars(rows)
    if alignment is not None:
        names = [score.name for score in alignment.systems]
        scores = [_times(100, score.score) for score in alignment.systems]
        title = "Alignment with 95 % intervals; the line is chance"
        plots[title] = _points(names, scores, 50, "alignment, %")
        rows = [(score.name, score.counts) for score in alignment.systems]
        plots["Answers, from matched motion clearly better to mismatched"] = _bars(rows)
    return plots


def _times(factor: float, estimate: Estimate) -> Estimate:
    return Estimate(factor * estimate.value, factor * estimate.low, factor * estimate.high)


def _points(
    names: Sequence[str], estimates: Sequence[Estimate], middle: float | None, label: str
) -> str:
    figure = new_figure(0.9 + 0.36 * len(names))
    axes = figure.subplots()
    for row, found in enumerate(estimates):
        axes.plot([found.low, found.high], [row, row], color=_INK, lw=2.4)
        axes.plot([found.value], [row], "o", color=_INK, ms=8)
    if middle is not None:
        axes.axvline(middle, color=_GREY, lw=1.2, ls="--")
    axes.set_xlabel(label)
    axes.grid(axis="x", color=_GREY, alpha=0.3)
    return _svg(figure, names)


def _bars(rows: Sequence[tuple[str, Sequence[int]]]) -> str:
    figure = new_figure(0.9 + 0.36 * len(rows))
    axes = figure.subplots()
    for row, (_, counts) in enumerate(rows):
        shares = 100 * np.asarray(counts, dtype=float) / sum(counts)
        left = np.concatenate([[0.0], np.cumsum(shares)[:-1]])
        axes.barh([row] * 5, shares, left=left, color=_ANSWERS, height=0.66)
    axes.axvline(50, color=_GREY, lw=1.2, ls="--")
    axes.set_xlim(0, 100)
    axes.set_xlabel("share of answers, %")
    return _svg(figure, [name for name, _ in rows])


def _svg(figure: matplotlib.figure.Figure, names: Sequence[str]) -> str:
    """Return the SVG of a figure with a row for each name."""
    short = [name if len(name) <= 44 else f"{name[:43]}…" for name in names]
    (axes,) = figure.axes
    axes.set_yticks(range(len(names)), short)
    axes.set_ylim(len(names) - 0.5, -0.5)
    return svg_text(figure, _GREY, _GREY)
