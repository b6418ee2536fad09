"""Figures of HTML reports as SVG text, the same bytes for the same values."""

from __future__ import annotations

import io

import matplotlib
import matplotlib.figure
from matplotlib.backends.backend_svg import FigureCanvasSVG

WIDTH = 10.4  # inches; a page shows it 1040 pixels wide


def new_figure(height: float) -> matplotlib.figure.Figure:
    """Return an empty figure of the page's width and `height` inches."""
    figure = matplotlib.figure.Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasSVG(figure)
    return figure


def svg_text(figure: matplotlib.figure.Figure, line: str, label: str) -> str:
    """Return a figure as SVG.

    Args:
        figure: its tick labels are shown as they are, without mathematics.
        line: colour of axes.
        label: colour of ticks and labels of axes.
    """
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(line)
        axes.tick_params(colors=label, labelsize=9, length=3)
        axes.xaxis.label.set(color=label, size=9.5)
        axes.yaxis.label.set(color=label, size=9.5)
        for text in (*axes.get_xticklabels(), *axes.get_yticklabels()):
            text.set_parse_math(False)
        axes.set_axisbelow(True)
    made = io.StringIO()
    # A fixed salt and no date: the same figures give the same bytes.
    with matplotlib.rc_context({"svg.hashsalt": "gesturekit", "svg.fonttype": "path"}):
        figure.savefig(made, format="svg", transparent=True, metadata={"Date": None})
    return made.getvalue()
