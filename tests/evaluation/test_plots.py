"""Plots of the report: marks at the places of their values."""

from pathlib import Path

import numpy as np
import pytest
from figures import kept_figures, points

from gesturekit.evaluation import Evaluation, Interval, MetricResult, ModelResult, SpeedHistogram
from gesturekit.evaluation.report import plots


def of(value: float, low: float | None = None, high: float | None = None) -> Interval:
    return Interval(value, low, high, 6, 6, "takes")


def model(label: str, results: dict[str, tuple], **parts) -> ModelResult:
    """Return a model from {key: (interval, recording's value, chance, mismatched)}."""
    metrics = {key: MetricResult(key, *values) for key, values in results.items()}
    return ModelResult(label, Path(label), metrics=metrics, **parts)


def evaluated(*models: ModelResult, wrists=(), speeds=()) -> Evaluation:
    counted = SpeedHistogram.of([np.array(speeds)])
    return Evaluation([*models], Path("r"), 25.0, "", {}, counted, np.array(wrists, float))


@pytest.fixture
def drawn(monkeypatch):
    """drawn(evaluation): {title: the axes of its figure}."""
    figures = kept_figures(monkeypatch)

    def draw(evaluation: Evaluation) -> dict[str, list]:
        figures.clear()
        made = plots.all_plots(evaluation)
        assert all("<svg" in svg for svg in made.values())
        return {title: figure.axes for title, figure in zip(made, figures, strict=True)}

    return draw


def names(axis) -> list[str]:
    return [text.get_text() for text in axis.get_ticklabels()]


def test_nothing_is_drawn_of_what_was_not_measured(drawn):
    still = model("a", {}, wrists=np.zeros(9), speeds=SpeedHistogram())
    assert drawn(evaluated(still, wrists=np.arange(9.0), speeds=(0.1,))) == {}


def test_speech_is_shown_beside_chance_and_the_recordings_own(drawn):
    a = model("a", {"sync": (of(0.5, 0.4, 0.6), 0.7, 0.1, 0.2), "bc": (of(-0.3), 0.8)})
    b = model("b", {"sync": (of(0.25), 0.7, None, 0.15)})
    (axes,) = (axes for title, axes in drawn(evaluated(a, b)).items() if title.startswith("Speech"))
    sync, bc = map(points, axes)
    # The interval, the value, and both levels of chance of either model; the recording's own.
    for mark in (
        ([0, 0], [0.4, 0.6]), ([0], [0.5]), ([0], [0.1]), ([0], [0.2]),
        ([1], [0.25]), ([1], [0.15]), ([0, 1], [0.7, 0.7]),
    ):  # fmt: skip
        assert mark in sync, mark
    assert ([0], [-0.3]) in bc and axes[1].get_ylim()[0] < -0.3 and axes[0].get_ylim()[0] == 0
    assert names(axes[0].xaxis) == ["a", "b"] and axes[0].get_xlim() == (-0.6, 1.6)
    (legend,) = axes[0].figure.legends
    assert len(legend.get_texts()) == 3


def shown(drawn, title: str, *models: ModelResult, **recorded) -> list:
    (axes,) = (axes for name, axes in drawn(evaluated(*models, **recorded)).items()
               if name.startswith(title))  # fmt: skip
    return axes


def test_movement_is_a_ratio_to_the_recording_with_a_row_for_each_metric(drawn):
    a = model("a", {"arm_speed": (of(0.3, 0.2, 0.4), 0.5), "jerk": (of(0.001), 1.0)})
    b = model("b $_$", {"arm_speed": (of(1.0, 0.001, 4.0), 0.5), "jerk": (of(2.0), 1.0)})
    (axes,) = shown(drawn, "Movement", a, b)
    rows = names(axes.yaxis)
    arm, jerk = (next(i for i, name in enumerate(rows) if word in name)
                   for word in ("Arm", "Jerk"))  # fmt: skip
    marks, (low, high) = points(axes), axes.get_xlim()
    # The bars of two models take .7 of a row; what is below .01 is not shown.
    for mark in (
        ([0.4, 0.8], [arm - 0.175] * 2), ([0.6], [arm - 0.175]), ([1.0, 1.0], [0, 1]),
        ([0.01, 8.0], [arm + 0.175] * 2), ([2.0], [arm + 0.175]), ([2.0], [jerk + 0.175]),
    ):  # fmt: skip
        assert mark in marks, mark
    assert not any(y == [jerk - 0.175] for _, y in marks)
    assert low <= 0.45 and high >= 2.2 and axes.get_ylim() == (1.5, -0.5)
    (legend,) = axes.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b $_$"], "no mathematics"
    assert {"0.5×", "1×", "2×", "5×"} <= {*names(axes.xaxis)}


def test_patches_are_shown_recording_by_recording(drawn):
    found = {
        "r1": {"coverage": of(40.0, 30.0, 50.0), "local_diversity": of(2.0)},
        "r0": {"coverage": of(60.0)},
    }
    whole = {"coverage": (of(50.0),), "local_diversity": (of(2.0),)}
    coverage, diversity = shown(drawn, "Patches", model("a", whole, by_recording=found))
    assert names(coverage.yaxis) == ["r0", "r1"]
    for mark in (([60.0], [0.0]), ([40.0], [1.0]), ([30.0, 50.0], [1.0, 1.0])):
        assert mark in points(coverage), mark
    assert not coverage.figure.legends, "a single model"
    assert coverage.get_xlim() == (-4, 104) and ([2.0], [1.0]) in points(diversity)
    assert diversity.get_xlim()[1] > 2.0
    alone = model("a", whole, by_recording={"r0": found["r0"]})
    assert not any(title.startswith("Patches") for title in drawn(evaluated(alone)))


def test_speeds_are_shown_with_quartiles_and_as_shares(drawn):
    a = model("a", {}, wrists=np.arange(1, 6) / 10, speeds=SpeedHistogram.of([np.array([0.2])]))
    recorded = {"wrists": np.arange(5) / 5, "speeds": (0.1, 0.1, 0.3)}
    (wrists,) = shown(drawn, "Wrist", a, **recorded)
    for mark in (([0], [0.4]), ([0, 0], [0.2, 0.6]), ([1], [0.3]), ([1, 1], [0.2, 0.4])):
        assert mark in points(wrists), mark
    assert names(wrists.xaxis) == ["recording", "a"]
    (joints,) = shown(drawn, "Joint", a, **recorded)
    shares = {patch.get_label(): patch.get_data() for patch in joints.patches}
    assert shares["recording"].values.max() == pytest.approx(200 / 3)
    assert shares["a"].values.sum() == pytest.approx(100.0)
    assert shares["a"].edges[-1] == joints.get_xlim()[1] == 49.0
