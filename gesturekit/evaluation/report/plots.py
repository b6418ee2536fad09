"""Plots of reports, as SVG: one colour per model, the recording dark, chance grey."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from gesturekit.evaluation.definitions import DEFINITIONS, PATCHES, definitions_of, shown_in
from gesturekit.evaluation.metrics.physical import BINS
from gesturekit.evaluation.results import Evaluation, Interval, ModelResult

MODEL_COLOURS = (
    *("#c8643a", "#3f7fae", "#6c9a48", "#9467a8", "#c49a2c", "#4aa39a"),
    *("#b8365e", "#7a5a3c", "#4a4fb5", "#e391b4", "#2f5d3a", "#a3b52f"),
)
RECORDING = "#26303b"
CHANCE = "#aab4be"
WIDTH = 10.4  # inches; a page shows it 1040 pixels wide
STYLE = Path(__file__).parent / "page" / "plots.mplstyle"

_DASHED: dict[str, Any] = {"color": RECORDING, "lw": 1.4, "ls": "--"}
_OF_CHANCE: dict[str, Any] = {"color": CHANCE, "ls": "", "ms": 12, "mew": 2.5}
_BAR: dict[str, Any] = {"lw": 2}
_DOT: dict[str, Any] = {"ls": "", "marker": "o", "ms": 7}
_BELOW: dict[str, Any] = {"loc": "outside lower center", "ncols": 4}
"""Looks of lines and marks, and place of legends."""

_LEAST_RATIO = 0.01
_MOST_RECORDINGS = 24
Ends = tuple[float, float, float]
"""A value, and the ends of its interval."""


def colour(index: int) -> str:
    """Return the colour of a model by its index, in plots and tables."""
    return MODEL_COLOURS[index % len(MODEL_COLOURS)]


@matplotlib.style.context(STYLE)
def all_plots(evaluation: Evaluation) -> dict[str, str]:
    """Return {title: SVG text} of all plots that have data."""
    plots = {
        "Speech: measured, by chance, and the recording's own": _speech(evaluation.models),
        "Movement, as a ratio to the recording": _ratios(evaluation.models),
        "Wrist speed": _wrists(evaluation),
        "Joint speeds": _histograms(evaluation),
        "Patches, recording by recording": _patches(evaluation.models),
    }
    return {name: svg_text(made) for name, made in plots.items() if made is not None}


def _speech(models: Sequence[ModelResult]) -> matplotlib.figure.Figure | None:
    keys = [d.key for d in definitions_of("sound") if any(d.key in m.metrics for m in models)]
    if not keys:
        return None
    figure = new_figure(2.9)
    for axes, key in zip(np.atleast_1d(figure.subplots(1, len(keys))), keys, strict=True):
        results = {i: m.metrics[key] for i, m in enumerate(models) if key in m.metrics}
        for i, result in results.items():
            _error_bar(axes, i, _ends(result.interval), colour(i), vertical=True)
            for value, marker in ((result.chance, "_"), (result.mismatched, "x")):
                if value is not None:
                    axes.plot([i], [value], marker=marker, **_OF_CHANCE)
        own = [r.recording for r in results.values() if r.recording is not None]
        if own:
            axes.axhline(own[0], **_DASHED)
        axes.set_xticks(range(len(models)), [model.label for model in models])
        axes.set_xlim(-0.6, len(models) - 0.4)
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.set_ylabel("Pearson's r" if key == "sync" else "score, 0 to 1")
        axes.set_title(DEFINITIONS[key].name)
    looks = (_DASHED, {"marker": "_", **_OF_CHANCE}, {"marker": "x", **_OF_CHANCE})
    names = ["the recording's own", "chance: sound shifted", "sound of other recordings"]
    figure.legend([Line2D([], [], **look) for look in looks], names, **_BELOW)
    return figure


def _ratios(models: Sequence[ModelResult]) -> matplotlib.figure.Figure | None:
    keys = [key for key in shown_in("ratios") if any(_ratio(m, key) is not None for m in models)]
    if not keys:
        return None
    figure = new_figure(0.9 + 0.36 * len(keys) * max(1.0, 0.6 * len(models)))
    axes = figure.subplots()
    inks = {model.label: colour(i) for i, model in enumerate(models)}
    ratios = [[_ratio(model, key) for model in models] for key in keys]
    draw_rows(axes, [DEFINITIONS[key].title for key in keys], ratios, [*inks.values()], 0.7)
    axes.axvline(1.0, **_DASHED)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, 0.45), max(high, 2.2))
    ticks = {t for t in (0.01, 0.02, 0.05, 0.1, 0.2, 5, 10, 20, 50) if low <= t <= high}
    ticks = sorted(ticks | {0.5, 1, 2})
    axes.set_xticks(ticks, [f"{t:g}×" for t in ticks])
    axes.minorticks_off()
    axes.set_xlabel(
        "generated / recorded (log scale, 0.01× and more); the dashed line is the recording"
    )
    axes.grid(axis="x")
    _legend(figure, inks)
    return figure


def _ratio(model: ModelResult, key: str) -> Ends | None:
    result = model.metrics.get(key)
    if result is None or not result.recording:
        return None
    ratio, low, high = np.divide(_ends(result.interval), result.recording).tolist()
    return None if ratio < _LEAST_RATIO else (ratio, max(low, _LEAST_RATIO), high)


def _wrists(evaluation: Evaluation) -> matplotlib.figure.Figure | None:
    sets = [("recording", evaluation.recorded_wrists, RECORDING)]
    sets += [(m.label, m.wrists, colour(i)) for i, m in enumerate(evaluation.models)]
    sets = [entry for entry in sets if len(entry[1]) and np.ptp(entry[1])]
    if len(sets) < 2:
        return None
    figure = new_figure(3.2)
    axes = figure.subplots()
    top = max(float(np.quantile(values, 0.995)) for _, values, _ in sets)
    parts: dict[str, Any] = axes.violinplot(
        [values[values <= top] for _, values, _ in sets],
        positions=range(len(sets)),
        widths=0.8,
        showextrema=False,
    )
    for x, (body, (_, values, ink)) in enumerate(zip(parts["bodies"], sets, strict=True)):
        body.set(facecolor=ink, edgecolor=ink, alpha=0.35, linewidth=1.2)
        low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
        axes.plot([x, x], [low, high], color=ink, lw=6, solid_capstyle="butt")
        axes.plot([x], [middle], "o", color="white", mec=ink, mew=1.6, ms=7)
    axes.set_xticks(range(len(sets)), [label for label, _, _ in sets])
    axes.set_ylabel("wrist speed, m/s")
    axes.set_ylim(0, top)
    axes.grid(axis="y")
    return figure


def _histograms(evaluation: Evaluation) -> matplotlib.figure.Figure | None:
    sets = [(m.label, m.speeds, colour(i), "-") for i, m in enumerate(evaluation.models)]
    # Last, so that it lies on top of a model that is like it.
    sets += [("recording", evaluation.recorded_speeds, RECORDING, "--")]
    sets = [entry for entry in sets if entry[1].counts.sum()]
    if len(sets) < 2:
        return None
    figure = new_figure(3.0)
    axes = figure.subplots()
    for label, histogram, ink, dashes in sets:
        share = 100.0 * histogram.counts / histogram.counts.sum()
        axes.stairs(share, 100.0 * BINS, color=ink, lw=1.8, ls=dashes, label=label)
    axes.set_xlim(0, 100.0 * BINS[-1])
    axes.set_ylim(0, 1.08 * axes.get_ylim()[1])
    axes.set_xlabel("joint speed, cm/s on a body of 1.7 m (bins of 1 cm/s)")
    axes.set_ylabel("share of values, %")
    axes.legend()
    axes.grid(axis="y")
    return figure


def _patches(models: Sequence[ModelResult]) -> matplotlib.figure.Figure | None:
    inks = {model.label: colour(i) for i, model in enumerate(models) if model.by_recording}
    models = [model for model in models if model.by_recording]
    stems = sorted({stem for model in models for stem in model.by_recording})
    patches = [d for d in definitions_of("comparison") if d.group == PATCHES]
    patches = [d for d in patches if any(d.key in model.metrics for model in models)]
    if len(stems) < 2 or not patches:
        return None
    stems = stems[:_MOST_RECORDINGS]
    figure = new_figure(1.0 + 0.28 * len(stems) * max(1.0, 0.5 * len(models)))
    columns = figure.subplots(1, len(patches), sharey=True, squeeze=False)[0]
    for axes, definition in zip(columns, patches, strict=True):
        intervals = [
            [model.by_recording.get(stem, {}).get(definition.key) for model in models]
            for stem in stems
        ]
        bars = [[None if one is None else _ends(one) for one in row] for row in intervals]
        draw_rows(axes, [shortened(stem, 26) for stem in stems], bars, [*inks.values()], 0.6)
        if definition.unit == "%":
            axes.set_xlim(-4, 104)
            axes.set_xlabel("% of windows")
        else:
            right = 1.05 * axes.get_xlim()[1]
            axes.set_xlim(-0.03 * right, right)
            axes.set_xlabel("mean distance of frames")
        axes.grid()
        axes.set_title(definition.name)
    _legend(figure, inks)
    return figure


def draw_rows(
    axes: Axes,
    names: Sequence[str],
    bars: Sequence[Sequence[Ends | None]],
    inks: Sequence[str],
    height: float,
) -> None:
    """Draw rows of horizontal error bars.

    Args:
        axes: where to draw.
        names: of the rows.
        bars: values of each row with the ends of their intervals; None leaves a place empty.
        inks: colour of each place in a row.
        height: share of a row that its bars take.
    """
    for at, row in enumerate(bars):
        for place, (ends, ink) in enumerate(zip(row, inks, strict=True)):
            if ends is not None:
                y = at + (place - (len(inks) - 1) / 2) * height / len(inks)
                _error_bar(axes, y, ends, ink, vertical=False)
    name_rows(axes, names)


def name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Give the rows of a plot their names, the first one at the top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)


def _ends(interval: Interval) -> Ends:
    """Return value, low and high; the value where there is no interval."""
    low = interval.value if interval.low is None else interval.low
    return interval.value, low, interval.value if interval.high is None else interval.high


def _error_bar(axes: Axes, at: float, ends: Ends, ink: str, vertical: bool) -> None:
    value, *line = ends
    for along, across, look in ((line, [at, at], _BAR), ([value], [at], _DOT)):
        points = (across, along) if vertical else (along, across)
        axes.plot(*points, color=ink, **look)


def _legend(figure: matplotlib.figure.Figure, inks: Mapping[str, str]) -> None:
    """Add a legend of several models, {label: colour}."""
    if len(inks) > 1:
        handles = [Line2D([], [], color=ink, marker="o", **_BAR) for ink in inks.values()]
        figure.legend(handles, [*inks], **_BELOW)


def shortened(name: str, most: int) -> str:
    """Return a name of at most so many characters."""
    return name if len(name) <= most else f"{name[: most - 1]}…"


def new_figure(height: float) -> matplotlib.figure.Figure:
    """Return an empty figure of the page's width and `height` inches."""
    return matplotlib.figure.Figure(figsize=(WIDTH, height))


def svg_text(figure: matplotlib.figure.Figure) -> str:
    """Return a figure as SVG: the same bytes for the same figure."""
    made = io.StringIO()
    figure.savefig(made, format="svg", metadata={"Date": None})
    return made.getvalue()
