"""Canvas of pictures: a heading over rows that share one time axis."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib.figure
from matplotlib.axes import Axes

from gesturekit.wording import printable

SOFT = "#6b7785"
_DPI = 110


def new_canvas(
    size: tuple[float, float], title: str, heights: Sequence[float]
) -> tuple[matplotlib.figure.Figure, list[Axes]]:
    """Return a figure of this size in inches, and its rows of these relative heights."""
    canvas = matplotlib.figure.Figure(figsize=size, dpi=_DPI, layout="constrained")
    style = {"ha": "left", "fontsize": 13, "color": "#26303b", "parse_math": False}
    canvas.suptitle(printable(title), x=0.012, **style)
    rows = canvas.subplots(len(heights), sharex=True, height_ratios=heights)
    for axes in rows:
        axes.tick_params(labelsize=8, colors=SOFT, length=2)
        for name, spine in axes.spines.items():
            spine.set_visible(name == "bottom")
            spine.set_color("#d5dae0")
    rows[-1].set_xlabel("seconds", fontsize=9, color=SOFT)
    return canvas, list(rows)


def name_row(axes: Axes, text: str) -> None:
    """Write the title of a row."""
    axes.set_title(text, loc="left", fontsize=9, color=SOFT, pad=3, parse_math=False)
