"""Models with features of WavLM and other encoders, from the configuration to motion."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from safetensors.torch import load_file

import gesturekit as gk
from audio_features import FeatureTrack
from gesturekit import Motion
from gesturekit.corpus import Manifest
from gesturekit.inspection import inspect
from gesturekit.training.recipes import recipe_table

RECIPES = Path(__file__).resolve().parents[2] / "recipes"
CONFIG = RECIPES / "multires_speech" / "config.yaml"

pytestmark = pytest.mark.usefixtures("no_network")


@pytest.mark.stress  # of seconds: `test_a_model_takes_a_speech_and_a_text_encoder`
@pytest.mark.parametrize("kind", ["hf", "wavlm"])
def test_from_weights_to_motion(
    kind, gesturekit, corpus, light, write_speech, write_wavlm, write_encoder, tmp_path, tiny
):
    """Weights of WavLM by the paper's configuration, and a folder of Hugging Face."""
    weights, other, run = (tmp_path / name for name in ("weights", "other", "run"))
    for number, folder in enumerate((weights, other)):
        if kind == "wavlm":
            write_wavlm(folder, seed=number)
        else:
            write_encoder(folder, "hubert", seed=number)
    config, setting = CONFIG, f"features.weights={weights}"
    if kind == "hf":
        parts = f"[{{kind: hf, path: {weights}, layer: 2}}, {{kind: prosody}}]"
        config, setting = light, f"features.extractors={parts}"
    done = gesturekit("train", config, f"corpus={corpus}", f"out={run}", setting, *tiny)
    assert done.status == 0 and str(run / "model") in done.out, done.err
    spec = yaml.safe_load((run / "model" / "config.yaml").read_text())["features"]["spec"]
    assert f"'kind': '{kind}'" in str(spec) and "path" not in str(spec)
    (fingerprint,) = re.findall(r"[0-9a-f]{64}", str(spec))
    if kind == "hf":
        assert re.search(r"(?=.*hubert)(?=.*\b2\b)", gesturekit("inspect", run / "model").out)
    assert gesturekit("train", "--resume", run).status == 0
    speech = write_speech(tmp_path / "speech.wav", 1.3)
    render = ("render", speech, "--model", run / "model", "--out", tmp_path / "out")
    gesturekit(*render).fails(2, "--weights", fingerprint)
    refused = gesturekit(*render, "--weights", other)
    assert refused.status == 2 and len(refused.err.splitlines()) == 1
    found = set(re.findall(r"[0-9a-f]{64}", refused.err))
    assert fingerprint in found and len(found) == 2
    gesturekit(*render, "--weights", tmp_path / "nowhere").fails(2, "nowhere")
    assert not (tmp_path / "out").exists()
    # What counts is what the weights are, not where they lie.
    moved = weights.rename(tmp_path / "moved")
    assert gesturekit(*render, "--weights", moved).status == 0
    assert Motion.load(tmp_path / "out" / "speech.bvh").n_frames == 39


def test_training_names_the_weights_that_are_missing(gesturekit, corpus, light, tmp_path, tiny):
    """In one line, before features are extracted."""
    train = ("train", light, f"corpus={corpus}", f"out={tmp_path / 'run'}", *tiny)
    for extractors, complaint in (
        ("[{kind: hf}]", "path"),
        ("[{kind: wavlm}]", "WavLM"),
        ("[{kind: hf, path: a}, {kind: hf, path: b}]", "extractors"),
        ("[{kind: words, encoder: nowhere}]", "nowhere"),
    ):
        done = gesturekit(*train, f"features.extractors={extractors}").fails(2, complaint)
        assert len(done.err.splitlines()) == 1


def test_a_model_takes_a_speech_and_a_text_encoder(
    gesturekit, corpus, light, write_wavlm, write_text_encoder, write_speech, tmp_path, tiny
):
    wavlm, other, text = (tmp_path / name for name in ("wavlm", "other", "text"))
    write_wavlm(wavlm)
    write_wavlm(other, seed=1)
    write_text_encoder(text)
    (tmp_path / "speech.tsv").write_text("0.1\t0.4\tso\n0.5\t0.9\thands\n", encoding="utf-8")
    said = {"words": tmp_path / "speech.tsv"}
    items = [replace(item, conditions=said) for item in Manifest.load(corpus)]
    Manifest(items).save(tmp_path / "corpus.jsonl")
    both = f"[{{kind: wavlm, layer: 2}}, {{kind: words, encoder: {text}, layer: 1}}]"
    files = (f"corpus={tmp_path / 'corpus.jsonl'}", f"out={tmp_path / 'run'}")
    features = (f"features.extractors={both}", f"features.weights={wavlm}")
    done = gesturekit("train", light, *files, *features, *tiny).ok()
    named = ("--weights", f"wavlm={wavlm}", "--weights", f"words={text}")
    assert " ".join(named) in done.out
    speech, model = write_speech(tmp_path / "speech.wav", 1.3), tmp_path / "run" / "model"
    config = (model / "config.yaml").read_text()
    assert str(tmp_path) not in config, "the weights may lie elsewhere"
    fingerprints = re.findall(r"[0-9a-f]{64}", config)
    render = ("render", speech, "--model", model, "--out", tmp_path / "out")
    for given, complaint in (
        (("--weights", wavlm), "--weights words=PATH"),
        (named[:2], "bert"),
        (("--weights", wavlm, *named[2:]), "KIND=PATH"),
        ((*named, *named[2:]), "words"),
        (("--weights", f"wavml={wavlm}", *named[2:]), "'wavml'"),
        (("--weights", f"wavlm={text}", "--weights", f"words={wavlm}"), f"{text}"),
    ):
        gesturekit(*render, *given).fails(2, complaint)
    refused = gesturekit(*render, "--weights", f"wavlm={other}", *named[2:]).fails(2).err
    assert any(fingerprint in refused for fingerprint in fingerprints)
    assert gesturekit(*render, *named).status == 0
    loaded = gk.load(model, weights={"wavlm": wavlm, "words": text})
    assert loaded.conditions.conditioner.extractor.dim == 32 + 16
    again, first = loaded.generate(speech, item="speech"), Motion.load(tmp_path / "out/speech.bvh")
    np.testing.assert_allclose(again.positions(), first.positions(), atol=1e-4)
    (tmp_path / "speech.tsv").write_text("0.2\t0.4\tno\n", encoding="utf-8")
    gesturekit(*render, *named).fails(2, "words", "speech.bvh")


def test_features_and_doctor_take_the_folder(gesturekit, write_encoder, write_speech, tmp_path):
    wav, hubert, out = write_speech(tmp_path / "a.wav", 1.0), tmp_path / "hubert", tmp_path / "out"
    write_encoder(hubert, "hubert")
    options = ("--layer", "1:1,2:3", "--out", out)
    done = gesturekit("features", wav, "--extractor", f"hf:{hubert},prosody", *options).ok()
    assert "HuBERT" in done.out
    track = FeatureTrack.load(out / "a.npz")
    assert track.spec["parts"][0]["layer"] == {"1": 1.0, "2": 3.0}
    same = ("--extractor", "hf,prosody", "--weights", hubert, *options, "--existing", "replace")
    gesturekit("features", wav, *same).ok()
    np.testing.assert_array_equal(FeatureTrack.load(out / "a.npz").values, track.values)
    assert "HuBERT" in gesturekit("doctor", "--weights", hubert).ok().out
    (hubert / "model.safetensors").write_bytes(b"damaged")
    assert "model.safetensors" in gesturekit("doctor", "--weights", hubert).fails(1).out


DIFFUSION = (
    *recipe_table()["debug"]["diffusion"],
    "noise.steps=8",
    "features.extractors=[{kind: wavlm, layer: last}, {kind: effort}]",
    "features.components=5",
)


@pytest.mark.parametrize(
    "recipe, count, dim",
    [
        pytest.param("multires_speech/wavlm", 24, 31, marks=pytest.mark.stress),
        ("diffusion_speech/small", 5, 8),
    ],
)
def test_a_model_of_components(
    gesturekit, corpus, write_speech, write_wavlm, tmp_path, tiny, recipe, count, dim
):
    weights, run = tmp_path / "wavlm", tmp_path / "run"
    write_wavlm(weights)
    settings = tiny if recipe.startswith("multires") else DIFFUSION
    given = (f"corpus={corpus}", f"out={run}", f"features.weights={weights}", *settings)
    gesturekit("train", RECIPES / f"{recipe}.yaml", *given).ok()
    tensors = load_file(run / "model" / "model.safetensors")
    assert tensors["features.components"].shape == (32, count)
    reduction = dict(inspect(run / "model").rows)["reduced features"]
    assert reduction in (run / "model" / "README.md").read_text()
    assert re.search(rf"(?=.*\b32\b)(?=.*\b{count}\b)", reduction)
    model = gk.load(run / "model", weights=weights)
    assert model.conditions.conditioner.dim == dim
    assert model.generate(write_speech(tmp_path / "speech.wav", 1.3)).n_frames == 39
