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
    assert names(axes[0].xaxis) == ["a", "b"]
