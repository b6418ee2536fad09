"""Differences from an earlier file of results, and what the file says of each figure."""

import json
from pathlib import Path

import pytest

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import evaluate
from gesturekit.evaluation.report.text import differences
from gesturekit.evaluation.results import read_results

DOCS = Path(__file__).parents[2] / "docs" / "results_file.md"


@pytest.fixture(scope="module")
def found(tmp_path_factory, gesture):
    """Six takes of a model."""
    root = tmp_path_factory.mktemp("set")
    for k in range(6):
        gesture(2.0, 15.0, seed=k).save(root / "recorded" / f"clip{k}.npz")
        gesture(2.0, 15.0, seed=9 + k).save(root / "made" / f"clip{k}.npz")
    return evaluate({"new": root / "made"}, root / "recorded")


@pytest.fixture
def before(found, tmp_path):
    """before(change): an earlier file of results, with a change."""

    def write(change=lambda values: None) -> Path:
        values = found.to_json()
        change(values)
        (tmp_path / "old.json").write_text(json.dumps(values))
        return tmp_path / "old.json"

    return write


def test_the_same_results_are_equal(found, before):
    (line,) = differences(found, read_results(before()))
    assert "new" in line and "equal" in line


def test_each_change_is_a_line_and_models_go_by_label(found, before):
    def change(values):
        (model,) = values["models"]
        model["label"] = "old"
        model["figures"]["wrist_speed"] |= {"value": 9.0, "low": 8.0, "high": 10.0}
        model["figures"]["cca_global"]["value"] += 0.5
        model["figures"]["acceleration"] |= {"value": 1e5, "low": 0.0, "high": 1e6}
        del model["figures"]["jerk"]
        model["figures"]["gone"] = {"value": 1.0}
        values["fps"] = 30.0

    now, cca = (found.models[0].metrics[k].interval.value for k in ("wrist_speed", "cca_global"))
    lines = list(differences(found, read_results(before(change))))
    for facts in (
        *(("fps", "30", "15"), ("new", f"5 of {len(found.models[0].metrics)}")),
        *(("Wrist speed", "9", f"{now:.1f}", "m/s", "interval"), ("Jerk", "now")),
        *(("CCA, global", f"{cca + 0.5:.2f}", f"{cca:.2f}"), ("gone", "before")),
    ):
        assert sum(all(fact in line for fact in facts) for line in lines) == 1, facts
    assert not any("Reach" in line for line in lines), "it has not changed"
    assert not any("interval" in line for line in lines if "Acceleration" in line)
    names = ("other", "new", "more")

    def rename(values):
        values["models"] = [{**values["models"][0], "label": name} for name in names]

    lines = list(differences(found, read_results(before(rename))))
    for label, state in zip(names, ("before", "equal", "before")):
        assert sum(label in line and state in line for line in lines) == 1, label


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "x.json.*evaluate"),
        ("[" * 100_000, "x.json.*evaluate"),
        ("[1]", "x.json.*evaluate"),
        ('{"format": 1, "models": [{"figures": {"a": {}}}]}', "x.json.*evaluate"),
        ('{"format": 1, "models": [{"label": "a", "figures": [1]}]}', "x.json.*evaluate"),
        ('{"format": 2, "models": []}', "format 2"),
    ],
)
def test_other_files_are_one_clear_error(tmp_path, text, says):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(EvaluationError, match=says):
        read_results(tmp_path / "x.json")


def test_a_file_too_large_for_results_is_not_read(tmp_path):
    with (tmp_path / "large.json").open("wb") as file:
        file.truncate((256 << 20) + 1)
    with pytest.raises(EvaluationError, match="large.json"):
        read_results(tmp_path / "large.json")


def test_every_figure_says_what_it_is_computed_over(found):
    values = found.to_json()
    assert all(fact in values["basis"] for fact in ("6 takes", "6 clips", "12 s", "15 fps"))
    figures = values["models"][0]["figures"]
    speed, distance = figures["wrist_speed"], figures["cca_global"]
    assert (speed["unit"], speed["takes"], speed["n"]) == ("m/s", 6, 6)
    assert "Student" in speed["method"] and speed["low"] is not None
    assert distance["takes"] is None and distance["method"] != speed["method"]
    page = DOCS.read_text(encoding="utf-8")
    assert all(f"`{name}`" in page for name in (*values, *values["models"][0], *speed))
