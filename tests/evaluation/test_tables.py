"""Tables of the report and of files: each value in its cell, on results made by hand."""

import csv
import html
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

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
    SpeedHistogram,
    contests,
)
from gesturekit.evaluation.report.text import (
    WRITERS,
    level_in_words,
    note_lines,
    number,
    summary_line,
    terminal_lines,
)

MISSING = BareItem(id="a", motion=Path("a"))


def of(value: float, low: float | None = None, high: float | None = None, n: int = 6) -> Interval:
    return Interval(value, low, high, n, 6, "takes")


def clip(name: str, metrics: dict[str, float], recording: dict[str, float], **more) -> ClipResult:
    pair = Pair(name, name, None, MISSING, MISSING)
    return ClipResult(pair, 12.34, metrics, recording, {}, **more)


@pytest.fixture
def evaluation() -> Evaluation:
    """Two models; the second lacks what the first has, and the reverse."""
    a = ModelResult(
        "a&b",
        Path("a"),
        metrics={
            "sync": MetricResult(
                "sync", of(0.5, 0.4, 0.6, n=7), 0.7, chance=0.1, mismatched=0.25,
                recording_interval=of(0.7, 0.65, 0.75), note="6 of 7 clips",
            ),
            "arm_speed": MetricResult("arm_speed", of(1234.5), 1000.0),
            "coverage": MetricResult("coverage", of(50.0), 75.0, informative=False),
        },
        by_recording={"r1": {"coverage": of(40.0, 30.0, 50.0, n=2)}, "r0": {"coverage": of(60.0)}},
        clips=[
            clip("r0", {"sync": 0.5, "arm_speed": 2.0}, {"sync": 0.75}),
            clip("r1", {"sync": -0.25}, {}, notes=("too short", "jumps")),
        ],
        excluded=[
            Excluded("x", "no recording of its name"),
            Excluded("r0", "no feet", what="foot_skate"),
            Excluded("r1", "no feet", what="foot_skate"),
        ],
        notes=["samples"],
        marks=["retargeted"],
    )  # fmt: skip
    jerk = {"jerk": MetricResult("jerk", of(0.02), 12.34)}
    b = ModelResult("b", Path("b"), metrics=jerk, clips=[clip("r0", {"jerk": 0.02}, {})])
    settings = {"variants": {}, "seed": 0}
    return Evaluation([a, b], Path("r"), 25.0, "", settings, SpeedHistogram(), np.zeros(0))


def rows_of(page: str, heading: str) -> list[list[str]]:
    """Return the text of the cells of a section's rows; bars separate the lines of a cell."""
    (section,) = re.findall(rf"<section><h2>{heading}.*?</section>", page, re.DOTALL)
    rows = re.findall(r"<tr>(.*?)</tr>", section, re.DOTALL)
    cells = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL) for row in rows]
    text = [[re.sub(r"<small[^>]*>", "|", cell) for cell in row] for row in cells]
    return [[html.unescape(re.sub(r"<[^>]+>", "", c)).strip() for c in row] for row in text]


@pytest.mark.parametrize("value", [0.0, 0.0123, 0.51234, 12.341, 123.41, 1234.1, -1234567.1])
def test_numbers_are_nearly_right_and_no_longer_than_their_size_needs(value):
    text = number(value).replace("\u202f", "")
    assert float(text) == pytest.approx(value, rel=0.03)
    assert len(text.strip("-").replace(".", "")) <= max(4, len(f"{abs(value):.0f}"))


@pytest.mark.parametrize(("value", "text"), [(10.0, "10.0"), (100.0, "100"), (1e3, "1\u202f000")])
def test_a_number_has_the_digits_of_those_above_it(value, text):
    assert number(value) == text


def test_levels_say_how_many_takes_or_pieces_they_are_of():
    level = Level("another speaker", 0.4123, 0.0567, 4)
    assert level_in_words(level) == "another speaker 0.41 ± 0.057 (4 takes)"
    one = replace(level, spread=None, n=1, pieces=True)
    assert level_in_words(one) == "another speaker 0.41 (1 piece)"
    assert level_in_words(replace(one, n=0)) == "another speaker 0.41"


def test_all_metrics_of_all_models_are_beside_those_of_the_recordings(evaluation, page_of):
    head, *rows = rows_of(page_of(evaluation), "Figures")
    of_a, of_b = ([cell[:3] for cell in head].index(label) for label in ("a&b", "b"))
    assert "retargeted" in head[of_a] and "retargeted" not in head[of_b]
    sync = ("0.50", "0.40", "0.60", "0.10", "0.25")
    basis = ("6 takes", "6 clips")
    for name, *facts in (  # what holds for all models stands at the name
        ("Sync", ("6 takes", "7 clips", "6 of 7"), sync, ["–"], ["0.70", "0.65", "0.75"]),
        ("Arm speed", (*basis, "no interval"), ["1\u202f234"], ["–"], ["1\u202f000"]),
        ("Coverage", (*basis, "informative"), ["50"], ["–"], ["75"]),
        ("Jerk", basis, ["–"], ["0.02"], ["12.3"]),
    ):
        (row,) = (row for row in rows if re.match(rf"{name}\b", row[0]))
        cells = zip((row[0], row[of_a], row[of_b], row[-1]), facts)
        assert all(fact in cell for cell, known in cells for fact in known), name
        assert ("↑" in "".join(row)) == (name in ("Sync", "Coverage")), name


def test_the_terminal_has_the_higher_of_both_chance_levels(evaluation):
    (sync,) = (line for line in terminal_lines(evaluation) if line.strip().startswith("Sync"))
    assert "0.25" in sync and "0.10" not in sync


def test_a_warning_names_its_model_where_there_are_several(evaluation, page_of):
    assert "a&amp;b: samples." in page_of(evaluation)
    alone = page_of(replace(evaluation, models=evaluation.models[:1]))
    assert "samples." in alone and "a&amp;b: samples." not in alone


def test_samples_of_one_recording_are_averaged_in_a_row_of_it(evaluation, page_of):
    _, *rows = rows_of(page_of(evaluation), "Recording by recording")
    assert [row[:2] for row in rows] == [["r0", "a&b"], ["r1", "a&b"]]
    assert "60.0" in rows[0][2] and all(v in rows[1][2] for v in ("40.0", "30.0", "50.0"))


def test_what_is_left_out_is_named(evaluation, page_of):
    rows = [" ".join(row) for row in rows_of(page_of(evaluation), "Left out")]
    lines = list(note_lines(evaluation))
    feet = ("foot_skate", "no feet")
    for facts in (("x", "no recording"), ("r0", *feet), ("r1", *feet)):
        assert sum(all(fact in row for fact in ("a&b", *facts)) for row in rows) == 1, facts
    for facts in (["samples"], ("x", "no recording"), ("r0", "r1", *feet)):
        assert any(all(fact in line for fact in ("a&b", *facts)) for line in lines), facts
    assert not evaluation.is_complete
    shown = summary_line(evaluation, Path("x.html"))
    assert all(fact in shown for fact in ("3 clips", "1 left out", "x.html"))
    assert "--out" in summary_line(evaluation, None)
    evaluation.models[0].excluded.clear()
    assert "Nothing: every metric" in page_of(evaluation) and evaluation.is_complete


@pytest.fixture
def contested() -> Evaluation:
    """Two models on six takes: the reach of the second one is surely nearer to the recordings'."""
    models = []
    for label, base in (("b|c_d", 0.2), ("語 50%", 0.4)):
        clips = []
        for k in range(6):
            pair = Pair(f"r{k}", f"r{k}", None, MISSING, MISSING)
            value = base + 0.01 * (k % 3)
            clips.append(ClipResult(pair, 5.0, {"reach": value}, {"reach": 0.5}, {}))
        metrics = {
            "reach": MetricResult("reach", of(base + 0.01, base, base + 0.02), 0.5),
            "jerk": MetricResult("jerk", of(3.0), 4.0, chance=1.0),
        }
        models.append(ModelResult(label, Path(label), metrics=metrics, clips=clips))
    settings = {"variants": {}, "seed": 0}
    return Evaluation(models, Path("r"), 25.0, "", settings, SpeedHistogram(), np.zeros(0))


def test_the_bold_value_is_marked_in_every_form(contested, page_of):
    row = contests(contested.models)["reach"]
    assert row.best == "語 50%" and row.p < 0.05
    lines = terminal_lines(contested)
    (reach,) = (line for line in lines if "Reach" in line and "0.41" in line)
    assert all(fact in reach for fact in ("*0.41", "0.40", "0.50")) and reach.count("*") == 1
    assert all("Reach" not in line for line in lines if "interval" in line and "Jerk" in line)
    rows = list(csv.DictReader(io.StringIO(WRITERS["csv"](contested))))
    found = {(r["model"], r["key"]): (r["best"], r["p"], r["chance"]) for r in rows}
    assert found["語 50%", "reach"] == ("True", str(row.p), "")
    assert found["b|c_d", "reach"][0] == "False" and found["b|c_d", "jerk"][1:] == ("", "1.0")
    markdown = WRITERS["markdown"](contested)
    assert r"b\|c" in markdown and "語 50%" in markdown
    (reach,) = (line for line in markdown.splitlines() if "Reach" in line and "0.21" in line)
    assert re.search(r"\*\*0.41[^|]*\*\*", reach) and reach.count("**") == 2 and "0.50" in reach
    latex = WRITERS["latex"](contested)
    assert r"b|c\_d" in latex and r"語 50\%" in latex
    assert re.findall(r"\\textbf\{([\d.]+)", latex) == ["0.41"]
    assert all(fact in latex for fact in ("0.21", "0.50", "6 takes", "6 clips", "30 s", "25 fps"))
    assert re.findall(r"\bclass=best\b[^<>]*>([^<]*)", page_of(contested)) == ["0.41"]
