"""The plan of a training: its time, worked out by hand from what a few parts of it take."""

from __future__ import annotations

import logging
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import pytest
from small_runs import small_config, small_diffusion

from gesturekit.corpus import Item, Manifest
from gesturekit.errors import ConfigError
from gesturekit.training.run import plan as module
from gesturekit.training.run.folder import Run
from gesturekit.training.run.plan import Estimate, log_arrays, log_plan, quickest


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """A clock of our own, by its one entry; 9 s were spent before."""
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(module.time, "process_time", lambda: 9.0)
    return now


@pytest.fixture
def plan(tmp_path, clock, caplog):
    """plan(is_long, **settings): messages of the plan of a training.

    An excerpt has two of four recordings, 20 s of 100 s, and 50 s are without speech. Its motion is
    read in half a second, and with features in one and a half.
    """
    caplog.set_level("INFO")

    def make(is_long: bool, **settings: Any) -> list[str]:
        def load_motion(parts: Any) -> None:
            clock[0] += 0.25

        def read() -> None:
            clock[0] += 1.5
            logging.getLogger("gesturekit").warning("read twice")

        def recordings() -> SimpleNamespace:
            logging.getLogger("gesturekit").warning("read before")
            items = [SimpleNamespace(duration=10.0, load_motion=load_motion)] * 2
            lengths = 100.0, 50.0
            return SimpleNamespace(
                items=items, whole=(items * 2, ()), lengths=lengths, is_long=lambda _: is_long
            )

        def estimate() -> Estimate:
            logging.getLogger("gesturekit").info("of the excerpt")
            logging.getLogger("gesturekit").warning("of all")
            return Estimate(training=20.0, held_out=50.0, rates=(2e7, 1e7))

        def trainer(config: Any, run: Run, *_: Any, **how: Any) -> SimpleNamespace:
            assert how == {"resume": False, "trial": True} and run.folder != config.out
            return SimpleNamespace(estimate=estimate)

        config = small_diffusion(tmp_path / "c.jsonl", tmp_path / "run", settings)
        log_plan(config, read, recordings, trainer)
        assert not (tmp_path / "run").exists() or settings
        return caplog.messages

    return make


def test_the_time_is_that_of_reading_training_and_measuring(plan):
    """Half a second for two of four recordings is one for all, and the features that took a second
    more are a fifth: 1 + 5 + 20 + 9, and a tenth of the 50 s that are measured.
    """
    assert plan(False) == [
        "of all",
        "Time: about 40 s on this machine while it is idle, 32 s to 80 s beside other programs. "
        "Nothing was written.",
    ]


def test_of_a_long_corpus_a_sample_is_read_and_arrays_are_made(plan, tmp_path):
    """20 MB a second of 100 s, and 10 MB of 50 s; two processes make them in half of the 6 s.

    In training a minute of two and a half is read: 2.4 s instead of 6 s.
    """
    folder = tmp_path / "arrays"
    messages = plan(True, in_memory=1.0, workers=2, arrays=str(folder))
    assert messages == [
        "of all",
        f"Arrays of 2.5 GB in {folder}; making those that are missing takes about 3 s.",
        "Time: about 36 s on this machine while it is idle, 29 s to 73 s beside other programs. "
        "Nothing was written.",
    ]


def test_a_plan_says_that_its_folder_is_in_use_but_not_that_a_file_is(plan, tmp_path):
    Run(tmp_path / "run", {}, resume=False).begin()
    first, *_, last = plan(False, seed=1)
    assert first.startswith("This cannot be trained yet: ") and "is not finished" in first
    assert last.startswith("Time: about 40 s")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="a file, not a run folder"):
        plan(False, out=str(tmp_path / "file"))


def test_the_quickest_of_some_calls_counts(clock):
    steps = iter([3.0, 1.0, 2.0])

    def work() -> None:
        clock[0] += next(steps)

    assert quickest(work, 3) == 1.0 and next(steps, None) is None


def test_arrays_are_named_or_said_to_be_of_no_use(tmp_path, caplog):
    caplog.set_level("INFO")
    config = small_diffusion(tmp_path / "c.jsonl", tmp_path / "run")
    log_arrays(config, True)
    log_arrays(config, False)
    assert caplog.messages == [
        f"The arrays of {tmp_path / 'c.jsonl'} are ready in {tmp_path / 'c.arrays'}.",
        f"{tmp_path / 'c.jsonl'} is held in memory: it needs no arrays (see in_memory).",
    ]


@pytest.mark.parametrize("system", ["diffusion", "multires"])
def test_the_plan_of_a_long_corpus_is_made_from_half_a_minute_of_it(
    tmp_path, gesture, monkeypatch, system
):
    """Eighty seconds of motion, of 5 frames a second."""
    trainer = import_module(f"gesturekit.{system}.training.trainer")
    read = {}

    def log_plan(config: Any, data: Any, recordings: Any, trained_by: type) -> None:
        read.update(data=data(), recordings=recordings(), trained_by=trained_by)

    monkeypatch.setattr(trainer, "log_plan", log_plan)
    gesture(80.0, 5.0).save(tmp_path / "a.npz")
    Manifest([Item(id="a", audio=None, motion=tmp_path / "a.npz", duration=80.0)]).save(
        tmp_path / "c.jsonl"
    )
    small = {"diffusion": small_diffusion, "multires": small_config}[system]
    config = small(tmp_path / "c.jsonl", tmp_path / "run", {"features": None, "fps": 5})
    trainer.plan_training(config)
    found = read["recordings"]
    assert sum(item.duration for item in found.items) == pytest.approx(30, abs=5)
    assert found.lengths == (80.0, 0.0) and read["trained_by"] is trainer.Trainer
    every = read["data"].recordings if system == "diffusion" else read["data"].paired
    frames = sum(one.n_frames for one in every if "mirrored" not in one.name)
    assert frames == pytest.approx(5 * 30, abs=25)
