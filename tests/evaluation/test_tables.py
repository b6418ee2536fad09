"""Tables of the report and of files: each value in its cell, on results made by hand."""

from __future__ import annotations

import csv
import html
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gesturekit.evaluation.metrics.distributions import SpeedHistogram
from gesturekit.evaluation.pairs import Excluded, Pair
from gesturekit.evaluation.report import tables
from gesturekit.evaluation.report.metric_table import (
    WRITERS,
    note_lines,
    summary_line,
    terminal_lines,
    write_table,
)
from gesturekit.evaluation.results import (
    Agreement,
    ClipResult,
    Evaluation,
    Interval,
    MetricResult,
    ModelResult,
)
from gesturekit.evaluation.statistics.paired import Contest, contests


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
        (9.9e-7, "0"), (1e-6, "1e-06"), (0.0994, "0.099"), (0.1, "0.10"), (9.99, "9.99"),
        (10.0, "10.0"), (99.94, "99.9"), (100.0, "100"), (999.4, "999"), (1000.0, "1\u202f000"),
        (-1234567.0, "-1\u202f234\u202f567"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits_at_any_size(value, text):
    assert tables.number(value) == text


def test_all_metrics_of_all_models_are_beside_those_of_the_recordings(evaluation):
    contests = {"sync": Contest("sync", 0.7, {}, "reference", best="a&b")}
    text = tables.metrics(evaluation, contests)
    found = {row[0].split("|")[0]: row[1:] for row in rows_of(text)}
    assert found["Sync"] == [
        "",
        "0.50|0.40 … 0.60; 6 takes, 7 clips|chance 0.10|with other recordings 0.25|6 of 7 clips",
        "–|not measured",
        "0.70|0.65 … 0.75",
    ]
    assert found["Arm speed, rad/s"][1:] == [
        "1\u202f234|no interval; 6 takes, 6 clips", "–|not measured", "1\u202f000"
    ]  # fmt: skip
    assert found["Coverage, %"] == [
        "↑", "50.0|not informative here|no interval; 6 takes, 6 clips", "–|not measured", "75.0"
    ]  # fmt: skip
    assert found["Jerk, m/s³"][1:] == [
        "–|not measured", "0.02|no interval; 6 takes, 6 clips", "12.3"
    ]  # fmt: skip
    assert text.count("<span class=best>") == 1 and "<span class=best>0.50</span>" in text
    heads = re.search(r"<th>Measure</th>.*?</tr>", text, re.DOTALL)[0]
    assert "a&amp;b (retargeted)" in heads and heads.index("a&amp;b") < heads.index(">b<")
    # Groups of the papers' tables are open.
    opened = re.findall(r"<details( open)?><summary>(\w+)", text)
    assert opened == [(" open", "Speech"), ("", "Movement"), (" open", "Patches")]


def test_recordings_are_shown_where_they_have_samples(evaluation):
    text = tables.recordings(evaluation)
    assert rows_of(text)[-2:] == [
        ["r0", "a&b", "60.0|no interval; 6 takes, 6 clips"],
        ["r1", "a&b", "40.0|30.0 … 50.0; 6 takes, 2 clips"],
    ]
    assert "2 rows" in text and "<details open>" in text and "Coverage, %" in text
    for found in evaluation.models[0].by_recording.values():
        found["coverage"] = of(1.0, n=1)
    assert tables.recordings(evaluation) == ""
    evaluation.protocol = "multires"
    assert tables.recordings(evaluation) != ""
    evaluation.models[0].by_recording = {f"r{k:02}": {"coverage": of(1.0)} for k in range(24)}
    assert "<details open>" in tables.recordings(evaluation)
    evaluation.models[0].by_recording["z"] = {}
    assert "<details><summary>25 rows" in tables.recordings(evaluation)


def test_clips_are_shown_beside_their_recordings(evaluation):
    text = tables.per_clip(evaluation)
    head, first, second, third = rows_of(text)
    columns = [cell.split("|")[0] for cell in head]
    assert first[:2] == ["r0", "12.3 s"] and second[:2] == ["r1|too short; jumps", "12.3 s"]
    assert dict(zip(columns, first))["Sync"] == "0.50|0.75 rec."
    assert dict(zip(columns, first))["Arm speed"] == "2.00"
    assert dict(zip(columns, second))["Sync"] == "-0.25"
    assert dict(zip(columns, second))["Arm speed"] == "" and head[-1] == "Coverage|%"
    assert dict(zip(columns, third))["Jerk"] == "0.02" and third[0] == "r0"
    assert "<details open><summary>3 clips" in text
    evaluation.models[0].clips += evaluation.models[0].clips * 4 + evaluation.models[1].clips
    assert "<details open><summary>12 clips" in tables.per_clip(evaluation)
    evaluation.models[1].clips *= 2
    assert "<details><summary>13 clips" in tables.per_clip(evaluation)
    evaluation.models[0].clips = evaluation.models[0].clips[:1] * 301
    assert "<summary>302 clips" in tables.per_clip(evaluation)


def test_what_is_left_out_is_named(evaluation):
    assert rows_of(tables.excluded(evaluation)) == [
        ["Clip", "Model", "What", "Reason"],
        ["x", "a&b", "clip", "no recording of its name"],
        ["r0", "a&b", "foot_skate", "no feet"],
        ["r1", "a&b", "foot_skate", "no feet"],
    ]
    assert [line for line in note_lines(evaluation) if line[0] != "W"] == [
        "Note: a&b: samples",
        "Left out: a&b: x: clip: no recording of its name",
        "Left out: a&b: r0, r1: foot_skate: no feet",
    ]
    assert not evaluation.is_complete
    shown = summary_line(evaluation, Path("x.html"))
    assert shown == "3 clips measured, 1 left out; all of it in x.html"
    assert summary_line(evaluation, None).endswith("--out report.html shows each")
    evaluation.models[0].excluded.clear()
    assert "Nothing: every metric" in tables.excluded(evaluation) and evaluation.is_complete


def test_the_terminal_has_the_same_table_in_columns(evaluation):
    lines = terminal_lines(evaluation)
    head, *table = lines[: lines.index(next(line for line in lines if line[:8] == "Computed"))]
    assert head.split() == ["a&b", "(retargeted)", "b", "recording", "chance"]
    found = {re.split(r"  +", row.strip())[0]: row for row in table}
    at = [head.index(name) for name in ("a&b", "b  ", "recording", "chance")]
    at[1] = head.index(" b ") + 1
    cells = [found["Sync"][start:].split("  ")[0].strip() for start in at]
    assert cells == ["0.50 [0.40, 0.60]", "–", "0.70", "0.25"]
    assert found["Coverage, %"][at[0] :].startswith("50.0 (not informative)")
    assert [row for row in table if row[0] != " "] == ["Speech:", "Movement:", "Patches:"]
    assert "Computed over 2 takes (2 clips, 25 s) at 25 fps." in lines


def test_files_hold_the_same_table(evaluation):
    rows = list(csv.DictReader(io.StringIO(WRITERS["csv"](evaluation))))
    assert [(row["model"], row["key"], row["value"]) for row in rows] == [
        ("a&b", "sync", "0.5"), ("a&b", "arm_speed", "1234.5"), ("b", "jerk", "0.02"),
        ("a&b", "coverage", "50.0"),
    ]  # fmt: skip
    sync = rows[0]
    expected = {
        "group": "Speech", "unit": "", "low": "0.4", "high": "0.6", "n": "7", "units": "6",
        "over": "takes", "recording": "0.7", "recording_low": "0.65", "recording_high": "0.75",
        "chance": "0.1", "mismatched": "0.25", "informative": "True", "best": "False", "p": "",
        "note": "6 of 7 clips",
    }  # fmt: skip
    assert {key: sync[key] for key in expected} == expected
    assert rows[1]["recording_low"] == "" and rows[3]["informative"] == "False"
    lines = WRITERS["markdown"](evaluation).splitlines()
    assert lines[:4] == [
        "| Metric |  | a&b (retargeted) | b | Recording | Chance |",
        "|---|---|---:|---:|---:|---:|",
        "| **Speech** | | | | | |",
        f"| Sync | {'↑'} | 0.50 \\[0.40, 0.60\\] | – | 0.70 | 0.25 |".replace("\\", ""),
    ]
    latex = WRITERS["latex"](evaluation).splitlines()
    assert latex[1] == r"\begin{tabular}{llrrrr}"
    assert latex[3] == r"Metric &  & a\&b (retargeted) & b & Recording & Chance \\"
    assert latex[5] == r"\multicolumn{6}{l}{\textit{Speech}} \\"
    assert latex[6] == r"Sync & $\uparrow$ & 0.50 [0.40, 0.60] & -- & 0.70 & 0.25 \\"
    assert latex[-1] == r"\end{tabular}"


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
    (reach,) = (line for line in lines if line.startswith("  Reach, m "))
    assert "*0.41 [0.40, 0.42]" in reach and reach.count("*") == 1 and "0.50" in reach
    # A wide letter takes two columns: the columns after it stand below its head.
    head = lines[0]
    at = len(head[: head.index("recording")].encode("utf-16-le")) // 2 + 1
    assert reach[at : at + 4] == "0.50"
    assert lines[-1] == (
        "No interval, and never bold: Jerk: one value of the whole set of clips, from too few "
        "takes, or at the bound of its range."
    )
    rows = list(csv.DictReader(io.StringIO(WRITERS["csv"](contested))))
    found = {(r["model"], r["key"]): (r["best"], r["p"], r["chance"]) for r in rows}
    assert found["語 50%", "reach"] == ("True", str(row.p), "")
    assert found["b|c_d", "reach"][0] == "False" and found["b|c_d", "jerk"][1:] == ("", "1.0")
    markdown = WRITERS["markdown"](contested).splitlines()
    assert markdown[0] == r"| Metric |  | b\|c\_d | 語 50% | Recording | Chance |"
    (reach,) = (line for line in markdown if line.startswith("| Reach, m |"))
    assert reach == "| Reach, m |  | 0.21 [0.20, 0.22] | **0.41 [0.40, 0.42]** | 0.50 |  |"
    latex = WRITERS["latex"](contested)
    assert r"Metric &  & b|c\_d & 語 50\% & Recording & Chance \\" in latex
    assert r"Reach, m &  & 0.21 [0.20, 0.22] & \textbf{0.41 [0.40, 0.42]} & 0.50 &  \\" in latex
    assert latex.startswith(r"% Computed over 6 takes (6 clips, 30 s) at 25 fps. Mean")
    write_table(contested, tmp_path / "x.md", "markdown")
    assert (tmp_path / "x.md").read_text(encoding="utf-8") == WRITERS["markdown"](contested)


def test_metrics_without_an_interval_are_named_only_beside_others(contested):
    def last() -> str:
        return terminal_lines(contested)[-1]

    assert last().startswith("No interval, and never bold: Jerk:")
    for model in contested.models:
        model.metrics["jerk"] = MetricResult("jerk", of(3.0), 4.0, informative=False)
    assert not last().startswith("No interval")
    for model in contested.models:
        model.metrics = {"jerk": MetricResult("jerk", of(3.0), 4.0)}
    assert not last().startswith("No interval"), "none has one"
    model.metrics["reach"] = MetricResult("reach", of(0.4, 0.3, 0.5), 0.5)
    assert last().startswith("No interval, and never bold: Jerk:")
    for model in contested.models:
        model.clips = model.clips[:2]
    assert not last().startswith("No interval"), "the warning of few takes says so"


def test_notes_of_models_and_studies_are_lines(contested):
    contested.agreement = Agreement((), ("left out: x",))
    contested.models[1].notes.append("samples")
    contested.models[1].excluded += (
        [Excluded(name, "no feet", what) for name in "abab" for what in ("foot_skate", "srgr")]
        + [Excluded(name, "no feet", "foot_skate") for name in "cd"]
        + [Excluded("a", "odd", "x")]
    )
    assert list(note_lines(contested)) == [
        "Note: study: left out: x",
        "Note: 語 50%: samples",
        "Left out: 語 50%: a, b, c and 1 more: foot_skate, srgr: no feet",
        "Left out: 語 50%: a: x: odd",
    ]
    for model in contested.models:
        model.clips = model.clips[:2]
    assert next(note_lines(contested)).startswith("Warning: the clips come from 2 takes: no int")
    one = replace(contested, models=contested.models[:1])
    one.models[0].clips = one.models[0].clips[:1]
    assert summary_line(one, None).startswith("1 clip measured, 0 left out;")


def test_the_chance_is_the_higher_level_of_the_first_model_that_has_the_metric(contested):
    def chance(first: MetricResult | None, second: MetricResult | None) -> str:
        for model, result in zip(contested.models, (first, second)):
            model.metrics = {"bc": result} if result else {}
        lines = WRITERS["markdown"](contested).splitlines()
        (*_, row) = (line for line in lines if line.startswith("| "))
        return row.split("|")[-2].strip()

    def level(low: float | None, other: float | None) -> MetricResult:
        return MetricResult("bc", of(0.5), 0.6, chance=low, mismatched=other)

    assert chance(level(0.1, 0.3), level(0.9, None)) == "0.30"
    assert chance(level(0.2, 0.1), None) == "0.20" and chance(None, level(0.4, None)) == "0.40"
    assert chance(level(None, None), level(0.4, None)) == ""
