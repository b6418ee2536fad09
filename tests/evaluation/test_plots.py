"""Plots of the report: marks at the places of their values."""

from __future__ import annotations

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
    axes = drawn(evaluated(a, b))["Speech: measured, by chance, and the recording's own"]
    sync, bc = map(points, axes)
    # The interval, the value, and both levels of chance of either model; the recording's own.
    assert sync == [
        ([0, 0], [0.4, 0.6]), ([0], [0.5]), ([0], [0.1]), ([0], [0.2]),
        ([1, 1], [0.25, 0.25]), ([1], [0.25]), ([1], [0.15]), ([0, 1], [0.7, 0.7]),
    ]  # fmt: skip
    assert ([0], [-0.3]) in bc and axes[1].get_ylim()[0] < -0.3 and axes[0].get_ylim()[0] == 0
    assert names(axes[0].xaxis) == ["a", "b"]


def test_movement_is_shown_as_ratios_to_the_recording(drawn):
    title = "Movement, as a ratio to the recording"
    a = model("a", {"arm_speed": (of(3.0, 1.5, 6.0), 2.0), "jerk": (of(8.0), 16.0)})
    b = model("b", {"arm_speed": (of(1.0, 0.001, 4.0), 2.0), "wrist_speed": (of(0.009), 1.0)})
    (axes,) = drawn(evaluated(a, b))[title]
    spans = [x for x, _ in points(axes)]
    assert spans[:4] == [[0.75, 3.0], [1.5], [0.01, 2.0], [0.5]], "nothing below a hundredth"
    assert names(axes.yaxis) == ["Arm speed, rad/s", "Jerk, m/s³"]
    (near,) = drawn(evaluated(model("a", {"jerk": (of(1.1, 0.9, 1.2), 1.0)})))[title]
    assert near.get_xlim() == pytest.approx((0.45, 2.2))


def test_speeds_are_shown_with_their_quartiles_and_shares(drawn):
    a = model("$x_1$", {}, wrists=np.linspace(0.0, 1.0, 401),
              speeds=SpeedHistogram.of([np.array([0.002, 0.005, 0.015, 0.485])]))  # fmt: skip
    still = model("still", {}, wrists=np.zeros(50))
    found = evaluated(a, still, wrists=np.linspace(0.0, 0.4, 401), speeds=(0.105,))
    axes = drawn(found)
    (wrists,), (joints,) = axes["Wrist speed"], axes["Joint speeds"]
    assert points(wrists) == [
        ([0, 0], [0.1, 0.3]), ([0], [0.2]), ([1, 1], [0.25, 0.75]), ([1], [0.5])
    ]  # fmt: skip
    assert names(wrists.xaxis) == ["recording", "$x_1$"]
    assert not any(text.get_parse_math() for text in wrists.get_xticklabels())
    shown = [patch.get_data() for patch in joints.patches]
    assert shown[0].values[[0, 1, 48]] == pytest.approx([50, 25, 25])
    assert shown[1].values[10] == pytest.approx(100)
    again = plots.all_plots(found)
    assert again == plots.all_plots(found) and "<text" not in again["Wrist speed"]
