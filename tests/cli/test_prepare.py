"""`gesturekit prepare` as a user meets it: exit codes and one clear line a problem."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gesturekit.inspection import inspect


@pytest.fixture
def recordings(tmp_path: Path, gesture, write_speech) -> Path:
    folder = tmp_path / "recordings"
    for seed, name in enumerate(("a", "b", "c")):
        write_speech(folder / f"{name}.wav", 2.0)
        gesture(2.0, seed=seed).save(folder / f"{name}.bvh")
    return folder


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from gesturekit.cli import main; main()", "prepare"]
        + [str(argument) for argument in arguments],
        capture_output=True,
        text=True,
        check=False,
    )


def test_all_recordings_are_used(recordings, tmp_path):
    done = run(recordings, "--out", tmp_path / "corpus.jsonl", "--style", "calm")
    assert (done.returncode, done.stderr) == (0, "")
    assert "paired        3 recordings, 6.0 s: train 2 (4.0 s), test 1 (2.0 s)" in done.stdout
    assert (tmp_path / "corpus.jsonl").is_file()


def test_some_files_are_left_out(recordings, tmp_path):
    (recordings / "a.wav").write_text("no sound")
    (recordings / "alone.wav").write_bytes((recordings / "b.wav").read_bytes())
    done = run(recordings, "--out", tmp_path / "corpus.jsonl", "--holdout", "0")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    told = done.stderr.splitlines()
    assert len(told) == 2
    assert told[0].startswith("error: ") and str(recordings / "a.wav") in told[0]
    assert told[1].startswith("left out: speech without motion") and "alone.wav" in told[1]
    assert "paired        2 recordings" in done.stdout
    assert "left out      1 recording with errors, 1 file not used" in done.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["nowhere"],
        ["--hold-out-seconds", "ten", "."],
        ["--style-pattern", "(", "."],
        ["--holdout", "1", "."],
    ],
)
def test_nothing_can_start(arguments, tmp_path):
    done = run(*arguments, "--out", tmp_path / "corpus.jsonl")
    assert done.returncode == 2
    assert "Error: " in done.stderr and "Traceback" not in done.stderr


def test_nothing_usable(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("e").mkdir()
    done = run("e", "--out", "corpus.jsonl")
    assert done.returncode == 2
    assert "no usable recording" in done.stderr
    assert "warning: e: neither sound (.wav, " in done.stderr and ".npz" in done.stderr
    assert not (tmp_path / "corpus.jsonl").exists()


def test_the_height_asked_for_is_kept_in_the_manifest(recordings, tmp_path):
    done = run(recordings, "--out", tmp_path / "corpus.jsonl", "--height", "1.2", "--in-up", "y")
    assert (done.returncode, done.stderr) == (0, "")
    assert '"reading": {"up": "y", "height": 1.2}' in (tmp_path / "corpus.jsonl").read_text()
    summary = inspect(tmp_path / "corpus.jsonl")
    assert dict(summary.rows)["reading"] == "up y, height 1.2 (3)"
    run(recordings, "--out", tmp_path / "corpus.jsonl")
    assert "reading" not in (tmp_path / "corpus.jsonl").read_text()
