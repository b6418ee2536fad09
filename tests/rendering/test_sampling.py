"""Samples for the papers' protocols: each recording in its own style, with noise of its own."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gesturekit as gk
from gesturekit import Motion
from gesturekit.corpus import Item, Manifest
from gesturekit.rendering.samples import SamplingOptions, sample_lda, sample_multires, sounds_of
from gesturekit.training.config import build

RAISED = 2.0  # radians by which the arms of style b are higher
FEW = {"first_stage": 30, "further_stages": 10, "discriminator_steps": 1, "batch": 4}
SMALL = {"blocks": 2, "layers": 1, "channels": 32, "heads": 2, "feedforward": 32, "embedding": 16}
SETTINGS = {
    "multires": {
        "network": {"levels": 4, "channels": [4, 4, 4], "embedding": 4, "modulate": "all"},
        "training": FEW | {"window": 2.0, "window_cache": 4, "learning_rate": 1e-2},
    },
    "diffusion": {
        "network": SMALL,
        "noise": {"steps": 8, "last_beta": 0.5, "predict": "clean"},
        "training": {"updates": 120, "batch": 8, "window": 2.0, "learning_rate": 5e-3},
    },
}


@pytest.fixture(scope="module")
def corpus(tmp_path_factory, gesture, write_speech) -> Path:
    """A manifest: arms hang in style a and are raised in style b; ids do not show the style."""
    folder = tmp_path_factory.mktemp("styles")

    def recording(name: str, style: str, seconds: float, split: str) -> Item:
        motion = gesture(seconds, 25.0, seed=len(name))
        for side, sign in (("LeftArm", 1), ("RightArm", -1)):
            arm = motion.rotations[:, motion.skeleton.index(side)]
            angles = Rotation.from_quat(arm).as_euler("xyz")
            angles[:, 2] += sign * RAISED * (style == "b")
            arm[:] = Rotation.from_euler("xyz", angles).as_quat()
        path = folder / f"{name}.bvh"
        motion.save(path)
        sound = write_speech(folder / f"{name}.wav", seconds)
        about = {"duration": seconds, "style": style, "split": split}
        return Item(id=name, audio=sound, motion=path, **about)

    every = [("one", "a", 6.0, "train"), ("two", "b", 6.0, "train")]
    every += [("three", "b", 21.0, "test"), ("four", "a", 11.0, "test")]
    Manifest([recording(*values) for values in every]).save(folder / "corpus.jsonl")
    return folder / "corpus.jsonl"


@pytest.fixture(scope="module", params=["multires", "diffusion"])
def styled(request, corpus, tmp_path_factory):
    """A model that has learned both styles of the corpus."""
    run = tmp_path_factory.mktemp("run") / request.param
    values = {"corpus": str(corpus), "out": str(run), "fps": 25, "threads": 1, "features": None}
    values |= {"system": request.param, "styles": {}, **SETTINGS[request.param]}
    if request.param == "multires":
        from gesturekit.multires import MultiresConfig as Config
        from gesturekit.multires import train
    else:
        from gesturekit.diffusion import DiffusionConfig as Config
        from gesturekit.diffusion import train
    return gk.load(train(build(Config, values)))


def named(corpus: Path, name: str) -> Item:
    (item,) = (item for item in Manifest.load(corpus) if item.id == name)
    return item


def style_of(motion: Motion) -> str:
    hand = motion.positions()[:, motion.skeleton.index("LeftHand"), 1]
    return "b" if (hand - motion.positions()[:, 0, 1]).mean() > 0.35 else "a"


@pytest.mark.stress  # of seconds: test_protocols.py asks a stand-in which style it was given
def test_every_recording_is_sampled_in_its_own_style(styled, corpus, tmp_path):
    manifest = Manifest.load(corpus)
    for sample, split in ((sample_multires, "train"), (sample_lda, "test")):
        items = manifest.in_split(split)
        known = {item.id: item.style for item in items}
        files = list(sample(styled, items, tmp_path / split, SamplingOptions(samples=2)))
        found = {file.stem: style_of(Motion.load(file)) for file in files}
        assert found == {name: known[name.split("_")[0]] for name in found}
        assert {style_of(item.load_motion()) for item in items} == {"a", "b"}


def test_windows_and_samples_have_noise_of_their_own(model, corpus, tmp_path):
    long = named(corpus, "three")
    files = list(sample_lda(model, [long], tmp_path, SamplingOptions(samples=2)))
    moved = [Motion.load(file).rotations for file in files]
    moved = [values - values.mean(axis=0) for values in moved]
    together = [np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in combinations(moved, 2)]
    assert np.abs(together).max() < 0.6 and np.ptp(moved, axis=1).max() > 0.01
    again = list(sample_lda(model, [long], tmp_path / "again", SamplingOptions(samples=1)))
    assert np.array_equal(Motion.load(again[0]).rotations, Motion.load(files[0]).rotations)
    other = SamplingOptions(samples=1, seed=1)
    (reseeded, *_) = sample_lda(model, [long], tmp_path / "other", other)
    assert not np.array_equal(Motion.load(reseeded).rotations, Motion.load(files[0]).rotations)


def test_sampling_goes_on_where_it_was(model, tmp_path, write_speech):
    write_speech(tmp_path / "in" / "a.wav", 10.0)
    sounds, out = sounds_of(tmp_path / "in"), tmp_path / "out"
    files = list(sample_lda(model, sounds, out, SamplingOptions(samples=2)))
    files[1].unlink()
    before = files[0].stat().st_mtime_ns
    assert list(sample_lda(model, sounds, out, SamplingOptions(samples=2, skip=True))) == files
    assert files[0].stat().st_mtime_ns == before and files[1].is_file()


def test_a_recording_is_sampled_at_twice_its_length_and_the_models_rate(model, corpus, tmp_path):
    item = named(corpus, "one")
    faster = replace(model, recorded_fps=50.0)  # at which `generate` returns motion by default
    for name, given in {"speech": item, "silence": replace(item, audio=None)}.items():
        path = next(sample_multires(faster, [given], tmp_path / name, SamplingOptions(samples=1)))
        motion = Motion.load(path)
        assert (motion.fps, motion.duration) == (25.0, pytest.approx(12.0, abs=0.05))
