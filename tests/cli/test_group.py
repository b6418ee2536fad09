"""The command line as a whole: its exit codes, and that it never shows a traceback."""

from __future__ import annotations

import subprocess
import sys

import pytest

import gesturekit as gk
from gesturekit.cli import VERBS


def test_help_and_version(gesturekit):
    assert gesturekit("--version").out.strip().endswith(gk.__version__)
    for arguments in (["--help"], ["-h"], *([verb, "--help"] for verb in VERBS)):
        done = gesturekit(*arguments)
        assert done.status == 0 and done.out.startswith("Usage: gesturekit") and done.err == ""


@pytest.mark.parametrize("arguments", [["rendr"], ["--nonsense"], ["render"], ["train"], []])
def test_bad_usage(gesturekit, arguments):
    done = gesturekit(*arguments)
    assert done.status == 2 and "Usage: gesturekit" in done.err


def test_a_mistyped_verb_names_the_one_that_was_probably_meant(gesturekit):
    assert "did you mean render?" in gesturekit("rendr").err
    assert "did you mean prepare?" in gesturekit("Prepair", "x").err
    done = gesturekit("xyz")
    assert done.status == 2 and "it is one of demo, features, prepare" in done.err


def test_features_that_cannot_be_written_or_made(gesturekit, write_speech, tmp_path):
    wav = write_speech(tmp_path / "speech.wav", 1.0)
    done = gesturekit("features", wav, "--out", tmp_path / "speech.wav" / "out")
    assert done.status == 1
    target = tmp_path / "speech.wav" / "out" / "speech.npz"
    assert done.err.splitlines()[0] == f"Error: {target}: Not a directory"
    for fps in ("0", "1e9", "fast"):
        done = gesturekit("features", wav, "--out", tmp_path / "out", "--fps", fps)
        assert done.status == 2 and "--fps" in done.err
    assert not (tmp_path / "out").exists()


def test_a_reader_that_leaves_early_is_no_error(model, write_speech, tmp_path):
    """gesturekit render ... | head -1"""
    for i in range(3):
        write_speech(tmp_path / "in" / f"{i}.wav", 0.5)
    running = subprocess.Popen(
        [sys.executable, "-u", "-m", "gesturekit", "render", tmp_path / "in"]
        + ["--model", model, "--out", tmp_path / "out"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert running.stdout.readline().strip() == str(tmp_path / "out" / "0.bvh")
    running.stdout.close()
    told = running.stderr.read()
    running.stderr.close()
    running.wait(timeout=60)
    assert "Traceback" not in told and "Exception" not in told
