"""The loop of a training: when it logs, evaluates, measures and saves, and when it stops."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from runs import logged
from small_runs import small_diffusion

from gesturekit.errors import ModelError
from gesturekit.training.config import to_dict
from gesturekit.training.run_folder import Run
from gesturekit.training.session import Processes
from gesturekit.training.trainer import Loop

PLAN = [(5, 1.0), (4, 2.0)]
EVERY = {"log_every": 3, "checkpoint_every": 4, "eval_every": 4}


@pytest.fixture
def training(tmp_path) -> Callable[..., SimpleNamespace]:
    """training(done=0, rank=0, due=(7,), ...): two stages of which each step is written down."""

    def make(done: int = 0, rank: int = 0, due: tuple[int, ...] = (7,), **changes: Any):
        config = small_diffusion(tmp_path / "c.jsonl", tmp_path / "run", EVERY, changes)
        run = Run(config.out, to_dict(config), resume=False)
        did = SimpleNamespace(steps=[], evaluated=[], measured=[], saved=[], run=run)
        weight = torch.ones(2)

        def train(step: int) -> dict[str, float]:
            did.steps.append(step)
            weight[0] = 1.0 if step < changes_at["weight"] else float("inf")
            loss = float("nan") if step == changes_at["loss"] else float(step)
            return {"odd": 6.0, "loss": loss} if step % 2 else {"loss": loss}

        def go() -> None:
            held_out = SimpleNamespace(is_due=lambda: did.steps[-1] in due)
            loop, end = Loop(config, run, Processes(rank=rank), held_out), 0
            with loop.progress(PLAN, done):
                for level, (count, cost) in zip((1, 3), PLAN, strict=True):
                    begin, end = max(done, end), end + count
                    for step in loop.begin(range(begin + 1, end + 1), cost, level=level):
                        now = loop.count(step, train(step), learning_rate=step / 10)
                        did.evaluated += [step] * now.evaluation
                        did.measured += [step] * now.measurement
                        if now.checkpoint:
                            loop.save(step, [weight], {"step": step})
                            did.saved.append(step)

        did.go = go
        return did

    changes_at = {"loss": 99, "weight": 99}
    make.wrong = changes_at
    return make


def test_means_are_logged_and_states_saved_every_so_often_and_at_the_end_of_a_stage(training):
    did = training()
    did.go()
    assert did.steps == list(range(1, 10))
    expected = [
        {"step": 3, "level": 1, "odd": 4.0, "loss": 2.0, "learning_rate": 0.3},
        {"step": 5, "level": 1, "loss": 4.5, "odd": 3.0, "learning_rate": 0.5},
        {"step": 6, "level": 3, "loss": 6.0, "learning_rate": 0.6},
        {"step": 9, "level": 3, "odd": 4.0, "loss": 8.0, "learning_rate": 0.9},
    ]
    for line, facts in zip(logged(did.run.folder), expected, strict=True):
        assert facts.items() <= line.items()
    assert did.saved == [4, 5, 8, 9] and did.run.checkpoints.steps() == [8, 9]
    assert did.run.checkpoints.latest() == (9, {"step": 9})
    assert did.evaluated == [4, 5, 8, 9]
    # Not at the end of a stage: the next line of the log would say the same.
    assert did.measured == [4, 7, 8]


@pytest.mark.parametrize("done", [3, 5, 9])
def test_a_resumed_training_does_the_steps_that_are_left(training, done):
    did = training(done)
    did.go()
    assert did.steps == list(range(done + 1, 10))


def test_only_the_first_process_writes(training):
    did = training(rank=1)
    did.go()
    assert did.steps == list(range(1, 10))
    assert not did.run.folder.exists() and not did.evaluated + did.measured


def test_without_evaluations_it_measures_when_it_is_time(training):
    did = training(eval_every=0, due=(2, 5, 6))
    did.go()
    assert did.evaluated == [] and did.measured == [2, 6]


@pytest.mark.parametrize(
    ("part", "step", "says"),
    [
        ("loss", 2, "step 2 & NaN & loss"),
        ("loss", 7, "step 7 & loss & step 5"),
        ("weight", 3, "step 4 & weight"),
    ],
)
def test_a_training_that_diverges_stops_before_it_is_saved(training, part, step, says):
    training.wrong[part] = step
    with pytest.raises(ModelError) as caught:
        training().go()
    assert all(fact in str(caught.value) for fact in says.split(" & "))
