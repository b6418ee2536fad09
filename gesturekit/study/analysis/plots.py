"""Plots of a study's report, as SVG that is readable on light and on dark pages."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib
import matplotlib.figure
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG

from gesturekit.study.analysis.result import StudyResult
from gesturekit.study.analysis.significance import Estimate

# Clear, slight, equal, slight, clear.
_ANSWERS = ("#2f6f9f", "#8bb8d9", "#9aa4ae", "#e5b08f", "#c8643a")
_INK, _GREY = "#3f87bb", "#7b8794"
_WIDTH = 10.4


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
        plots["Merit scores with 95 % intervals"] = _points(names, merits, None, "merit score")
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
    figure, axes = _figure(0.9 + 0.36 * len(names))
    for row, found in enumerate(estimates):
        axes.plot([found.low, found.high], [row, row], color=_INK, lw=2.4, solid_capstyle="round")
        axes.plot([found.value], [row], "o", color=_INK, ms=8)
    if middle is not None:
        axes.axvline(middle, color=_GREY, lw=1.2, ls=(0, (4, 3)))
    axes.set_xlabel(label)
    axes.grid(axis="x", color=_GREY, alpha=0.3, lw=0.8)
    return _svg(figure, axes, names)


def _bars(rows: Sequence[tuple[str, Sequence[int]]]) -> str:
    figure, axes = _figure(0.9 + 0.36 * len(rows))
    for row, (_, counts) in enumerate(rows):
        shares = 100 * np.asarray(counts, dtype=float) / max(sum(counts), 1)
        left = np.concatenate([[0.0], np.cumsum(shares)[:-1]])
        axes.barh([row] * 5, shares, left=left, color=_ANSWERS, height=0.66)
    axes.axvline(50, color=_GREY, lw=1.2, ls=(0, (4, 3)))
    axes.set_xlim(0, 100)
    axes.set_xlabel("share of answers, %")
    return _svg(figure, axes, [name for name, _ in rows])


def _figure(height: float) -> tuple[matplotlib.figure.Figure, Axes]:
    figure = matplotlib.figure.Figure(figsize=(_WIDTH, height), layout="constrained")
    FigureCanvasSVG(figure)
    return figure, figure.subplots()


def _svg(figure: matplotlib.figure.Figure, axes: Axes, names: Sequence[str]) -> str:
    short = [name if len(name) <= 44 else f"{name[:43]}…" for name in names]
    axes.set_yticks(range(len(names)), short)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_GREY)
    axes.tick_params(colors=_GREY, labelsize=10, length=3)
    axes.xaxis.label.set(color=_GREY, size=10)
    for text in axes.get_yticklabels():
        text.set_parse_math(False)
    axes.set_axisbelow(True)
    text = io.StringIO()
    # A fixed salt and no date: the same figures give the same bytes.
    with matplotlib.rc_context({"svg.hashsalt": "gesturekit", "svg.fonttype": "path"}):
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    return text.getvalue()
