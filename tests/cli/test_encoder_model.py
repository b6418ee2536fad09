"""A model with features of a Hugging Face encoder, from the configuration to motion."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import yaml

import gesturekit as gk
from audio_features import FeatureTrack
from gesturekit import Motion
from gesturekit.corpus import Manifest

pytestmark = pytest.mark.usefixtures("no_network")


@pytest.fixture
def hubert(write_encoder, tmp_path):
    write_encoder(tmp_path / "hubert", "hubert")
    return tmp_path / "hubert"


def extractors(folder) -> str:
    return f"features.extractors=[{{kind: hf, path: {folder}, layer: 2}}, {{kind: prosody}}]"


def test_from_an_encoder_to_motion(
    gesturekit, corpus, light, hubert, write_speech, write_encoder, tmp_path, tiny
):
    run = tmp_path / "run"
    done = gesturekit("train", light, f"corpus={corpus}", f"out={run}", extractors(hubert), *tiny)
    assert done.status == 0, done.err
    spec = yaml.safe_load((run / "model" / "config.yaml").read_text())["features"]["spec"]
    assert spec["parts"][0]["kind"] == "hf" and "path" not in spec["parts"][0]
    (fingerprint,) = re.findall(r"[0-9a-f]{64}", str(spec))
    assert "hf (model hubert, layer 2" in gesturekit("inspect", run / "model").out
    assert gesturekit("train", "--resume", run).status == 0

    speech = write_speech(tmp_path / "speech.wav", 1.3)
    render = ("render", speech, "--model", run / "model", "--out", tmp_path / "out")
    without = gesturekit(*render)
    assert without.status == 2 and "--weights" in without.err and fingerprint in without.err
    write_encoder(tmp_path / "other", "hubert", seed=1)
    refused = gesturekit(*render, "--weights", tmp_path / "other")
    assert refused.status == 2 and len(refused.err.splitlines()) == 1
    found = set(re.findall(r"[0-9a-f]{64}", refused.err))
    assert fingerprint in found and len(found) == 2
    assert not (tmp_path / "out").exists()
    moved = hubert.rename(tmp_path / "moved")
    assert gesturekit(*render, "--weights", moved).status == 0
    assert Motion.load(tmp_path / "out" / "speech.bvh").n_frames == 39


def test_training_names_the_folder_that_is_wrong(gesturekit, corpus, light, tmp_path, tiny):
    train = ("train", light, f"corpus={corpus}", f"out={tmp_path / 'run'}", *tiny)
    for where, complaint in (
        (extractors(tmp_path / "none"), "none: no such folder"),
        ("features.extractors=[{kind: hf}]", "path: FOLDER"),
        ("features.extractors=[{kind: wavlm}, {kind: hf, path: a}]", "weights of WavLM are needed"),
        ("features.extractors=[{kind: hf, path: a}, {kind: hf, path: b}]", "2 of kind hf"),
        ("features.extractors=[{kind: words, encoder: a}]", "a: no such folder"),
    ):
        done = gesturekit(*train, where)
        assert done.status == 2 and complaint in done.err, done.err
        assert len(done.err.splitlines()) == 1


def test_a_model_takes_a_speech_and_a_text_encoder(
    gesturekit, corpus, light, write_wavlm, write_text_encoder, write_speech, tmp_path, tiny
):
    wavlm, text = tmp_path / "wavlm", tmp_path / "text"
    write_wavlm(wavlm)
    write_text_encoder(text)
    (tmp_path / "speech.tsv").write_text("0.1\t0.4\tso\n0.5\t0.9\thands\n", encoding="utf-8")
    said = {"words": tmp_path / "speech.tsv"}
    Manifest([replace(item, conditions=said) for item in Manifest.load(corpus)]).save(
        tmp_path / "corpus.jsonl"
    )
    both = f"[{{kind: wavlm, layer: 2}}, {{kind: words, encoder: {text}, layer: 1}}]"
    done = gesturekit(
        *("train", light, f"corpus={tmp_path / 'corpus.jsonl'}", f"out={tmp_path / 'run'}"),
        *(f"features.extractors={both}", f"features.weights={wavlm}", *tiny),
    )
    assert done.status == 0, done.err
    named = ("--weights", f"wavlm={wavlm}", "--weights", f"words={text}")
    assert " ".join(named) in done.out
    assert gesturekit("train", "--resume", tmp_path / "run").status == 0

    speech, model = write_speech(tmp_path / "speech.wav", 1.3), tmp_path / "run" / "model"
    render = ("render", speech, "--model", model, "--out", tmp_path / "out")
    for given, complaint in (
        (("--weights", wavlm), "(--weights wavlm=PATH --weights words=PATH)"),
        (named[:2], "weights of the text encoder bert with fingerprint"),
        (
            ("--weights", wavlm, *named[2:]),
            f"--weights {wavlm}: with several encoders, give KIND=PATH",
        ),
        ((*named, *named[2:]), "words is given twice"),
        (("--weights", f"wavml={wavlm}", *named[2:]), "'wavml' is not an encoder"),
        (("--weights", f"wavlm={text}", "--weights", f"words={wavlm}"), "text"),
    ):
        done = gesturekit(*render, *given)
        assert done.status == 2 and complaint in done.err, done.err
    assert gesturekit(*render, *named).status == 0
    loaded = gk.load(model, weights={"wavlm": wavlm, "words": text})
    assert loaded.conditions.conditioner.extractor.dim == 32 + 16
    again, first = loaded.generate(speech, seed=0), Motion.load(tmp_path / "out" / "speech.bvh")
    np.testing.assert_allclose(again.positions(), first.positions(), atol=1e-4)
    (tmp_path / "speech.tsv").write_text("0.2\t0.4\tno\n", encoding="utf-8")
    assert "other words" in gesturekit(*render, *named).err


def test_features_and_doctor_take_the_folder(gesturekit, hubert, write_speech, tmp_path):
    wav = write_speech(tmp_path / "a.wav", 1.0)
    out = tmp_path / "out"
    options = ("--layer", "1:1,2:3", "--out", out)
    done = gesturekit("features", wav, "--extractor", f"hf:{hubert},prosody", *options)
    assert done.status == 0 and "HuBERT, Hugging Face folder: 3 layers of 32" in done.out
    track = FeatureTrack.load(out / "a.npz")
    assert track.spec["parts"][0]["layer"] == {"1": 1.0, "2": 3.0}
    same = ("--extractor", "hf,prosody", "--weights", hubert, *options, "--existing", "replace")
    assert gesturekit("features", wav, *same).status == 0
    np.testing.assert_array_equal(FeatureTrack.load(out / "a.npz").values, track.values)
    wrong = gesturekit("features", wav, "--extractor", "hf", "--dtype", "bf16", *options)
    assert wrong.status == 2 and "--dtype requires --extractor wavlm" in wrong.err
    found = gesturekit("doctor", "--weights", hubert)
    assert found.status == 0 and "HuBERT, Hugging Face folder" in found.out
    (hubert / "model.safetensors").write_bytes(b"damaged")
    broken = gesturekit("doctor", "--weights", hubert)
    assert broken.status == 1 and "cannot be read as weights" in broken.out
