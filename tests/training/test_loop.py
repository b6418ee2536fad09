"""The loop of a training: when it logs, evaluates, measures and saves, and when it stops."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from runs import logged
from small_runs import small_diffusion

from gesturekit import progress
from gesturekit.errors import ModelError
from gesturekit.training.config import to_dict
from gesturekit.training.run import loop as module
from gesturekit.training.run.folder import Run
from gesturekit.training.run.loop import Loop, StageCallbacks, last_losses, read_once
from gesturekit.training.run.processes import Processes

PLAN = [(5, 1.0), (4, 2.0)]
EVERY = {"log_every": 3, "checkpoint_every": 4, "eval_every": 4}


@pytest.fixture
def training(tmp_path) -> Callable[..., SimpleNamespace]:
    """training(done=0, rank=0, due=(7,), ...): two stages of which each step is written down."""

    def make(done: int = 0, rank: int = 0, due: tuple[int, ...] = (7,), **changes: Any):
        config = small_diffusion(tmp_path / "c.jsonl", tmp_path / "run", EVERY, changes)
        run = Run(config.out, to_dict(config), resume=False)
        did = SimpleNamespace(steps=[], evaluated=[], measured=[], saved=[], stages=[], run=run)
        weight = torch.ones(2)

        def train(step: int) -> dict[str, float]:
            did.steps.append(step)
            weight[0] = 1.0 if step < changes_at["weight"] else float("inf")
            loss = float("nan") if step == changes_at["loss"] else float(step)
            return {"odd": 6.0, "loss": loss} if step % 2 else {"loss": loss}

        def stage(index: int) -> StageCallbacks:
            did.stages.append(index)
            return StageCallbacks(
                train=train,
                weights=lambda: [weight],
                state=lambda: did.saved.append(did.steps[-1]) or {"step": did.steps[-1]},
                evaluate=did.evaluated.append,
                measure=did.measured.append,
                also=lambda step: {"learning_rate": step / 10},
                labels={"level": 2 * index + 1},
                name=f"stage {index + 1}: ",
            )

        held_out = SimpleNamespace(is_due=lambda: did.steps[-1] in due)
        did.go = lambda: Loop(config, run, Processes(rank=rank), held_out).train(PLAN, done, stage)
        return did

    changes_at = {"loss": 99, "weight": 99}
    make.wrong = changes_at
    return make


def test_means_are_logged_and_states_saved_every_so_often_and_at_the_end_of_a_stage(training):
    did = training()
    did.go()
    assert did.steps == list(range(1, 10)) and did.stages == [0, 1]
    assert logged(did.run.folder) == [
        {"step": 3, "level": 1, "odd": 4.0, "loss": 2.0, "learning_rate": 0.3},
        {"step": 5, "level": 1, "loss": 4.5, "odd": 3.0, "learning_rate": 0.5},
        {"step": 6, "level": 3, "loss": 6.0, "learning_rate": 0.6},
        {"step": 9, "level": 3, "odd": 4.0, "loss": 8.0, "learning_rate": 0.9},
    ]
    assert did.saved == [4, 5, 8, 9] and did.run.checkpoints.steps() == [8, 9]
    assert did.run.checkpoints.latest() == (9, {"step": 9})
    assert did.evaluated == [4, 5, 8, 9]
    # Not at the end of a stage: the next line of the log would say the same.
    assert did.measured == [4, 7, 8]
    assert last_losses(did.run) == "odd 4, loss 8"


def test_a_resumed_training_forgets_what_came_after_its_checkpoint(training, tmp_path, caplog):
    """Lines of the log that come again, and for the first process alone."""
    caplog.set_level("INFO")
    config = small_diffusion(tmp_path / "c.jsonl", tmp_path / "run")
    run = Run(config.out, {}, resume=False)
    loops = [Loop(config, run, Processes(rank=rank), SimpleNamespace()) for rank in (0, 1)]
    assert loops[0].resume() == (0, None) and not caplog.messages
    for step in (2, 4, 6):
        run.log(step, {"loss": 1.0})
    run.close()
    run.checkpoints.save(4, {"step": 4})
    assert loops[1].resume() == (4, {"step": 4})
    assert [line["step"] for line in logged(config.out)] == [2, 4, 6] and not caplog.messages
    assert loops[0].resume() == (4, {"step": 4})
    assert [line["step"] for line in logged(config.out)] == [2, 4]
    assert caplog.messages == ["Resuming after step 4."]


class Data(NamedTuple):
    """Training data that is a text."""

    text: str

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        (folder / "text").write_text(self.text)


def test_the_corpus_is_read_once_by_the_first_process_of_a_new_run(tmp_path):
    run, asked = Run(tmp_path / "run", {}, resume=False), []

    def read() -> Data:
        asked.append("read")
        return Data("spoken")

    def load(folder: Path) -> Data:
        asked.append("load")
        return Data((folder / "text").read_text())

    for resume, rank, does in ((False, 0, "read"), (False, 1, "load"), (True, 0, "load")):
        data = read_once(run, Processes(rank=rank), resume=resume, read=read, load=load)
        assert data == Data("spoken") and asked.pop() == does and not asked
        assert run.has_begun


def test_the_first_process_says_what_is_trained_on(tmp_path, caplog):
    caplog.set_level("INFO")
    config = small_diffusion(tmp_path / "c.jsonl", tmp_path / "run")
    held_out = SimpleNamespace(what="2 held-out recordings (9 s)")
    for rank in (1, 0):
        loop = Loop(config, Run(config.out, {}, resume=False), Processes(rank=rank), held_out)
        assert not caplog.messages
        loop.announce(["a system", "a mode"], 6, ["1 recording", "5 s"], ["a", "b"])
    assert caplog.messages == [
        f"Run folder {config.out}: a system, a mode, 6 updates (longer=1).",
        "Training on 1 recording, 5 s.",
        *("a.", "b."),
        "Measured at the end and every few minutes: 2 held-out recordings (9 s).",
    ]
    assert [record.levelname for record in caplog.records].count("WARNING") == 2


def test_the_line_of_progress_has_steps_stage_and_losses(training, monkeypatch, capsys):
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.0)
    training().go()
    lines = [line for line in capsys.readouterr().err.splitlines() if "stage" in line]
    assert "3 of 9 updates" in lines[0] and "stage 1: odd 4, loss 2" in lines[0]
    assert "9 of 9 updates" in lines[-1] and "stage 2: odd 4, loss 8" in lines[-1]


def test_the_pace_is_the_mean_time_of_the_steps_since_the_last_line(training, monkeypatch, caplog):
    """Each step takes as many seconds as its number."""
    caplog.set_level("INFO")
    did = training(eval_every=0, due=())
    monkeypatch.setattr(module.time, "monotonic", lambda: 100.0 + sum(did.steps))
    did.go()
    lines = map(json.loads, (did.run.folder / "metrics.jsonl").read_text().splitlines())
    paces = [line["seconds_per_iteration"] for line in lines]
    assert paces == [(1 + 2 + 3) / 3, (4 + 5) / 2, 6.0, (7 + 8 + 9) / 3]
    # After step 3, two of its cost have taken 5 s: 2 more, and 4 of twice the cost, take 25 s.
    assert caplog.messages == ["Time left: about 25 s for 6 of 9 updates."]


@pytest.mark.parametrize(
    ("done", "steps", "stages"), [(3, range(4, 10), [0, 1]), (5, range(6, 10), [1]), (9, [], [])]
)
def test_a_resumed_training_does_the_steps_that_are_left(training, done, steps, stages):
    did = training(done)
    did.go()
    assert did.steps == list(steps) and did.stages == stages


def test_only_the_first_process_writes(training):
    did = training(rank=1)
    did.go()
    assert did.steps == list(range(1, 10))
    assert not did.run.folder.exists() and not did.evaluated + did.measured + did.saved


def test_without_evaluations_it_measures_when_it_is_time(training):
    did = training(eval_every=0, due=(2, 5, 6))
    did.go()
    assert did.evaluated == [] and did.measured == [2, 6]


@pytest.mark.parametrize(
    ("part", "step", "message"),
    [
        ("loss", 2, r"step 2: the loss became NaN or infinite \(loss\); there is no checkpoint"),
        ("loss", 7, r"step 7: .* \(loss\); the last checkpoint is of step 5"),
        ("weight", 3, r"step 4: .* \(a weight\); there is no checkpoint"),
    ],
)
def test_a_training_that_diverges_stops_before_it_is_saved(training, part, step, message):
    training.wrong[part] = step
    with pytest.raises(ModelError, match=message):
        training().go()
