"""A model that hears by WavLM, from the paper's configuration to motion, without a network."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from gesturekit import Motion

CONFIG = Path(__file__).resolve().parents[2] / "recipes" / "multires_speech" / "config.yaml"


pytestmark = pytest.mark.usefixtures("no_network")


def test_from_weights_to_motion(gesturekit, corpus, write_speech, write_wavlm, tmp_path, tiny):
    weights = tmp_path / "wavlm"
    write_wavlm(weights)
    run = tmp_path / "run"
    done = gesturekit(
        "train", CONFIG, f"corpus={corpus}", f"out={run}", f"features.weights={weights}", *tiny
    )
    assert done.status == 0 and f"Model: {run / 'model'}" in done.out
    spec = yaml.safe_load((run / "model" / "config.yaml").read_text())["features"]["spec"]
    (fingerprint,) = re.findall(r"[0-9a-f]{64}", str(spec))

    speech = write_speech(tmp_path / "speech.wav", 1.3)
    render = ("render", speech, "--model", run / "model", "--out", tmp_path / "out")

    without = gesturekit(*render)
    assert without.status == 2
    assert "--weights" in without.err and fingerprint in without.err

    other = tmp_path / "other"
    write_wavlm(other, seed=1)
    refused = gesturekit(*render, "--weights", other)
    assert refused.status == 2
    found = set(re.findall(r"[0-9a-f]{64}", refused.err))
    assert fingerprint in found and len(found) == 2
    assert len(refused.err.splitlines()) == 1

    nowhere = gesturekit(*render, "--weights", tmp_path / "nowhere")
    assert nowhere.status == 2 and "nowhere: no such folder" in nowhere.err
    assert not (tmp_path / "out").exists()

    # What counts is what the weights are, not where they lie.
    moved = weights.rename(tmp_path / "moved")
    assert gesturekit(*render, "--weights", moved).status == 0
    assert Motion.load(tmp_path / "out" / "speech.bvh").n_frames == 39


def test_training_asks_for_the_weights_before_it_listens(gesturekit, corpus, tmp_path, tiny):
    done = gesturekit("train", CONFIG, f"corpus={corpus}", f"out={tmp_path / 'run'}", *tiny)
    assert done.status == 2
    assert done.err.startswith("Error: WavLM weights are needed")
