"""Held-out recordings that a training measures: the choice, the length of each, the times."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from small_runs import small_diffusion

from gesturekit.corpus import Item, Manifest
from gesturekit.training.held_out import HeldOutMetrics


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
        config = small_diffusion(
            tmp_path / "c.jsonl", tmp_path / "run", {"measure": True}, changes or {}
        )
        run = SimpleNamespace(folder=tmp_path / "run")
        return HeldOutMetrics(config, run, speech=speech, styles=styles)

    return make


def chosen(made: HeldOutMetrics) -> list[tuple[str, str, float]]:
    return [(item.id, item.split, item.duration) for item in made.items]


def test_two_minutes_of_test_items_are_measured_whole(metrics):
    made = metrics(speech=False, train=[9.0], valid=[9.0], test=[15.0] * 8)
    assert chosen(made) == [(f"test{k}", "test", 15.0) for k in range(8)]
    assert re.search(r"(?=.*\b8\b)(?=.*held-out)(?=.*2 min)", made.what) and made.seconds == 120.0
    assert made.is_held_out and made.folder.name == "held_out"


def test_a_run_that_does_not_measure_has_nothing_to_measure(metrics):
    made = metrics(test=[15.0], changes={"measure": False})
    assert made.items == () and made.seconds == 0 and made.measure(1, None) == ""


def test_of_more_at_most_six_are_measured_and_cut_to_that(metrics):
    made = metrics(speech=False, test=[20.0] * 6 + [90.0])
    # Every other one of seven: 30 s of each, or the 20 s that it has.
    assert chosen(made) == [
        *(("test0", "test", 20.0), ("test2", "test", 20.0), ("test4", "test", 20.0)),
        ("test6", "test", 30.0),
    ]
    assert re.search(r"(?=.*\b4\b)(?=.*\b7\b)(?=.*held-out)(?=.*2 min)(?=.*4 min)", made.what)
    assert len(metrics(speech=False, test=[30.0] * 6).items) == 6
    assert {d for *_, d in chosen(metrics(speech=False, test=[30.0] * 6))} == {20.0}


def test_validation_and_then_training_items_stand_for_test_items(metrics):
    made = metrics(speech=False, train=[9.0], valid=[5.0])
    assert chosen(made) == [("valid0", "test", 5.0)] and made.is_held_out
    made = metrics(speech=False, train=[9.0])
    assert chosen(made) == [("train0", "train", 9.0)] and not made.is_held_out
    assert re.search(r"(?=.*\b1\b)(?=.*training)(?=.*9 s)", made.what)


def test_items_without_the_inputs_of_the_model_are_not_measured(metrics):
    assert [item.id for item in metrics(test=[5.0] * 4).items] == ["test0", "test2", "test3"]
    calm = metrics(styles={"calm"}, test=[5.0] * 4)
    assert [item.id for item in calm.items] == ["test2"]
    # Test items of other styles: those of the validation are measured.
    assert [i.id for i in metrics(styles={"calm"}, valid=[5.0] * 3, test=[5.0]).items] == ["valid2"]
    assert metrics(styles={"old"}, test=[5.0]).items == ()


def test_a_corpus_that_cannot_be_read_is_warned_about(metrics, caplog):
    made = metrics(test=[5.0])
    made.config.corpus.unlink()
    assert made.items == () and str(made.config.corpus) in caplog.text
    assert made.measure(3, None) == ""
