"""Seeds of recall: of the moods, and of everything else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import audio_features as af
import gesturekit as gk
from gesturekit.errors import ModelError
from gesturekit.multires.recall.library import RecallLibrary
from gesturekit.systems import bundled_speech


@pytest.fixture(scope="module")
def model() -> gk.Model:
    """A model with recall."""
    return gk.load("demo")


@pytest.fixture
def drawn(model, monkeypatch):
    """drawn(**asked): (first moods, first pieces) of each sample, as numbers."""
    recall, found = RecallLibrary.recall, []

    def spy(self, speech, rng_of, **asked):
        found.append(tuple(rng_of(name).initial_seed() for name in ("mood", "left arm")))
        return recall(self, speech, rng_of, **asked)

    def made(**asked) -> list[tuple[int, int]]:
        found.clear()
        model.generate(af.Wave.load(bundled_speech(), duration=1.0), **asked)
        return list(found)

    monkeypatch.setattr(RecallLibrary, "recall", spy)
    return made


def test_a_mood_seed_fixes_the_moods_and_nothing_else(drawn):
    ((mood, pieces),) = drawn(seed=3)
    assert drawn(seed=3, mood_seed=3) == [(mood, pieces)], "the default is the seed"
    assert drawn(seed=3, mood_seed=np.int64(3)) == [(mood, pieces)]
    ((other_mood, same_pieces),) = drawn(seed=3, mood_seed=4)
    assert other_mood != mood and same_pieces == pieces
    ((same_mood, other_pieces),) = drawn(seed=5, mood_seed=3)
    assert same_mood == mood and other_pieces != pieces


def test_items_and_samples_have_moods_of_their_own_at_one_mood_seed(drawn):
    each = [*drawn(mood_seed=3, samples=2), *drawn(mood_seed=3, item="a", samples=2)]
    assert len(each) == len(set(each)) == 4
    assert len({mood for mood, _ in each}) == len({pieces for _, pieces in each}) == 4


def test_a_mood_seed_without_recall_is_an_error(model):
    plain, like = replace(model, library=None), model.generate(seconds=1.0)
    for some, asked, said in (
        (plain, {}, "mood_seed=0: only models trained with recall"),
        (model, {"recall": False}, "mood_seed=0: without recall it has no effect"),
        (model, {"like": like}, "mood_seed=0: like sets the movement"),
    ):
        for call in (some.check_controls, some.generate):
            with pytest.raises(ModelError, match=said):
                call(mood_seed=0, **asked)
    for value in (-1, 1.5, "one", True):
        with pytest.raises(ModelError, match="mood_seed=.*: expected an integer at least 0"):
            model.check_controls(mood_seed=value)


def test_the_command_line_has_the_mood_seed(gesturekit, tmp_path):
    made = ("render", "--seconds", 1, "--model", "demo", "--out", tmp_path / "out")
    gesturekit(*made, "--mood-seed", 3).ok()
    gesturekit(*made, "--mood-seed", 3).ok()
    gesturekit(*made, "--mood-seed", 4).fails(2, "another mood_seed")
    gesturekit(*made, "--mood-seed", -1).fails(2, "--mood-seed")
    gesturekit(*made, "--mood-seed", 3, "--no-recall").fails(2, "without recall it has no effect")
