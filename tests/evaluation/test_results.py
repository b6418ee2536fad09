"""Results as values, their JSON, and the clips that a report shows."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import (
    ClipResult,
    Evaluation,
    Excluded,
    Finding,
    Interval,
    Level,
    MetricResult,
    ModelResult,
    Pair,
    SpeedHistogram,
    jerk,
    quick_metrics,
)
from gesturekit.evaluation.comparison import EvaluationOptions
from gesturekit.evaluation.report.page import without_folders


@pytest.mark.parametrize(
    ("interval", "count", "method"),
    [
        (Interval(1, None, None, 6, 1, "takes"), "1 take, 6 clips", "takes"),
        (Interval(1, 0, 2, 1, 2, "takes", 2), "2 takes of 2 speakers, 1 clip", "Student"),
        (Interval(1, 0, 2, 5, 5, "samples"), "5 clips", "samples"),
        (Interval(1, None, None, 9, 1, "the whole set"), "n = 9", "whole set"),
    ],
)
def test_an_interval_says_what_it_is_over(interval, count, method):
    assert interval.count == count and method in interval.method


def evaluation(*models: ModelResult, **more) -> Evaluation:
    settings = {"variants": {}, "seed": 0}
    return Evaluation([*models], Path("r"), 25.0, "", settings, SpeedHistogram(), np.zeros(0),
                      **more)  # fmt: skip


def test_all_of_a_result_is_in_its_json_and_comes_back(tmp_path):
    interval, own = Interval(0.5, 0.4, 0.6, 6, 5, "takes"), Interval(0.7, 0.6, 0.8, 6, 6, "takes")
    ceiling, floor = Level("own", 0.9, 0.1, 4), Level("other", 0.2, None, 1, True)
    sync = MetricResult("sync", interval, 0.7, 0.1, 0.2, "note", own, False, ceiling, (floor,))
    assert MetricResult.from_json(json.loads(json.dumps(asdict(sync)))) == sync
    plain = MetricResult("reach", Interval(1.0, None, None, 3, 1, "the whole set"))
    assert MetricResult.from_json(json.loads(json.dumps(asdict(plain)))) == plain
    clip = ClipResult(Pair("x_w002", "x", 2, Path("a"), Path("b")), 1.23456789, {"sync": 0.5},
                      {"sync": 0.7}, {"sync": 0.1}, ("odd",))  # fmt: skip
    model = ModelResult(
        "é", Path("a"), "Good.", [Finding("Q?", "sync", "yes", "Yes.")],
        {"sync": sync, "reach": plain}, {"x": {"coverage": own}}, [clip],
        [Excluded("y", "why")], ["n"], ["m"],
    )  # fmt: skip
    found = evaluation(model, versions={"numpy": "1"})
    found.write_json(tmp_path / "x.json")
    text = (tmp_path / "x.json").read_text(encoding="utf-8")
    values = json.loads(text)
    (saved,) = values.pop("models")
    assert set(values.pop("definitions")) == {"sync", "reach"}
    assert "1 take (1 clip, 1 s) at 25 fps" in values.pop("basis")
    assert values == {
        "format": 1, "reference": "r", "fps": 25.0, "protocol": "", "versions": {"numpy": "1"},
        "agreement": None, "settings": {"variants": {}, "seed": 0},
    }  # fmt: skip
    figures = saved.pop("figures")
    assert figures["sync"] == {
        **asdict(interval), "unit": "", "takes": 5, "method": interval.method, "recording": 0.7,
        "chance": 0.1, "recording_low": 0.6, "recording_high": 0.8, "informative": False,
        "mismatched": 0.2, "note": "note", "ceiling": asdict(ceiling), "floors": [asdict(floor)],
    }  # fmt: skip
    reach = figures["reach"]
    assert (reach["takes"], reach["ceiling"], reach["recording_low"]) == (None, None, None)
    assert saved == {
        "label": "é", "path": "a", "verdict": "Good.",
        "answers": [{"question": "Q?", "key": "sync", "state": "yes", "sentence": "Yes."}],
        "by_recording": {"x": {"coverage": asdict(own)}},
        "clips": [{"name": "x_w002", "recording": "x", "window": 2, "seconds": 1.2346,
                   "figures": {"sync": 0.5}, "recording_figures": {"sync": 0.7},
                   "mismatched": {"sync": 0.1}, "notes": ["odd"]}],
        "excluded": [{"name": "y", "reason": "why", "what": "clip"}],
        "notes": ["n"], "marks": ["m"],
    }  # fmt: skip


def test_options_out_of_range_are_refused():
    with pytest.raises(EvaluationError, match="'x'.* multires, lda"):
        EvaluationOptions(protocol="x")
    with pytest.raises(EvaluationError, match="seed is -1"):
        EvaluationOptions(seed=-1)


def test_quick_metrics_are_values_or_ratios_to_the_recordings(gesture):
    made, own = [gesture(2.0, 25.0, seed=k) for k in (0, 1)], [gesture(2.0, 25.0, seed=k)
                                                              for k in (2, 3)]  # fmt: skip
    made = [replace(motion, fps=50.0).resample(25.0) for motion in made]
    found = quick_metrics(made, own)
    ratios = [jerk(a, cutoff=6.0) / jerk(b, cutoff=6.0) for a, b in zip(made, own, strict=True)]
    assert found["jerk_ratio"] == pytest.approx(np.mean(ratios))
    assert "foot_skate" in found and found["arm_speed_ratio"] == pytest.approx(2.0, rel=0.3)
    same = quick_metrics(own, own)
    assert {round(v, 9) for k, v in same.items() if k.endswith("_ratio")} == {1.0}


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("/a/b/c.wav", "c.wav"),
        ("see /a/b/, or x/y", "see , or x/y"),
        ("10 m/s and 1/2", "10 m/s and 1/2"),
        ("https://host/a/b", "https://host/a/b"),
        ("~/a/b and ../c/d", "~/a/b and ../c/d"),
        ("'/a/b c'", "'b c'"),
        ("--out=/a/b/c", "--out=c"),
    ],
)
def test_folders_of_absolute_paths_are_left_out(text, shown):
    assert without_folders(text) == shown
    assert without_folders(f"{Path.cwd()}/x {Path.home()}/y z/w") == "x y z/w"
