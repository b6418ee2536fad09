"""Baselines that a model renders."""

import numpy as np
import pytest

import gesturekit as gk
from gesturekit.corpus import Manifest, prepare
from gesturekit.errors import ConfigError
from gesturekit.rendering.samples import other_sounds, render_baseline, split_sounds


def test_each_item_gets_the_sound_of_the_next_as_long_as_its_own(write_pair, tmp_path):
    for number, seconds in enumerate((2.0, 5.0, 3.0)):
        write_pair(tmp_path / "r", f"take{number}", seconds, seed=number)
    manifest = tmp_path / "corpus.jsonl"
    prepare([tmp_path / "r"], manifest, holdout=0.0)
    own, other = split_sounds(manifest, "train"), other_sounds(manifest, "train")
    assert [*own] == [*other] == ["take0", "take1", "take2"]
    for name, following in (("take0", "take1"), ("take1", "take2"), ("take2", "take0")):
        assert len(other[name].samples) == len(own[name].samples)
        length = min(len(own[name].samples), len(own[following].samples))
        np.testing.assert_array_equal(other[name].samples[:length], own[following].samples[:length])
    # A shorter sound is repeated.
    short = own["take0"].samples
    np.testing.assert_array_equal(other["take2"].samples[len(short) :], short[:16000])


def test_one_held_out_item_gets_training_speech_and_a_single_item_is_refused(write_pair, tmp_path):
    write_pair(tmp_path / "r", "take", 20.0, seed=1)
    prepare([tmp_path / "r"], tmp_path / "cut.jsonl")
    manifest = Manifest.load(tmp_path / "cut.jsonl")
    (test,), (train,) = (manifest.paired(split) for split in ("test", "train"))
    other = other_sounds(tmp_path / "cut.jsonl", "test")[test.id]
    np.testing.assert_array_equal(other.samples, train.load_wave().samples[: len(other.samples)])
    prepare([tmp_path / "r"], tmp_path / "whole.jsonl", holdout=0.0)
    with pytest.raises(ConfigError, match=r"whole\.jsonl"):
        other_sounds(tmp_path / "whole.jsonl", "train")


def test_each_rendered_item_is_a_draw_of_its_own(model, write_pair, tmp_path):
    write_pair(tmp_path / "r", "take", 2.0)
    prepare([tmp_path / "r"], tmp_path / "corpus.jsonl", holdout=0.0)
    (wave,) = split_sounds(tmp_path / "corpus.jsonl", "train").values()
    names = ("one", "day/two")
    files = render_baseline(model, dict.fromkeys(names, wave), tmp_path / "out", seed=2)
    for name, file in zip(names, files, strict=True):
        wanted = model.generate(wave, seed=2, item=name)
        np.testing.assert_array_equal(gk.Motion.load(file).rotations, wanted.rotations)
