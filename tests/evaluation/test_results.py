"""Results as values, their JSON, and the clips that a report shows."""

import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import (
    BareItem,
    ClipResult,
    Evaluation,
    Excluded,
    Interval,
    Level,
    MetricResult,
    ModelResult,
    Pair,
    QuestionAnswer,
    SpeedHistogram,
    quick_metrics,
)
from gesturekit.evaluation.comparison import EvaluationOptions
from gesturekit.evaluation.report.page import without_folders
from gesturekit.evaluation.results import restored


@pytest.mark.parametrize(
    ("interval", "count", "method"),
    [
        (Interval(1, None, None, 6, 1, "takes"), ["1 take", "6 clips"], "takes"),
        (Interval(1, 0, 2, 1, 2, "takes", 2), ["2 takes", "2 speakers", "1 clip"], "Student"),
        (Interval(1, 0, 2, 5, 5, "samples"), ["5 clips"], "samples"),
        (Interval(1, None, None, 9, 1, "the whole set"), ["9"], "set"),
    ],
)
def test_an_interval_says_what_it_is_over(interval, count, method):
    assert all(re.search(rf"\b{one}\b", interval.count) for one in count)
    assert method in interval.method


def evaluation(*models: ModelResult, **more) -> Evaluation:
    settings = {"variants": {}, "seed": 0}
    return Evaluation([*models], Path("r"), 25.0, "", settings, SpeedHistogram(), np.zeros(0),
                      **more)  # fmt: skip


def has(values: dict, **expected) -> bool:
    """Return whether a dictionary holds all that is expected; it may hold more."""
    return {key: values.get(key) for key in expected} == expected


def test_all_of_a_result_is_in_its_json_and_comes_back(tmp_path):
    interval, own = Interval(0.5, 0.4, 0.6, 6, 5, "takes"), Interval(0.7, 0.6, 0.8, 6, 6, "takes")
    ceiling, floor = Level("own", 0.9, 0.1, 4), Level("other", 0.2, None, 1, True)
    sync = MetricResult("sync", interval, 0.7, 0.1, 0.2, "note", own, False, ceiling, (floor,))
    assert restored(MetricResult, json.loads(json.dumps(asdict(sync)))) == sync
    plain = MetricResult("reach", Interval(1.0, None, None, 3, 1, "the whole set"))
    assert restored(MetricResult, json.loads(json.dumps(asdict(plain)))) == plain
    pair = Pair("x_w002", "x", 2, BareItem(id="a"), BareItem(id="b"))
    clip = ClipResult(pair, 1.23456789, {"sync": 0.5}, {"sync": 0.7}, {"sync": 0.1}, ("odd",))
    model = ModelResult(
        "é", Path("a"), "Good.", [QuestionAnswer("Q?", "sync", "yes", "Yes.")],
        {"sync": sync, "reach": plain}, {"x": {"coverage": own}}, [clip],
        [Excluded("y", "why")], ["n"], ["m"],
    )  # fmt: skip
    found = evaluation(model, versions={"numpy": "1"})
    found.write_json(tmp_path / "x.json")
    text = (tmp_path / "x.json").read_text(encoding="utf-8")
    assert '"label": "é"' in text and text.count("\n") > 100, "people read it too"
    values = json.loads(text)
    (saved,) = values["models"]
    assert {"sync", "reach"} <= set(values["definitions"])
    assert all(fact in values["basis"] for fact in ("1 take", "1 clip", "1 s", "25 fps"))
    assert has(values, reference="r", fps=25.0, versions={"numpy": "1"}, agreement=None)
    assert has(values["settings"], seed=0)
    figures = saved["figures"]
    assert has(
        figures["sync"], **asdict(interval), takes=5, recording=0.7, chance=0.1, recording_low=0.6,
        recording_high=0.8, informative=False, mismatched=0.2, note="note",
        ceiling=asdict(ceiling), floors=[asdict(floor)],
    )  # fmt: skip
    assert has(figures["reach"], unit="m", takes=None, ceiling=None, recording_low=None)
    assert has(saved, label="é", path="a", verdict="Good.", notes=["n"], marks=["m"])
    (finding,), (excluded,), (clip,) = saved["answers"], saved["excluded"], saved["clips"]
    assert has(finding, question="Q?", key="sync", state="yes", sentence="Yes.")
    assert has(excluded, name="y", reason="why", what="clip")
    assert has(clip, name="x_w002", recording="x", window=2, seconds=1.2346, notes=["odd"])
    assert has(clip, figures={"sync": 0.5}, recording_figures={"sync": 0.7})
    assert has(clip, mismatched={"sync": 0.1})
    assert has(saved["by_recording"]["x"]["coverage"], **asdict(own))


def test_no_file_of_results_has_a_value_that_is_no_number(tmp_path):
    nothing = MetricResult("reach", Interval(float("nan"), None, None, 3, 1, "the whole set"))
    with pytest.raises(ValueError, match="JSON"):
        evaluation(ModelResult("a", Path("a"), metrics={"reach": nothing})).json_text()


def test_a_seed_below_zero_is_refused():
    with pytest.raises(EvaluationError, match="seed.*-1"):
        EvaluationOptions(seed=-1)


def test_quick_metrics_are_values_or_ratios_to_the_recordings(gesture):
    """Movement twice as fast has twice the speed and 2³ of the jerk."""
    own = [gesture(4.0, 25.0, seed=k) for k in (2, 3)]
    made = [replace(motion, fps=50.0).resample(25.0) for motion in own]
    found = quick_metrics(made, own)
    assert found["arm_speed_ratio"] == pytest.approx(2.0, rel=0.1)
    assert found["jerk_ratio"] == pytest.approx(8.0, rel=0.15)
    assert found["foot_skate"] >= 0.0
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
