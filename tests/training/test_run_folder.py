"""The folder of a run: resumed with its own settings only; the page that a training keeps in it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from gesturekit.errors import ConfigError
from gesturekit.training.run import report as module
from gesturekit.training.run.folder import Run


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Run(tmp_path / "a <b> run", {}, resume=False)
    run.begin()
    return run


def page_of(run: Run) -> str:
    return (run.folder / module.PAGE).read_text(encoding="utf-8")


def chart_of(page: str, title: str) -> str:
    return re.search(rf"<figure><figcaption><b>{title}</b>.*?</figure>", page)[0]


def test_it_shows_losses_by_level_metrics_by_step_and_samples(run: Run) -> None:
    (run.folder / "samples").mkdir()
    (run.folder / "samples" / "step_00000020.html").write_text("a page")
    run.log(10, {"contact": 0.5, "seconds_per_iteration": 0.1}, level=1)
    run.log(20, {"contact": 0.25, "smoothness": 0.1}, level=3)
    run.log(20, {"held_out/sync": 0.3, "held_out/sync_chance": 0.05}, kind="held_out")
    run.close()
    page = page_of(run)
    contact, smoothness = chart_of(page, "contact"), chart_of(page, "smoothness")
    assert contact.count("<polyline") == 2
    assert "level 1" in contact and "level 3" in contact and "0.25 to 0.5" in contact
    colours = [re.findall(r'<b style="color: ([^"]*)">level 3', x) for x in (contact, smoothness)]
    assert colours[0] == colours[1] != [], "a level has one colour in all charts"
    sync = chart_of(page, "sync")
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
    assert "1.5 to 3; steps 1 to 3" in chart_of(page_of(run), "loss")


def test_long_runs_keep_the_page_small(run: Run) -> None:
    with (run.folder / "metrics.jsonl").open("w") as file:
        for step in range(50_000):
            file.write(json.dumps({"step": step, "loss": 1.0 + step % 7}) + "\n")
    run.log(50_000, {"loss": 1.0})
    run.close()
    assert len(page_of(run)) < 50_000
    assert "steps 0 to 50000" in chart_of(page_of(run), "loss")


def test_a_page_that_cannot_be_written_does_not_end_the_training(run: Run) -> None:
    in_the_way = run.folder / "report.html"
    in_the_way.mkdir(parents=True)
    run.log(1, {"loss": 1.0})
    assert run.last_metrics() == {"loss": 1.0} and in_the_way.is_dir()
    in_the_way.rmdir()
    run.close()
    assert "stopped, step 1" in page_of(run)


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
