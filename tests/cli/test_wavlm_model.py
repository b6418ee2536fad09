"""A model that hears by WavLM, from the paper's configuration to motion, without a network."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from safetensors.torch import load_file

import gesturekit as gk
from gesturekit import Motion
from gesturekit.inspection import inspect
from gesturekit.multires.recall.wanted import WantedMovement
from gesturekit.training.recipes import read_table

RECIPES = Path(__file__).resolve().parents[2] / "recipes"
CONFIG = RECIPES / "multires_speech" / "config.yaml"


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


def test_missing_weights_are_reported_before_features_are_extracted(
    gesturekit, corpus, tmp_path, tiny
):
    done = gesturekit("train", CONFIG, f"corpus={corpus}", f"out={tmp_path / 'run'}", *tiny)
    assert done.status == 2
    assert done.err.startswith("Error: weights of WavLM are needed")


DIFFUSION = (
    *read_table()["debug"]["diffusion"],
    "features.extractors=[{kind: wavlm, layer: last}, {kind: effort}]",
    "features.components=5",
)


@pytest.mark.parametrize(
    "recipe, count, dim", [("multires_speech/wavlm", 24, 31), ("diffusion_speech/small", 5, 8)]
)
def test_a_model_of_components(
    gesturekit, corpus, write_speech, write_wavlm, tmp_path, tiny, caplog, recipe, count, dim
):
    weights, run = tmp_path / "wavlm", tmp_path / "run"
    write_wavlm(weights)
    recalls = recipe.startswith("multires")
    settings = tiny if recalls else DIFFUSION
    given = (f"corpus={corpus}", f"out={run}", f"features.weights={weights}", *settings)
    with caplog.at_level("INFO"):
        done = gesturekit("train", RECIPES / f"{recipe}.yaml", *given)
    assert done.status == 0, done.err
    assert f"32 of {dim - count + 32} speech features reduced to {count}" in caplog.text
    # Recall weighs the components against the other features.
    assert ("Hand movement predicted from held-out speech" in caplog.text) == recalls
    tensors = load_file(run / "model" / "model.safetensors")
    assert tensors["features.components"].shape == (32, count)
    reduction = f"32 features reduced to {count} components"
    assert f"- **Reduced features**: {reduction}\n" in (run / "model" / "README.md").read_text()
    assert dict(inspect(run / "model").rows)["reduced features"] == reduction
    assert gk.load(run / "model", weights=weights).conditions.conditioner.dim == dim
    speech = write_speech(tmp_path / "speech.wav", 1.3)
    render = ("render", speech, "--model", run / "model", "--out", tmp_path / "out")
    more = () if recalls else ("--steps", 4)
    assert gesturekit(*render, "--weights", weights, *more).status == 0
    assert Motion.load(tmp_path / "out" / "speech.bvh").n_frames == 39


def test_recall_without_a_prediction(
    gesturekit, corpus, light, write_speech, tmp_path, tiny, caplog, monkeypatch
):
    run = tmp_path / "run"
    monkeypatch.setattr(WantedMovement, "predicts", False)
    with caplog.at_level("INFO"):
        done = gesturekit("train", light, f"corpus={corpus}", f"out={run}", *tiny)
    assert done.status == 0, done.err
    assert "Speech does not predict hand movement" in caplog.text
    library = gk.load(run / "model").library
    assert library.wanted is None and library.recordings
    speech = write_speech(tmp_path / "speech.wav", 1.3)
    assert gesturekit("render", speech, "--model", run / "model", "--out", tmp_path).status == 0
