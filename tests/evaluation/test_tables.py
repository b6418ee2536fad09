"""Tables of the report and of files: each value in its cell, on results made by hand."""

import csv
import html
import io
import re
from pathlib import Path

import numpy as np
import pytest

from gesturekit.evaluation import (
    ClipResult,
    Contest,
    Evaluation,
    Excluded,
    Interval,
    MetricResult,
    ModelResult,
    Pair,
    SpeedHistogram,
    contests,
)
from gesturekit.evaluation.report import tables
from gesturekit.evaluation.report.metric_table import (
    WRITERS,
    note_lines,
    summary_line,
    terminal_lines,
    write_table,
)


def of(value: float, low: float | None = None, high: float | None = None, n: int = 6) -> Interval:
    return Interval(value, low, high, n, 6, "takes")


def clip(name: str, metrics: dict[str, float], recording: dict[str, float], **more) -> ClipResult:
    return ClipResult(Pair(name, name, None, Path("a"), Path("b")), 12.34, metrics, recording, {},
                      **more)  # fmt: skip


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
    settings = {"variants": {}}
    return Evaluation([a, b], Path("r"), 25.0, "", settings, SpeedHistogram(), np.zeros(0))


def rows_of(section: str) -> list[list[str]]:
    """Return the text of the cells of each row; lines within a cell are separated by bars."""
    rows = re.findall(r"<tr>(.*?)</tr>", section, re.DOTALL)
    cells = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL) for row in rows]
    text = [[re.sub(r"<small[^>]*>", "|", cell) for cell in row] for row in cells]
    return [[html.unescape(re.sub(r"<[^>]+>", "", cell)) for cell in row] for row in text]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (0.0123, "0.012"), (0.5, "0.50"), (12.34, "12.3"), (123.4, "123"),
        (1234.0, "1\u202f234"), (-1234567.0, "-1\u202f234\u202f567"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits_at_any_size(value, text):
    assert tables.number(value) == text


def test_all_metrics_of_all_models_are_beside_those_of_the_recordings(evaluation):
    contests = {"sync": Contest("sync", 0.7, {}, "reference", best="a&b")}
    text = tables.metrics(evaluation, contests)
    found = {row[0].split("|")[0]: row[1:] for row in rows_of(text)}
    sync = "0.50.*0.40 … 0.60.* 6 takes, 7 clips.*chance 0.10.* 0.25.*6 of 7 clips"
    for name, *facts in (
        ("Sync", "^$", sync, "not measured", "0.70.*0.65 … 0.75"),
        ("Arm speed, rad/s", "", "1\u202f234.* 6 takes, 6 clips", "not measured", "1\u202f000"),
        ("Coverage, %", "↑", "50.0.*informative.* 6 takes, 6 clips", "not measured", "75.0"),
        ("Jerk, m/s³", "", "not measured", "0.02.* 6 takes, 6 clips", "12.3"),
    ):
        assert all(map(re.search, facts, found[name])), name
    assert re.findall("class=best>([^<]*)<", text) == ["0.50"]
    heads = found["Measure"]
    assert "a&b (retargeted)" in heads and heads.index("a&b (retargeted)") < heads.index("b")


def test_what_is_left_out_is_named(evaluation):
    rows = [" ".join(row) for row in rows_of(tables.excluded(evaluation))]
    lines = list(note_lines(evaluation))
    for facts in ("x .*no recording", "r0.*foot_skate.*no feet", "r1.*foot_skate.*no feet"):
        assert sum(bool(re.search(facts, row)) and "a&b" in row for row in rows) == 1, facts
    for facts in ("a&b: samples", "a&b.*x.*no recording", "a&b.*r0, r1.*foot_skate.*no feet"):
        assert sum(bool(re.search(facts, line)) for line in lines) == 1, facts
    assert not evaluation.is_complete
    shown = summary_line(evaluation, Path("x.html"))
    assert re.search("3 clips.* 1 left out.* x.html", shown)
    assert "--out" in summary_line(evaluation, None)
    evaluation.models[0].excluded.clear()
    assert "foot_skate" not in tables.excluded(evaluation) and evaluation.is_complete


@pytest.fixture
def contested() -> Evaluation:
    """Two models on six takes: the reach of the second one is surely nearer to the recordings'."""
    models = []
    for label, base in (("b|c_d", 0.2), ("語 50%", 0.4)):
        clips = []
        for k in range(6):
            pair = Pair(f"r{k}", f"r{k}", None, Path("a"), Path("b"))
            value = base + 0.01 * (k % 3)
            clips.append(ClipResult(pair, 5.0, {"reach": value}, {"reach": 0.5}, {}))
        metrics = {
            "reach": MetricResult("reach", of(base + 0.01, base, base + 0.02), 0.5),
            "jerk": MetricResult("jerk", of(3.0), 4.0, chance=1.0),
        }
        models.append(ModelResult(label, Path(label), metrics=metrics, clips=clips))
    settings = {"variants": {}}
    return Evaluation(models, Path("r"), 25.0, "", settings, SpeedHistogram(), np.zeros(0))


def test_the_bold_value_is_marked_in_every_form(contested, tmp_path):
    row = contests(contested.models)["reach"]
    assert row.best == "語 50%" and row.p < 0.05
    lines = terminal_lines(contested)
    (reach,) = (line for line in lines if "Reach" in line and "0.41" in line)
    assert "*0.41 [0.40, 0.42]" in reach and reach.count("*") == 1 and "0.50" in reach
    assert "Jerk" in lines[-1] and "Reach" not in lines[-1], "what has no interval"
    rows = list(csv.DictReader(io.StringIO(WRITERS["csv"](contested))))
    found = {(r["model"], r["key"]): (r["best"], r["p"], r["chance"]) for r in rows}
    assert found["語 50%", "reach"] == ("True", str(row.p), "")
    assert found["b|c_d", "reach"][0] == "False" and found["b|c_d", "jerk"][1:] == ("", "1.0")
    markdown = WRITERS["markdown"](contested)
    assert r"b\|c" in markdown and "語 50%" in markdown
    (reach,) = (line for line in markdown.splitlines() if "Reach" in line and "0.21" in line)
    assert re.search(r"\| 0.21 \[0.20, 0.22\] \| \*\*0.41 .*\*\* \| 0.50 \|", reach)
    latex = WRITERS["latex"](contested)
    assert r"b|c\_d" in latex and r"語 50\%" in latex
    assert re.search(r"& 0.21 \[0.20, 0.22\] & \\textbf\{0.41 .*\} & 0.50 &", latex)
    assert re.search(r"^% .*6 takes.*6 clips.*30 s.*25 fps", latex)
    write_table(contested, tmp_path / "x.md", "markdown")
    assert (tmp_path / "x.md").read_text(encoding="utf-8") == WRITERS["markdown"](contested)
