"""A corpus of upper bodies alone: prepared, trained, rendered, inspected and judged."""

import logging
from pathlib import Path

import numpy as np
import pytest

import gesturekit as gk
from gesturekit.corpus import prepare
from gesturekit.motion import Motion
from gesturekit.training.recipes import recipe_table

DEBUG = recipe_table()["debug"]
FEATURES = "features.extractors=[{kind: prosody}, {kind: effort, seconds: 2}]"
STATE = ("losses.arm_speed=3", "losses.detail=1")


def upper(motion: Motion) -> Motion:
    """The motion without the joints of the legs; the end of the hips shows no leg either."""
    legs = ("UpLeg", "Leg", "Foot")
    return motion.keep([n for n in motion.skeleton.names if not n.endswith(legs)])


@pytest.fixture(scope="module")
def recordings(tmp_path_factory, gesture, write_speech) -> Path:
    folder = tmp_path_factory.mktemp("upper") / "recordings"
    for seed, stem in enumerate(("a", "b")):
        write_speech(folder / f"{stem}.wav", 3.0)
        upper(gesture(3.0, seed=seed)).save(folder / f"{stem}.bvh")
    return folder


@pytest.fixture(scope="module")
def corpus(recordings) -> Path:
    report = prepare([recordings], recordings.parent / "corpus.jsonl", holdout=0.0)
    (note,) = [str(p) for p in report.problems if "legs" in str(p)]
    assert all(what in note for what in ("contacts", "locking", "metrics"))
    return recordings.parent / "corpus.jsonl"


def test_multires_trains_and_renders_it(corpus, recordings, gesturekit, tmp_path, caplog):
    train = ("multires_speech/light", *DEBUG["multires"], FEATURES, *STATE)
    with caplog.at_level(logging.INFO):
        gesturekit("train", *train, f"corpus={corpus}", f"out={tmp_path / 'run'}").ok()
    assert caplog.text.count("legs") == 1 and "parts:" not in caplog.text
    assert '"arm_speed"' in (tmp_path / "run" / "metrics.jsonl").read_text()
    model = gk.load(tmp_path / "run")
    assert {"left movement", "right height", "coupling"} <= {*model.state_process.channels.names}
    render = ("render", recordings / "a.wav", "--model", tmp_path / "run", "--format", "bvh,png")
    gesturekit(*render, "--out", tmp_path / "out").ok()
    assert Motion.load(tmp_path / "out" / "a.bvh").skeleton.n_joints == 13


def test_diffusion_trains_and_renders_it(corpus, recordings, gesturekit, tmp_path, caplog):
    train = ("diffusion_speech/small", *DEBUG["diffusion"], FEATURES, "noise.steps=4")
    with caplog.at_level(logging.INFO):
        gesturekit("train", *train, f"corpus={corpus}", f"out={tmp_path / 'run'}").ok()
    assert "parts:" not in caplog.text
    made = gk.load(tmp_path / "run").generate(recordings / "a.wav")
    assert made.n_frames == 90 and np.isfinite(made.positions()).all()
