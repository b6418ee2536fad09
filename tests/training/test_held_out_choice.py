"""Held-out recordings that a training measures: the choice, the length of each, the times."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from small_runs import small_diffusion

from gesturekit.corpus import Item, Manifest
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.motion import Motion
from gesturekit.training.run import held_out as module
from gesturekit.training.run.folder import Run
from gesturekit.training.run.held_out import HeldOutMetrics


@pytest.fixture
def metrics(tmp_path):
    """metrics(test=[30.0, 20.0], ...): of items of these seconds by split, named a0, a1 ..."""

    def make(*, speech: bool = True, styles: Any = (), changes: Any = None, **splits: list[float]):
        items = [
            Item(
                id=f"{split}{k}",
                audio=None if k == 1 else Path("/a.wav"),
                motion=Path("/a.bvh"),
                duration=seconds,
                style="calm" if k == 2 else "wild",
                split=split,
            )
            for split, lengths in splits.items()
            for k, seconds in enumerate(lengths)
        ]
        Manifest(items).save(tmp_path / "c.jsonl")
        config = small_diffusion(tmp_path / "c.jsonl", tmp_path / "run", changes or {})
        run = SimpleNamespace(folder=tmp_path / "run")
        return HeldOutMetrics(config, run, speech=speech, styles=styles)

    return make


def chosen(made: HeldOutMetrics) -> list[tuple[str, str, float]]:
    return [(item.id, item.split, item.duration) for item in made.items]


def test_two_minutes_of_test_items_are_measured_whole(metrics):
    made = metrics(speech=False, train=[9.0], valid=[9.0], test=[15.0] * 8)
    assert chosen(made) == [(f"test{k}", "test", 15.0) for k in range(8)]
    assert made.what == "8 held-out recordings (2 min)" and made.seconds == 120.0
    assert made.is_held_out and made.folder.name == "held_out"
    assert made.command.endswith(f"evaluate {made.folder} --corpus {made.folder}/corpus.jsonl")


def test_of_more_at_most_six_are_measured_and_cut_to_that(metrics):
    made = metrics(speech=False, test=[20.0] * 6 + [90.0])
    # Every other one of seven: 30 s of each, or the 20 s that it has.
    assert chosen(made) == [
        *(("test0", "test", 20.0), ("test2", "test", 20.0), ("test4", "test", 20.0)),
        ("test6", "test", 30.0),
    ]
    assert made.what == "4 of 7 held-out recordings (2 min of 4 min)"
    assert len(metrics(speech=False, test=[30.0] * 6).items) == 6
    assert {d for *_, d in chosen(metrics(speech=False, test=[30.0] * 6))} == {20.0}


def test_validation_and_then_training_items_stand_for_test_items(metrics):
    made = metrics(speech=False, train=[9.0], valid=[5.0])
    assert chosen(made) == [("valid0", "test", 5.0)] and made.is_held_out
    made = metrics(speech=False, train=[9.0])
    assert chosen(made) == [("train0", "train", 9.0)] and not made.is_held_out
    assert made.what == "1 training recording (9 s)" and made.folder.name == "recorded"
    assert made.command.endswith("corpus.jsonl --split train")


def test_items_without_the_inputs_of_the_model_are_not_measured(metrics):
    assert [item.id for item in metrics(test=[5.0] * 4).items] == ["test0", "test2", "test3"]
    calm = metrics(styles={"calm"}, test=[5.0] * 4)
    assert [item.id for item in calm.items] == ["test2"]
    # Test items of other styles: those of the validation are measured.
    assert [i.id for i in metrics(styles={"calm"}, valid=[5.0] * 3, test=[5.0]).items] == ["valid2"]
    assert metrics(styles={"old"}, test=[5.0]).items == ()


def test_items_are_read_with_the_parts_of_the_run(metrics):
    parts = {"left_elbow": "Joint12"}
    (item,) = metrics(test=[5.0], changes={"parts": parts}).items
    assert item.reading == {"parts": parts} and metrics(test=[5.0]).items[0].reading == {}


def test_a_corpus_that_cannot_be_read_is_warned_about(metrics, caplog):
    made = metrics(test=[5.0])
    made.config.corpus.unlink()
    assert made.items == () and "No metrics on held-out recordings: " in caplog.text
    assert made.measure(3, None) == ""


class Talker:
    """A model that writes down what it is asked for, and answers with a gesture."""

    fps, styles, speakers = 30.0, ("wild",), ()
    inputs = SimpleNamespace(path=False, events=())

    def __init__(self, gesture: Callable[..., Motion]) -> None:
        self.gesture, self.asked, self.seed = gesture, [], 9

    def generate(self, speech: Any, **controls: Any) -> Motion:
        self.asked.append({"speech": speech, **controls})
        return self.gesture(4.0, seed=self.seed)


@pytest.fixture
def talks(tmp_path, write_pair) -> DiffusionConfig:
    """A run on four seconds to train on and four that are held out, of longer recordings."""
    items = []
    for split in ("train", "test"):
        audio, motion = write_pair(tmp_path / "in", split, 5.0)
        labels = {"style": "wild", "duration": 4.0, "split": split}
        items.append(Item(id=f"{split}/a", audio=audio, motion=motion, **labels))
    Manifest(items).save(tmp_path / "c.jsonl")
    return small_diffusion(tmp_path / "c.jsonl", tmp_path / "run")


def test_a_measurement_that_fails_is_a_warning(talks, gesture, monkeypatch, caplog):
    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("out of luck")

    monkeypatch.setattr(module, "evaluate", fail)
    made = HeldOutMetrics(talks, Run(talks.out, {}, resume=False), speech=True)
    assert made.measure(7, Talker(gesture), keep=True) == ""
    assert "Step 7: no metrics on 1 held-out recording (4 s): out of luck" in caplog.text
    assert not list(talks.out.glob("*held_out*")) and not (talks.out / "metrics.jsonl").exists()


@pytest.mark.parametrize("speech", [True, False])
def test_a_measurement_is_logged_once_and_its_clips_are_kept_if_asked_for(
    talks, gesture, caplog, speech
):
    caplog.set_level("INFO")
    config, run = talks, Run(talks.out, {}, resume=False)
    made, model = HeldOutMetrics(config, run, speech=speech), Talker(gesture)
    found = made.measure(7, model, " of 9", steps=4)
    what, _, verdict = found.partition(": ")
    assert what == "on 1 held-out recording (4 s)" and verdict.endswith(".")
    (asked,) = model.asked
    sound = asked.pop("speech")
    assert (sound is not None and len(sound.samples) == 4 * 16_000) == speech
    seconds = None if speech else 4.0
    wanted = {"seconds": seconds, "seed": 0, "item": "test/a", "style": "wild", "steps": 4}
    assert asked == wanted
    assert f"Step 7 of 9: {found}" in caplog.text and not list(config.out.glob("*held_out*"))
    for _ in range(2):
        (config.out / ".held_out").mkdir()
        (config.out / ".held_out" / "left.txt").touch()  # of a training that was killed
        assert made.measure(7, model, keep=True) == found
    assert caplog.text.count(found) == 1, "the last verdict is that of the training"
    assert f"All metrics on 1 held-out recording (4 s): {made.command}" in caplog.text
    assert not (made.folder / "left.txt").exists()
    kept = Manifest.load(made.folder / "corpus.jsonl")
    assert [(item.id, item.split) for item in kept] == [("test/a", "test"), ("train/a", "train")]
    assert Motion.load(made.folder / "test" / "a.npz").n_frames == 120
    model.seed = 3
    made.measure(8, model)
    run.close()
    line, later = map(json.loads, (config.out / "metrics.jsonl").read_text().splitlines())
    assert [(one["step"], one["kind"]) for one in (line, later)] == [
        *((7, "held_out"), (8, "held_out"))
    ]
    assert later["held_out/reach"] != line["held_out/reach"], "clips of one name, made anew"
    assert {"held_out/reach", "held_out/reach_recording"} <= line.keys()
    assert not list(config.out.glob(".held_out*")) and "held_out/coverage" not in line


def test_measurements_take_a_twentieth_of_the_time_at_most(metrics, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    made = metrics(test=[5.0])

    def fail(*_: Any, **__: Any) -> None:
        clock[0] += 30.0
        raise RuntimeError

    monkeypatch.setattr(made, "_evaluated", fail)
    for wait, is_due in ((299.0, False), (2.0, True)):
        clock[0] += wait
        assert made.is_due() == is_due
    made.measure(1, None)
    # 30 s are a twentieth of ten minutes.
    for wait, is_due in ((598.0, False), (3.0, True)):
        clock[0] += wait
        assert made.is_due() == is_due
