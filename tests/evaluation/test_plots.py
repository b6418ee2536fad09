"""Plots of the report: marks at the places of their values."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from figures import kept_figures

from gesturekit.evaluation.metrics.distributions import SpeedHistogram
from gesturekit.evaluation.report import plots
from gesturekit.evaluation.results import Evaluation, Interval, MetricResult, ModelResult

ONE, OTHER = plots.MODEL_COLOURS[:2]
NOTHING = np.zeros(0)


def of(value: float, low: float | None = None, high: float | None = None) -> Interval:
    return Interval(value, low, high, 6, 6, "takes")


def model(label: str, results: dict[str, tuple], **parts) -> ModelResult:
    """Return a model from {key: (interval, recording's value, chance, mismatched)}."""
    metrics = {key: MetricResult(key, *values) for key, values in results.items()}
    return ModelResult(label, Path(label), metrics=metrics, **parts)


def evaluated(
    *models: ModelResult, wrists: np.ndarray = NOTHING, speeds: tuple[float, ...] = ()
) -> Evaluation:
    counted = SpeedHistogram.of([np.array(speeds)])
    return Evaluation([*models], Path("recordings"), 25.0, "", {}, counted, wrists)


@pytest.fixture
def drawn(monkeypatch):
    """drawn(evaluation): {title: the axes of its figure}; each figure is made into SVG too."""
    figures = kept_figures(monkeypatch, plots)

    def draw(evaluation: Evaluation) -> dict[str, list]:
        figures.clear()
        made = plots.all_plots(evaluation)
        assert all("<svg" in svg and "</svg>" in svg for svg in made.values())
        assert len(made) == len(figures)
        return {title: figure.axes for title, figure in zip(made, figures)}

    return draw


def marks(axes) -> list[tuple[list[float], list[float], str, str]]:
    """Return x, y, marker and colour of all lines that were drawn."""
    return [
        (*(np.round(values, 9).tolist() for values in line.get_data()), line.get_marker(),
         line.get_color())
        for line in axes.lines
    ]  # fmt: skip


def ticks(axis) -> dict[float, str]:
    return {
        float(at): text.get_text()
        for at, text in zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True)
    }


def grids(axes) -> tuple[bool, bool]:
    """Return whether lines of the grid stand at the ticks of x, and of y."""
    return axes.get_xgridlines()[0].get_visible(), axes.get_ygridlines()[0].get_visible()


def legend(axes) -> list[str]:
    return [text.get_text() for found in axes.figure.legends for text in found.get_texts()]


def test_an_empty_evaluation_has_no_plots(drawn):
    assert drawn(evaluated(model("a", {}))) == {}
    # A recording alone, and hands or joints that do not move, are no comparison.
    still = model("a", {}, wrists=np.zeros(9), speeds=SpeedHistogram())
    assert drawn(evaluated(still, wrists=np.arange(9.0), speeds=(0.1,))) == {}


def test_speech_is_shown_beside_chance_and_the_recordings_own(drawn):
    a = model("a", {"sync": (of(0.5, 0.4, 0.6), 0.7, 0.1, 0.2), "bc": (of(-0.3), 0.8)})
    b = model("b", {"sync": (of(0.25), 0.7, None, 0.15)})
    axes = drawn(evaluated(a, b))["Speech: measured, by chance, and the recording's own"]
    sync, bc = axes
    grey, dark = plots.CHANCE, plots.RECORDING
    assert marks(sync) == [
        ([0, 0], [0.4, 0.6], "None", ONE),
        ([0], [0.5], "o", ONE),
        ([0], [0.1], "_", grey),
        ([0], [0.2], "x", grey),
        ([1, 1], [0.25, 0.25], "None", OTHER),
        ([1], [0.25], "o", OTHER),
        ([1], [0.15], "x", grey),
        ([0, 1], [0.7, 0.7], "None", dark),
    ]
    assert marks(bc) == [
        ([0, 0], [-0.3, -0.3], "None", ONE),
        ([0], [-0.3], "o", ONE),
        ([0, 1], [0.8, 0.8], "None", dark),
    ]
    for one in axes:
        assert ticks(one.xaxis) == {0: "a", 1: "b"} and one.get_xlim() == (-0.6, 1.6)
        assert 2 < one.figure.get_size_inches()[1] < 4
    # From 0, or below the lowest value.
    assert sync.get_ylim()[0] == 0.0 and sync.get_ylim()[1] > 0.7
    assert bc.get_ylim()[0] < -0.3
    assert [one.get_ylabel() for one in axes] == ["Pearson's r", "score, 0 to 1"]
    assert [one.get_title(loc="left") for one in axes] == [
        plots.DEFINITIONS[key].name for key in ("sync", "bc")
    ]
    assert legend(sync) == [
        "the recording's own", "chance: sound shifted", "sound of other recordings"
    ]  # fmt: skip
    lines = sync.figure.legends[0].get_lines()
    assert [(line.get_marker(), line.get_color()) for line in lines] == [
        ("None", dark), ("_", grey), ("x", grey)
    ]  # fmt: skip
    # The dashed line is that of the plot; marks of chance have none.
    assert lines[0].get_linestyle() == sync.lines[-1].get_linestyle() == "--"
    assert [line.get_linestyle() for line in lines[1:]] == ["None", "None"]


def test_movement_is_shown_as_ratios_to_the_recording(drawn):
    a = model("a", {"arm_speed": (of(3.0, 1.5, 6.0), 2.0), "jerk": (of(8.0), 16.0)})
    b = model("b", {"arm_speed": (of(1.0, 0.001, 4.0), 2.0), "wrist_speed": (of(0.009), 1.0)})
    c = model("c", {"jerk": (of(0.16, 0.1, 1.6), 16.0), "l1_diversity": (of(1.0), 0.0)})
    (axes,) = drawn(evaluated(a, b, c))["Movement, as a ratio to the recording"]
    third = plots.MODEL_COLOURS[2]
    step = 0.7 / 3
    assert marks(axes) == [
        ([0.75, 3.0], [pytest.approx(-step)] * 2, "None", ONE),
        ([1.5], [pytest.approx(-step)], "o", ONE),
        # Nothing is drawn below a hundredth.
        ([0.01, 2.0], [0, 0], "None", OTHER),
        ([0.5], [0], "o", OTHER),
        ([0.5, 0.5], [pytest.approx(1 - step)] * 2, "None", ONE),
        ([0.5], [pytest.approx(1 - step)], "o", ONE),
        ([0.01, 0.1], [pytest.approx(1 + step)] * 2, "None", third),
        ([0.01], [pytest.approx(1 + step)], "o", third),
        ([1, 1], [0, 1], "None", plots.RECORDING),
    ]
    # The metrics of no model, and one that is 0.009 of the recording's, have no row.
    assert ticks(axes.yaxis) == {0: "Arm speed, rad/s", 1: "Jerk, m/s³"}
    assert axes.get_ylim() == (1.5, -0.5) and axes.get_xscale() == "log"
    assert ticks(axes.xaxis) == {
        0.01: "0.01×", 0.02: "0.02×", 0.05: "0.05×", 0.1: "0.1×", 0.2: "0.2×", 0.5: "0.5×",
        1: "1×", 2: "2×",
    }  # fmt: skip
    assert legend(axes) == ["a", "b", "c"]
    assert not len(axes.xaxis.get_minorticklocs()) and grids(axes) == (True, False)
    assert axes.lines[-1].get_linestyle() == "--"
    colours = [line.get_color() for line in axes.figure.legends[0].get_lines()]
    assert colours == [ONE, OTHER, third]


def test_ratios_near_one_have_an_axis_from_half_to_twice(drawn):
    near = model("a", {"jerk": (of(1.1, 0.9, 1.2), 1.0)})
    (axes,) = drawn(evaluated(near))["Movement, as a ratio to the recording"]
    assert axes.get_xlim() == pytest.approx((0.45, 2.2))
    assert list(ticks(axes.xaxis).values()) == ["0.5×", "1×", "2×"]
    assert not legend(axes), "one model needs no legend"
    far = model("a", {"jerk": (of(20.0, 5.0, 60.0), 1.0)})
    (axes,) = drawn(evaluated(far))["Movement, as a ratio to the recording"]
    assert axes.get_xlim()[0] == pytest.approx(0.45) and axes.get_xlim()[1] > 60
    assert list(ticks(axes.xaxis).values()) == [
        *("0.5×", "1×", "2×", "5×", "10×", "20×", "50×")
    ]  # fmt: skip


def test_figures_grow_with_their_rows(drawn):
    def height(*models: ModelResult) -> float:
        (axes,) = drawn(evaluated(*models))["Movement, as a ratio to the recording"]
        return axes.figure.get_size_inches()[1]

    one_row = model("a", {"jerk": (of(1.0), 1.0)})
    three = model("a", {k: (of(1.0), 1.0) for k in ("jerk", "arm_speed", "wrist_speed")})
    assert height(*[three] * 2) > height(three), "two models need more room"
    row = (height(three) - height(one_row)) / 2
    assert 0.25 < row < 0.6 and 0.5 < height(one_row) - row < 1.5
    assert height(three, three) - height(three) == pytest.approx(3 * 0.2 * row)


def test_patches_grow_with_recordings_and_models(drawn):
    def height(recordings: int, models: int) -> float:
        made = {f"r{k}": {"coverage": of(50.0)} for k in range(recordings)}
        metrics = {"coverage": (of(50.0), 50.0)}
        shown = [model(name, metrics, by_recording=made) for name in "abcd"[:models]]
        (axes,) = drawn(evaluated(*shown))["Patches, recording by recording"]
        assert legend(axes) == (["a", "b", "c", "d"][:models] if models > 1 else [])
        return axes.figure.get_size_inches()[1]

    one, two, four = ((height(12, n) - height(2, n)) / 10 for n in (1, 2, 4))
    # Two models have room in a row; of four it is twice as high.
    assert 0.2 < one < 0.5 and two == pytest.approx(one) and four == pytest.approx(2 * one)
    assert 0.7 < height(2, 1) - 2 * one < 1.5


def test_wrist_speeds_are_shown_with_quartiles(drawn):
    a = model("a", {}, wrists=np.linspace(0.0, 1.0, 401))
    still = model("still", {}, wrists=np.zeros(50))
    c = model("c", {}, wrists=np.linspace(0.0, 2.0, 401))
    (axes,) = drawn(evaluated(a, still, c, wrists=np.linspace(0.0, 0.4, 401)))["Wrist speed"]
    third = plots.MODEL_COLOURS[2]
    dark = plots.RECORDING
    assert marks(axes) == [
        ([0, 0], [0.1, 0.3], "None", dark),
        ([0], [0.2], "o", "white"),
        ([1, 1], [0.25, 0.75], "None", ONE),
        ([1], [0.5], "o", "white"),
        ([2, 2], [0.5, 1.5], "None", third),
        ([2], [1.0], "o", "white"),
    ]
    assert ticks(axes.xaxis) == {0: "recording", 1: "a", 2: "c"}
    # Up to the highest quantile of 99.5 %; each outline ends at its set's own values.
    assert axes.get_ylim() == pytest.approx((0.0, 1.99))
    ends = [body.get_paths()[0].vertices for body in axes.collections]
    assert [x[:, 1].max() for x in ends] == pytest.approx([0.4, 1.0, 1.99], abs=0.01)
    assert [np.ptp(x[:, 0]) for x in ends] == pytest.approx([0.8] * 3, abs=0.01)
    assert axes.get_ylabel() == "wrist speed, m/s" and grids(axes) == (False, True)
    assert 2 < axes.figure.get_size_inches()[1] < 4.5
    # The bar ends at the quartiles, and the median stands out on it.
    bar, dot = axes.lines[:2]
    assert bar.get_solid_capstyle() == "butt"
    assert bar.get_linewidth() < dot.get_markersize() < 2 * bar.get_linewidth()
    assert 1.2 < dot.get_markeredgewidth() < 3 and dot.get_markeredgecolor() == dark
    assert axes.collections[1].get_facecolor()[0, :3] == pytest.approx(
        [int(ONE[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    )


def test_histograms_of_speeds_are_shares_of_values(drawn):
    a = model("a", {}, speeds=SpeedHistogram.of([np.array([0.002, 0.005, 0.015, 0.485])]))
    (axes,) = drawn(evaluated(a, speeds=(0.105,)))["Joint speeds"]
    shown = [patch.get_data() for patch in axes.patches]
    assert [patch.get_label() for patch in axes.patches] == ["a", "recording"]
    assert shown[0].edges == pytest.approx(np.arange(50))
    assert shown[0].values[[0, 1, 48]] == pytest.approx([50, 25, 25])
    assert shown[1].values[10] == pytest.approx(100) and shown[1].values.sum() == 100
    assert axes.get_xlim() == pytest.approx((0, 49))
    assert axes.get_ylim()[0] == 0 and 105 < axes.get_ylim()[1] < 120
    assert "cm/s" in axes.get_xlabel() and "%" in axes.get_ylabel()
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert texts == ["a", "recording"]
    assert grids(axes) == (False, True) and 2 < axes.figure.get_size_inches()[1] < 4.5
    assert all(1.5 < patch.get_linewidth() < 3 for patch in axes.patches)
    assert not axes.get_legend().get_frame_on()
    # The recording's dashes let the model's line be seen below.
    assert [patch.get_linestyle() for patch in axes.patches][0] == "-"
    assert axes.patches[1].get_linestyle() != "-"


def test_patches_are_shown_recording_by_recording(drawn):
    metrics = {"coverage": (of(1.0), 1.0), "local_diversity": (of(1.0), 1.0)}
    long = "a recording with a name of 36 letters"
    made = {
        "r1": {"coverage": of(50.0, 40.0, 60.0), "local_diversity": of(2.0)},
        long: {"coverage": of(100.0)},
    }
    empty = model("empty", {})
    a = model("a", metrics, by_recording=made)
    b = model("b", metrics, by_recording={"r1": {"coverage": of(20.0)}})
    axes = drawn(evaluated(empty, a, b))["Patches, recording by recording"]
    coverage, diversity = axes
    # Recordings in the order of their names; the colours are those of the models everywhere.
    assert marks(coverage) == [
        ([100, 100], [-0.15, -0.15], "None", OTHER),
        ([100], [-0.15], "o", OTHER),
        ([40, 60], [0.85, 0.85], "None", OTHER),
        ([50], [0.85], "o", OTHER),
        ([20, 20], [1.15, 1.15], "None", plots.MODEL_COLOURS[2]),
        ([20], [1.15], "o", plots.MODEL_COLOURS[2]),
    ]
    assert marks(diversity) == [
        ([2, 2], [0.85, 0.85], "None", OTHER),
        ([2], [0.85], "o", OTHER),
    ]
    assert ticks(coverage.yaxis) == {0: "a recording with a name o…", 1: "r1"}
    assert coverage.get_ylim() == (1.5, -0.5)
    assert coverage.get_xlim() == (-4, 104) and coverage.get_xlabel() == "% of windows"
    low, high = diversity.get_xlim()
    assert low < 0 < 2 < high and low == pytest.approx(-0.03 * high)
    assert diversity.get_xlabel() == "mean distance of frames"
    assert [one.get_title(loc="left") for one in axes] == ["Coverage", "Local diversity"]
    assert coverage.get_shared_y_axes().joined(coverage, diversity), "names stand once"
    assert grids(coverage) == grids(diversity) == (True, True)


def test_the_first_recordings_of_many_are_shown(drawn):
    made = {f"r{k:02}": {"coverage": of(50.0)} for k in range(30)}
    a = model("a", {"coverage": (of(50.0), 50.0)}, by_recording=made)
    (axes,) = drawn(evaluated(a))["Patches, recording by recording"]
    assert list(ticks(axes.yaxis).values()) == [f"r{k:02}" for k in range(24)]
    alone = model("a", {"coverage": (of(50.0), 50.0)}, by_recording={"r00": made["r00"]})
    assert drawn(evaluated(alone)) == {}
    whole = {"r" * 26: {"coverage": of(50.0)}, "s" * 27: {"coverage": of(50.0)}}
    a = model("a", {"coverage": (of(50.0), 50.0)}, by_recording=whole)
    (axes,) = drawn(evaluated(a))["Patches, recording by recording"]
    assert list(ticks(axes.yaxis).values()) == ["r" * 26, "s" * 25 + "…"]


def test_names_are_drawn_as_they_are_on_any_page(drawn):
    """No mathematics, no white ground, letters as outlines: they need no font of the reader's."""
    wrists = np.linspace(0.0, 0.4, 101)
    found = evaluated(model("$x_1$", {}, wrists=wrists), wrists=wrists)
    (axes,) = drawn(found)["Wrist speed"]
    assert [text.get_parse_math() for text in axes.get_xticklabels()] == [False, False]
    assert plots.all_plots(found) == plots.all_plots(found)
    svg = plots.all_plots(found)["Wrist speed"]
    assert "<text" not in svg and "dc:date" not in svg
    assert not re.search(r'id="patch_1">\s*<path[^>]*fill: #fff', svg), "a dark page shows through"
    shown = {name: axes.spines[name].get_visible() for name in ("top", "right", "left", "bottom")}
    assert shown == {"top": False, "right": False, "left": True, "bottom": True}
    assert axes.get_axisbelow() is True
    for axis in (axes.xaxis, axes.yaxis):
        text, tick = axis.get_ticklabels()[0], axis.get_major_ticks()[0].tick1line
        assert 8 <= text.get_fontsize() <= 12 >= axis.label.get_fontsize() >= 9
        assert 2 < tick.get_markersize() < 3.4
    assert axes.xaxis.get_ticklabels()[0].get_color() == axes.yaxis.label.get_color() != "black"


def test_colours_begin_again_after_the_last():
    n = len(plots.MODEL_COLOURS)
    assert [plots.colour(k) for k in range(n + 2)] == [*plots.MODEL_COLOURS, ONE, OTHER]


def test_legends_name_the_models_that_are_drawn_in_their_colours(drawn):
    metrics = {"coverage": (of(1.0), 1.0)}
    made = {name: {"coverage": of(50.0)} for name in ("r1", "r2")}
    models = [model("empty", {}), *(model(k, metrics, by_recording=made) for k in "ab")]
    (axes,) = drawn(evaluated(*models))["Patches, recording by recording"]
    lines = axes.figure.legends[0].get_lines()
    assert {line.get_marker() for line in lines} == {"o"}
    assert dict(zip(legend(axes), (line.get_color() for line in lines))) == {
        "a": OTHER, "b": plots.MODEL_COLOURS[2]
    }  # fmt: skip
