"""A model of own features: from files, and from an installed package, from prepare to render."""

import re

import numpy as np
import pytest
from packages import install
from starlette.testclient import TestClient

import gesturekit as gk
from audio_features import FeatureError
from gesturekit.corpus import prepare
from gesturekit.errors import GestureKitError
from gesturekit.inspection import inspect
from gesturekit.motion import Motion
from gesturekit.serving import create_app

WIDTH, RATE = 3, 20
EXTRACTORS = (
    f"features.extractors=[{{kind: files, dim: {WIDTH}, suffix: .own.npy, rate: {RATE}}}, "
    "{kind: files, dim: 2}, {kind: loudness, gain: 2}, {kind: prosody}]"
)


def write_own(wav, seconds, seed=0):
    """Write STEM.own.npy and STEM.npz beside a sound."""
    rng = np.random.default_rng(seed)
    rows = 5 + np.cumsum(rng.standard_normal((round(seconds * RATE), WIDTH)), axis=0) / 5
    np.save(wav.with_suffix(".own.npy"), rows)
    times = np.arange(0, seconds, 0.2)
    np.savez(wav.with_suffix(".npz"), values=np.stack([times, times**2], axis=1), times=times)
    return wav


@pytest.fixture
def own_corpus(tmp_path, write_pair, write_speech):
    """The manifest of a folder in which sounds, motion and features lie side by side."""
    folder = tmp_path / "corpus"
    for stem, seconds in (("a", 3.0), ("b", 2.0)):
        write_own(write_pair(folder, stem, seconds, seed=ord(stem))[0], seconds, ord(stem))
    more = tmp_path / "more"
    write_own(write_speech(more / "c.wav", 3.0, level=0.1), 3.0)
    report = prepare(folder, tmp_path / "corpus.jsonl", unpaired=more, holdout=0.0)
    assert len(report.manifest) == 3 and report.is_complete
    return tmp_path / "corpus.jsonl"


@pytest.mark.parametrize(
    "recipe", ["diffusion", pytest.param("multires", marks=pytest.mark.stress)], indirect=True
)
def test_own_features_from_training_to_motion(
    gesturekit, own_corpus, recipe, write_speech, tmp_path, monkeypatch
):
    install(tmp_path / "site", monkeypatch)
    config, *tiny = recipe
    given = (f"corpus={own_corpus}", f"out={tmp_path / 'run'}")
    train = ("train", config, *given, *tiny, EXTRACTORS)
    own = tmp_path / "corpus" / "b.npz"
    away = own.rename(tmp_path / "away.npz")
    gesturekit(*train).fails(2, "b.wav", "b.npz")
    away.rename(own)
    trained = gesturekit(*train).ok()
    assert re.search(r"(?=.*STEM.own.npy)(?=.*\b3\b)", trained.out)
    model = tmp_path / "run" / "model"
    needs = [text for name, text in inspect(model).rows.items() if name == "needs"]
    assert any("loudness" in need and "own-features" in need for need in needs)
    assert all(need in (model / "README.md").read_text() for need in needs)
    speech, out = tmp_path / "speech", tmp_path / "out"
    for stem in ("ok", "lone", "narrow"):
        write_own(write_speech(speech / f"{stem}.wav", 1.3), 1.3)
    (speech / "lone.own.npy").unlink()
    np.save(speech / "narrow.own.npy", np.zeros((26, 2)))
    render = ("render", speech, "--model", model, "--out", out, "--format", "npz")
    done = gesturekit(*render).fails(1, "lone.wav", "lone.own.npy")
    assert "narrow.own.npy" in done.err and "(T, 3)" in done.err
    first = Motion.load(out / "ok.npz")
    assert first.n_frames == 39 and not (out / "lone.npz").exists()
    write_own(speech / "ok.wav", 1.3, seed=9)
    gesturekit(*render).fails(2, "ok.npz", "features")  # not kept if its features change
    # The same files in a folder of their own, and a sound somewhere else.
    write_own(speech / "ok.wav", 1.3)
    there = gk.load(model, weights={"files": speech})
    again = there.generate(write_speech(tmp_path / "new" / "ok.wav", 1.3), item="ok")
    np.testing.assert_allclose(again.positions(), first.positions(), atol=1e-4)
    assert gk.load(model).generate(seconds=1.0).n_frames == 30  # silence needs no file
    with pytest.raises(FeatureError, match=r"own\.npy"):
        there.generate(np.sin(np.arange(20_000) * 0.1), 16_000)
    with pytest.raises(GestureKitError, match="file"):
        create_app(gk.load(model))
    gesturekit(*render, "--weights", "files=nowhere").fails(2, "nowhere")


def test_without_the_package_the_model_says_what_to_install(
    gesturekit, own_corpus, light, tiny, write_speech, tmp_path
):
    model, speech = tmp_path / "run" / "model", write_speech(tmp_path / "new.wav", 1.3)
    render = ("render", speech, "--model", model, "--out", tmp_path / "o")
    with pytest.MonkeyPatch.context() as patch:
        install(tmp_path / "site", patch)
        given = (f"corpus={own_corpus}", f"out={tmp_path / 'run'}")
        extractors = "features.extractors=[{kind: loudness}]"
        gesturekit("train", light, *given, *tiny, extractors).ok()
        gesturekit(*render).ok()
        done = gesturekit("features", speech, "--extractor", "loudness", "--out", tmp_path / "f")
        assert re.search(r"(?=.*\b26\b)(?=.*\b2\b)", done.ok().out)
        service = create_app(gk.load(model))  # a sound is all that it needs
        with TestClient(service, base_url="http://127.0.0.1") as client:
            answer = client.post("/motion?item=new", content=speech.read_bytes())
        assert answer.text == (tmp_path / "o" / "new.bvh").read_text()
    gesturekit(*render).fails(2, "'loudness'", "own-features 1.2")
    assert "own-features 1.2" in gesturekit("inspect", model).ok().out


@pytest.mark.stress  # of seconds: features of files above; tests/corpus and tests/recipes: music
def test_a_dance_follows_beats_of_another_tracker(gesturekit, write_pair, write_speech, tmp_path):
    """As docs/encoders.md says; beside music, no voice is looked for."""
    folder, music = tmp_path / "corpus", tmp_path / "song.wav"
    for sound, rows in ((write_pair(folder, "a", 3.0)[0], 300), (write_speech(music, 2.0), 200)):
        np.save(sound.with_suffix(".beats.npy"), np.arange(rows) % 50 == 0)
    prepare(folder, tmp_path / "corpus.jsonl", holdout=0.0)
    tracks = "[{kind: music, n_chroma: 1}, {kind: files, dim: 1, suffix: .beats.npy, rate: 100}]"
    given = (f"corpus={tmp_path / 'corpus.jsonl'}", f"out={tmp_path / 'run'}")
    small = ("network.blocks=1", "network.channels=8", "training.updates=2", "noise.steps=8")
    gesturekit("train", "diffusion_dance", *given, *small, f"features.extractors={tracks}").ok()
    model = gk.load(tmp_path / "run" / "model")
    assert not model.conditions.conditioner.vad
    on_time = model.generate(music)
    np.save(music.with_suffix(".beats.npy"), np.arange(200) % 50 == 25)
    assert not np.array_equal(model.generate(music).rotations, on_time.rotations)
