"""The command line as a whole: its exit codes, and that it never shows a traceback."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import audio_features as af
import gesturekit as gk
from gesturekit import systems
from gesturekit.cli import VERBS


def test_help_and_version(gesturekit):
    assert gesturekit("--version").out.strip().endswith(gk.__version__)
    for arguments in (["--help"], ["-h"], *([verb, "--help"] for verb in VERBS)):
        done = gesturekit(*arguments)
        assert done.status == 0 and done.out.startswith("Usage: gesturekit") and done.err == ""


def test_a_missing_model_is_answered_by_those_that_there_are(gesturekit, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "a" / "model").mkdir(parents=True)
    (tmp_path / "runs" / "a" / "model" / "config.yaml").touch()
    own = f"--model {Path('runs', 'a', 'model')}"
    gesturekit("render", "a.wav", "-o", "out").fails(2, "--model demo", own)
    wrong = ("render", "a.wav", "--model", "demo", "-o", "result.bvh")
    gesturekit(*wrong).fails(2, "--out result --format bvh")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["rendr"], "render?"),
        (["xyz"], "prepare"),
        (["render"], "Missing"),
        (["train"], "gesturekit train own_corpus corpus=CORPUS.jsonl"),
        ([], "Usage: gesturekit"),
    ],
)
def test_bad_usage(gesturekit, arguments, says):
    gesturekit(*arguments).fails(2, "Usage: gesturekit", says)


def test_features_that_cannot_be_written_or_made(gesturekit, write_speech, tmp_path):
    wav = write_speech(tmp_path / "speech.wav", 1.0)
    target = tmp_path / "speech.wav" / "out"
    gesturekit("features", wav, "--out", target).fails(2, str(target))
    gesturekit("features", wav, "--out", tmp_path / "out", "--fps", "1e9").fails(2, "--fps")
    assert not (tmp_path / "out").exists()


@pytest.mark.stress  # of seconds: `test_results_are_written_whoever_reads_the_output`
def test_a_reader_that_closes_the_pipe_early_is_not_an_error(gesture, tmp_path):
    """gesturekit convert ... | head -1"""
    for i in range(3):
        gesture(0.5).save(tmp_path / "in" / f"{i}.bvh")
    command = [sys.executable, "-u", "-m", "gesturekit", "convert", tmp_path / "in"]
    command += [tmp_path / "out", "--format", "npz"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    running = subprocess.Popen(command, **pipes, text=True)
    assert str(tmp_path / "in" / "0.bvh") in running.stdout.readline()
    running.stdout.close()
    told = running.stderr.read()
    running.stderr.close()
    running.wait(timeout=60)
    assert "Traceback" not in told and "Exception" not in told


def test_control_characters_in_names_are_shown_as_escapes(gesturekit, gesture, tmp_path):
    """Names that would reverse the text or clear the screen; joiners of letters are text."""
    gesture(0.2).save(tmp_path / "a\u202ehvb\u200d.bvh")
    (tmp_path / "c\x07.bvh").write_text("HIERARCHY\n")
    done = gesturekit("convert", tmp_path, tmp_path / "out", "--format", "npz")
    assert "a\\u202ehvb\u200d.bvh" in done.out and "c\\x07.bvh" in done.err
    assert not re.search("[\u202e\x07]", done.out + done.err)


def test_a_manifest_and_a_feature_model_may_be_kept(gesturekit, write_pair, tmp_path):
    write_pair(tmp_path / "in", "a", 2.0)
    manifest = tmp_path / "corpus.jsonl"
    manifest.write_text("mine")
    prepare = ("prepare", tmp_path / "in", "--out", manifest, "--holdout", 0, "--existing")
    gesturekit(*prepare, "refuse").fails(2, "corpus.jsonl")
    gesturekit(*prepare, "skip").ok()
    assert manifest.read_text() == "mine"
    (tmp_path / "feature_model.safetensors").write_text("{}")
    fit = ("fit-features", tmp_path / "in", "--out", tmp_path)
    gesturekit(*fit).fails(2, "feature_model.safetensors")
    gesturekit(*fit, "--existing", "skip").ok()


def test_the_demo_leaves_every_format_and_its_sound(gesturekit, tmp_path):
    done = gesturekit("demo", "--out", tmp_path, "--seed", 2).ok()
    names = ["speech.bvh", "speech.html", "speech.npz", "speech.png", "speech.wav"]
    assert {path.name for path in tmp_path.glob("speech.*")} >= set(names)
    assert (tmp_path / "speech.wav").read_bytes() == systems.bundled_speech().read_bytes()
    assert all(str(tmp_path / name) in done.out for name in names) and "Blender" in done.out
    with np.load(tmp_path / "speech.npz", allow_pickle=False) as arrays:
        assert arrays["rotations"].shape[0] == arrays["translation"].shape[0]
        assert arrays["face"] == "rules" and "Faces by rules" in done.err
        assert arrays["face_values"].max() > 0.2
        made = gk.load("demo").generate(systems.bundled_speech(), seed=2, item="speech")
        np.testing.assert_array_equal(arrays["rotations"], made.rotations)
    (tmp_path / "speech.wav").write_text("mine")
    gesturekit("demo", "--out", tmp_path, "--seed", 1).fails(2, "speech.wav")
    first = (tmp_path / "speech.bvh").read_bytes()
    kept = gesturekit("demo", "--out", tmp_path, "--seed", 1, "--existing", "skip").ok()
    assert re.search("(?=.*speech.wav)(?=.*skipped)", kept.err)
    assert (tmp_path / "speech.wav").read_text() == "mine"
    assert (tmp_path / "speech.bvh").read_bytes() == first


@pytest.mark.parametrize("options", [("convert", "--format", "npz"), ("features",)])
def test_ctrl_c_prints_how_to_continue(gesturekit, write_pair, tmp_path, monkeypatch, options):
    verb, *options = options
    source, out = write_pair(tmp_path / "in", "a", 1.0)[verb == "convert"], tmp_path / "out"

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(gk.Motion if verb == "convert" else af.FeatureTrack, "save", stop)
    where = (source, out) if verb == "convert" else (source, "--out", out)
    done = gesturekit(verb, *where, *options).fails(130)
    assert "Interrupted" in done.err and "0 done" in done.err


def test_a_seed_below_0_is_refused_at_once_everywhere(gesturekit, model, corpus, tmp_path):
    """Before files are read: none of these inputs exists."""
    for verb in ("render", "demo", "genea", "evaluate", "prepare", "fit-features", "study"):
        command = [verb, "analyse"] if verb == "study" else [verb]
        gesturekit(*command, "x", "y", "--seed", -1).fails(2, "--seed", "-1")
    loaded = gk.load(model)
    for call in (
        lambda: loaded.generate(seconds=1.0, seed=-1),
        lambda: gk.evaluate(tmp_path, tmp_path, seed=-1),
        lambda: gk.prepare([tmp_path], tmp_path / "c.jsonl", seed=-1),
        lambda: gk.train("multires_speech/light", corpus=corpus, out=tmp_path / "run", seed=-1),
    ):
        with pytest.raises(gk.GestureKitError, match=r"(?=.*seed)(?=.*-1)"):
            call()
    assert list(tmp_path.iterdir()) == []


def test_extractors_are_listed_with_their_settings(gesturekit, write_speech, tmp_path):
    wav = write_speech(tmp_path / "a.wav", 0.5)
    listed = " mfcc:6 ,, prosody,effort:0.5"
    done = gesturekit("features", wav, "--extractor", listed, "--no-cache", "--out", tmp_path)
    track = af.FeatureTrack.load(tmp_path / "a.npz")
    assert re.search(rf"(?=.*a\.npz)(?=.*\b50\b)(?=.*\b{track.values.shape[1]}\b)", done.ok().out)
    mfcc, _, effort = track.spec["parts"]
    assert 6 in mfcc.values()
    assert effort.items() >= {"kind": "effort", "seconds": 0.5}.items()


def test_options_of_networks_need_one(gesturekit, write_speech, tmp_path):
    wav = write_speech(tmp_path / "a.wav", 0.5)
    for options, *says in (
        ("--extractor mel", "'mel'", "logmel"),
        ("--extractor mfcc --layer 6", "--layer", "wavlm"),
        ("--extractor wavlm --rate 50", "--rate", "--extractor files"),
        ("--extractor wavlm --layer 6:1,9", "--layer", "'6:1,9'"),
        ("--extractor mfcc --align mean", "--align", "--fps"),
    ):
        gesturekit("features", wav, *options.split(), "--out", tmp_path / "out").fails(2, *says)
    assert not (tmp_path / "out").exists()
