"""The folder of a run: resumed with its own settings only; the page that a training keeps in it."""

import json
import re
import sys
from pathlib import Path

import pytest
import torch

from gesturekit.errors import ConfigError, ModelError
from gesturekit.training.run_folder import Checkpoints, Run, has_no_run


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Run(tmp_path / "a <b> run", {}, resume=False)
    run.begin()
    return run


def page_of(run: Run) -> str:
    return (run.folder / "report.html").read_text(encoding="utf-8")


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


@pytest.mark.parametrize(
    ("names", "is_free"),
    [
        (["data/", "command.txt", "versions.json", ".half"], True),
        (["config.yaml"], False),
        (["command.txt", "holiday.jpg"], False),
    ],
)
def test_a_folder_with_anything_but_a_training_that_never_began_is_in_use(tmp_path, names, is_free):
    for name in names:
        place = tmp_path / name
        place.mkdir() if name.endswith("/") else place.touch()
    assert has_no_run(tmp_path) == is_free and has_no_run(tmp_path / "missing")


def test_a_run_is_a_folder_and_is_resumed_where_there_is_one(run, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=f"(?=.*{tmp_path / 'file'})(?=.*out=)"):
        Run(tmp_path / "file", {}, resume=False)
    with pytest.raises(ConfigError, match=f"(?=.*{tmp_path / 'other'})(?=.*--resume)"):
        Run(tmp_path / "other", {}, resume=True)
    with pytest.raises(ConfigError, match=re.escape(f"--resume '{run.folder}'")):
        Run(run.folder, {}, resume=False)
    assert run.has_begun and not Run(tmp_path / "other", {}, resume=False).has_begun
    versions = json.loads((run.folder / "versions.json").read_text())
    assert {"python", "torch"} < {*versions}
    assert (run.folder / "command.txt").read_text().endswith("\n")


def test_a_resumed_run_goes_on_with_its_curves(run: Run) -> None:
    run.log(1, {"loss": 3.0})
    run.close()
    with (run.folder / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"step": 2, "loss": float("nan")}) + "\nno json\n")
    again = Run(run.folder, {}, resume=True)
    again.log(3, {"loss": 1.5})
    again.close()
    text = " ".join(re.sub("<[^>]*>", " ", page_of(run)).split())
    assert all(re.search(rf"\b{fact}\b", text) for fact in ("Loss", r"1\.5", 1, 3))


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
    assert str(kept.path(step)) in caplog.text
    kept.path(20_000).write_bytes(b"")
    (tmp_path / "checkpoints" / "step_3.txt").touch()
    with pytest.raises(ModelError, match=rf"(?=.*{tmp_path / 'checkpoints'})(?=.* 2\b)"):
        kept.latest()


SETTINGS = {"seed": 3, "training": {"batch": 4, "window": 8}, "features": None, "log_every": 10}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"seed": 4}, "seed & 3 & 4"),
        ({"training": {"batch": 4, "window": 9}}, "training.window & 8 & 9"),
        ({"features": {"align": "mean"}}, "features"),
        ({"backend": "auto"}, "backend & auto"),
    ],
)
def test_other_settings_than_those_of_the_run_are_refused(tmp_path, change, says):
    Run(tmp_path / "run", SETTINGS, resume=False).begin()
    Run(tmp_path / "run", SETTINGS | {"log_every": 1}, resume=True)  # changes no result
    with pytest.raises(ConfigError) as caught:
        Run(tmp_path / "run", SETTINGS | change, resume=True)
    assert all(re.search(fact, str(caught.value)) for fact in says.split(" & "))
