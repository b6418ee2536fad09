"""The folder of a run: resumed with its own settings only; the page that a training keeps in it."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
import torch

from gesturekit.errors import ConfigError, ModelError
from gesturekit.training.run import report as module
from gesturekit.training.run.checkpoint import Checkpoints
from gesturekit.training.run.folder import Run, has_no_run


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Run(tmp_path / "a <b> run", {}, resume=False)
    run.begin()
    return run


def page_of(run: Run) -> str:
    return (run.folder / module.PAGE).read_text(encoding="utf-8")


def chart_of(page: str, title: str) -> str:
    return re.search(rf"<figure><figcaption><b>{title}</b>.*?</figure>", page)[0]


def test_without_tensorboard_metrics_and_report_are_written(run, monkeypatch):
    for name in [
        *(n for n in sys.modules if n.startswith("torch.utils.tensorboard")),
        "tensorboard",
    ]:
        monkeypatch.setitem(sys.modules, name, None)
    run.log(10, {"contact": 0.5})
    run.close()
    assert "Contact" in page_of(run) and run.last_metrics() == {"contact": 0.5}
    assert not (run.folder / "events").exists()


def test_it_shows_losses_by_level_metrics_by_step_and_samples(run: Run) -> None:
    (run.folder / "samples").mkdir()
    (run.folder / "samples" / "step_00000020.html").write_text("a page")
    run.log(10, {"contact": 0.5, "seconds_per_iteration": 0.1}, level=1)
    for step in (11, 20):
        run.log(step, {"contact": 0.75}, level=1)
        run.log(step, {"contact": 0.25, "smoothness": 0.1}, level=3)
        run.log(step, {"held_out/sync": 0.3, "held_out/sync_chance": 0.05}, kind="held_out")
    run.close()
    page = page_of(run)
    contact, smoothness = chart_of(page, "Contact"), chart_of(page, "Smoothness")
    assert contact.count("<polyline") == 2
    assert "level 1" in contact and "level 3" in contact and "0.25 to 0.75" in contact
    colours = [re.findall(r'<b style="color: ([^"]*)">level 3', x) for x in (contact, smoothness)]
    assert colours[0] == colours[1] != [], "a level has one colour in all charts"
    sync = chart_of(page, "Sync")
    assert sync.count("<polyline") == 2 and "chance" in sync
    assert 'href="samples/step_00000020.html"' in page
    assert "a &lt;b&gt; run" in page and "<b> run" not in page
    assert "http" not in page.replace("http-equiv", "")


def test_it_reloads_itself_while_the_training_runs(run: Run) -> None:
    run.log(1, {"loss": 1.0})
    assert 'http-equiv="refresh"' in page_of(run) and "running, step 1" in page_of(run)
    run.close()
    assert 'http-equiv="refresh"' not in page_of(run) and "stopped, step 1" in page_of(run)


def test_it_takes_a_small_share_of_the_time(run: Run, monkeypatch) -> None:
    clock = [1000.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    original, written = module.RunReport._write, []

    def slow(self, *, is_running: bool) -> None:
        clock[0] += 0.1
        written.append(clock[0])
        original(self, is_running=is_running)

    monkeypatch.setattr(module.RunReport, "_write", slow)
    for step in range(4000):  # 400 s of training
        clock[0] += 0.1
        run.log(step, {"loss": 1.0 / (step + 1)})
    assert 2 <= len(written) <= 0.01 * 400 / 0.1


def test_a_resumed_run_goes_on_with_its_curves(run: Run) -> None:
    run.log(1, {"loss": 3.0})
    run.close()
    with (run.folder / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"step": 2, "loss": float("nan")}) + "\nno json\n")
    again = Run(run.folder, {}, resume=True)
    again.log(3, {"loss": 1.5})
    again.close()
    assert "1.5 to 3; steps 1 to 3" in chart_of(page_of(run), "Loss")


@pytest.mark.parametrize(("last", "kept"), [(999, range(1000)), (1000, range(0, 1001, 2))])
def test_of_more_than_a_thousand_points_every_other_one_is_shown(run: Run, last, kept) -> None:
    with (run.folder / "metrics.jsonl").open("w") as file:
        for step in range(last):
            file.write(json.dumps({"step": step, "loss": 1.0 + step}) + "\n")
    run.log(last, {"loss": 1.0 + last})
    run.close()
    places = places_of(chart_of(page_of(run), "Loss"))
    assert [x for x, _ in places] == pytest.approx([k / last for k in kept], abs=2e-4)


def test_a_run_that_has_logged_nothing_has_no_page(run: Run) -> None:
    run.close()
    assert not (run.folder / module.PAGE).exists()


def test_curves_of_a_chart_have_colours_as_far_apart_as_they_can_be(run: Run) -> None:
    """Hues of three levels are a third of the circle apart, in their order."""
    for step in range(6):
        run.log(step, {"loss": 1.0}, level=step % 3)
    run.close()
    hues = [int(hue) for hue in re.findall(r"stroke: hsl\((\d+) ", page_of(run))]
    assert [(after - hues[0]) % 360 for after in hues] == [0, 120, 240]
    assert all(0 <= hue < 360 for hue in hues)


def test_values_that_are_no_numbers_are_not_drawn(run: Run) -> None:
    with (run.folder / "metrics.jsonl").open("w") as file:
        file.write(
            '{"step": 1, "loss": 2.0, "note": "x", "at": Infinity, "seconds_per_iteration": 1}\n'
        )
    run.log(2, {"loss": 4.0, "learning_rate": 0.5})
    run.close()
    page = page_of(run)
    titles = re.findall("<figcaption><b>([^<]*)</b>", page)
    assert titles == ["Loss", "Seconds per iteration", "Learning rate"]
    assert "level" not in chart_of(page, "Loss"), "a training of one stage has no levels"


def test_a_page_that_cannot_be_written_does_not_end_the_training(run: Run) -> None:
    in_the_way = run.folder / "report.html"
    in_the_way.mkdir(parents=True)
    run.log(1, {"loss": 1.0})
    assert run.last_metrics() == {"loss": 1.0} and in_the_way.is_dir()
    in_the_way.rmdir()
    run.close()
    assert "stopped, step 1" in page_of(run)


def places_of(chart: str) -> list[tuple[float, float]]:
    """Points of a chart's first curve as shares of its width, and of its height from below."""
    width, height = map(float, re.search(r'viewBox="0 0 (\d+) (\d+)"', chart).groups())
    points = re.search(r'<polyline points="([^"]*)"', chart)[1].split()
    pairs = [tuple(map(float, point.split(","))) for point in points]
    return [(x / width, 1 - y / height) for x, y in pairs]


@pytest.mark.parametrize(
    ("values", "heights", "scale"),
    [
        ([1.0, 3.0, 2.0], [0, 1, 0.5], "1 to 3;"),
        ([1.0, 25.5, 50.0], [0, 0.5, 1], "1 to 50;"),
        ([1.0, 10.0, 100.0], [0, 0.5, 1], "1 to 100, log scale;"),
        ([-1.0, 0.0, 99.0], [0, 0.01, 1], "-1 to 99;"),
        ([0.0, 50.0, 100.0], [0, 0.5, 1], "0 to 100;"),
        ([7.0, 7.0, 7.0], [0, 0, 0], "7 to 7;"),
    ],
)
def test_a_curve_fills_its_chart_from_the_first_step_to_the_last(run, values, heights, scale):
    for step, value in zip((10, 20, 50), values, strict=True):
        run.log(step, {"loss": value})
    run.close()
    chart = chart_of(page_of(run), "Loss")
    places = places_of(chart)
    assert [x for x, _ in places] == pytest.approx([0, 0.25, 1], abs=0.001)
    margin = 3 / 120
    expected = [margin + (1 - 2 * margin) * height for height in heights]
    assert [y for _, y in places] == pytest.approx(expected, abs=0.001)
    assert f"{scale} steps 10 to 50" in chart
    assert f"<span>{values[-1]:.4g}</span>" in chart, "the newest value"


def test_a_page_opens_with_the_verdict_and_has_no_charts_of_one_point(run: Run) -> None:
    run.log(5, {"late": 1.0, "early": 2.0}, level=1)
    run.log(6, {"held_out/hand_q50": 0.25, "held_out/hand_q50_recording": 0.5}, kind="held_out")
    run.log(6, {"jerk_ratio": 1.5, "sync": 0.5}, kind="evaluation")
    run.close()
    assert "<svg" not in page_of(run) and "Measured" not in page_of(run)
    again = Run(run.folder, {}, resume=True)
    again.log(
        7, {"held_out/reach": 0.5}, kind="held_out", verdict="on 1 recording: In time & calm."
    )
    again.log(9, {"late": 4.0}, level=2)
    again.log(11, {"late": 3.0}, level=2)
    again.close()
    page = page_of(run)
    opening = page.partition("</h1>")[2].partition("step 11")[0]
    assert "Measured on 1 recording: In time &amp; calm.</b>" in opening
    assert page.count("<svg") == page.count("<polyline") == 1
    chart = chart_of(page, "Late")
    assert places_of(chart) == [pytest.approx((0, 0.975)), pytest.approx((1, 0.025))]
    assert "3 to 4; steps 9 to 11" in chart and "<span>3</span>" in chart
    assert re.search("level 1</b> 1; .*level 2</b><", chart)
    words = re.sub("<[^>]*>", " ", chart_of(page, "Hand speed, median, m/s"))
    assert words.split()[-7:] == ["0.25", "step", "6;", "model", "0.25;", "recording", "0.5"]
    assert chart_of(page, "Jerk / the recording's".replace("'", "&#x27;")) and chart_of(
        page, "Sync"
    )


def test_the_page_of_a_finished_training_has_sections_and_the_newest_samples_first(run: Run):
    (run.folder / "samples").mkdir()
    for step in range(0, 1020, 10):
        (run.folder / "samples" / f"step_{step:08d}.html").write_text("a page")
    (run.folder / "model").mkdir()
    (run.folder / "model" / "config.yaml").write_text("kind: multires")
    run.log(10, {"loss": 1.0, "learning_rate": 0.1})
    run.log(20, {"recorded/sync": 0.5, "recorded/sync_recording": 0.25}, kind="recorded")
    run.log(20, {"jerk": 2.0}, kind="evaluation")
    run.log(30, {"other": 2.0}, kind="odd")
    run.close()
    page = page_of(run)
    assert "finished, step 30, written 2" in page
    assert re.findall("<h2>([^<]*)</h2>", page) == [
        *("Losses", "Samples for training recordings", "On training recordings", "Pace", "Odd"),
        "Samples, with their motion",
    ]
    links = re.findall(r">step (\d+)</a>", page)
    assert links[:2] == ["1010", "1000"] and links[-1] == "20" and len(links) == 100
    assert re.findall(r"(\w+)</b> (0\.\d+)", chart_of(page, "Sync")) == [
        *(("model", "0.5"), ("recording", "0.25")),
    ]


def test_logged_lines_are_found_by_step_kind_and_level(run: Run) -> None:
    assert not run.has(1, "held_out") and run.evaluations(1) == []
    run.log(1, {"loss": 3.0, "seconds_per_iteration": 0.5}, level=1)
    run.log(1, {"jerk": 2.0}, kind="evaluation", level=1)
    run.log(2, {"jerk": 1.0}, kind="evaluation", level=2)
    run.log(3, {"loss": 2.0, "seconds_per_iteration": 0.5}, level=1)
    run.log(3, {"held_out/sync": 0.5}, kind="held_out")
    assert [line["step"] for line in run.evaluations(2)] == [2]
    assert run.has(3, "held_out") and not run.has(2, "held_out") and not run.has(3, "evaluation")
    assert run.last_metrics() == {"loss": 2.0}
    with (run.folder / "metrics.jsonl").open("a") as file:
        file.write('{"step": 3, "lo')
    run.forget_metrics_after(1)
    lines = (run.folder / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 1]
    assert run.last_metrics() == {"loss": 3.0} and run.evaluations(2) == []
    run.forget_metrics_after(0)
    assert run.last_metrics() == {}
    run.close()


def test_the_last_two_checkpoints_are_kept_and_the_newest_whole_one_is_read(tmp_path, caplog):
    kept = Checkpoints(tmp_path / "checkpoints")
    assert kept.steps() == [] and kept.latest() is None
    for step in (5, 150, 20_000, 1_000_000_000):
        kept.save(step, {"step": step, "values": torch.ones(3)})
    assert kept.steps() == [20_000, 1_000_000_000]
    step, state = kept.latest()
    assert step == state["step"] == 1_000_000_000 and state["values"].tolist() == [1.0] * 3
    kept.path(step).write_bytes(b"half")
    assert kept.latest()[0] == 20_000
    assert f"{kept.path(step)} cannot be read" in caplog.text
    kept.path(20_000).write_bytes(b"")
    (tmp_path / "checkpoints" / "step_3.txt").touch()
    with pytest.raises(ModelError, match="none of its 2 checkpoints can be read"):
        kept.latest()


@pytest.mark.parametrize(
    ("names", "is_free"),
    [
        ([], True),
        (["data/", "command.txt", "versions.json", ".half"], True),
        (["config.yaml"], False),
        (["command.txt", "holiday.jpg"], False),
    ],
)
def test_a_folder_with_anything_but_a_training_that_never_began_is_in_use(tmp_path, names, is_free):
    for name in names:
        place = tmp_path / name
        place.mkdir() if name.endswith("/") else place.touch()
    assert has_no_run(tmp_path) == is_free
    (tmp_path / "file").touch()
    assert has_no_run(tmp_path / "missing") and not has_no_run(tmp_path / "file")


def test_a_run_is_a_folder_and_is_resumed_where_there_is_one(run, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="a file, not a run folder"):
        Run(tmp_path / "file", {}, resume=False)
    with pytest.raises(ConfigError, match="no run to resume here"):
        Run(tmp_path / "other", {}, resume=True)
    resume = f"not finished; gesturekit train --resume '{run.folder}'"
    with pytest.raises(ConfigError, match=f"{re.escape(resume)}.*out=OTHER"):
        Run(run.folder, {}, resume=False)
    assert run.has_begun and not Run(tmp_path / "other", {}, resume=False).has_begun
    versions = json.loads((run.folder / "versions.json").read_text())
    assert {"python", "torch"} < {*versions} and int(versions["cpu threads"]) > 0
    assert (run.folder / "command.txt").read_text().endswith("\n")


SETTINGS = {"seed": 3, "training": {"batch": 4, "window": 8}, "features": None, "log_every": 10}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 4}, "seed: 3"),
        ({"training": {"batch": 4, "window": 9}}, "training.window: 8"),
        ({"features": {"align": "mean"}}, "features"),
        ({"backend": "auto"}, "backend: None"),
    ],
)
def test_other_settings_than_those_of_the_run_are_refused(tmp_path, change, named):
    Run(tmp_path / "run", SETTINGS, resume=False).begin()
    Run(tmp_path / "run", SETTINGS | {"log_every": 1}, resume=True)  # changes no result
    with pytest.raises(ConfigError, match=named):
        Run(tmp_path / "run", SETTINGS | change, resume=True)
