"""`gesturekit prepare` as a user meets it: exit codes and one clear line a problem."""

from __future__ import annotations

from pathlib import Path

import pytest

from gesturekit.inspection import inspect


@pytest.fixture
def recordings(tmp_path: Path, write_pair) -> Path:
    for seed, name in enumerate("abc"):
        write_pair(tmp_path / "recordings", name, 2.0, seed=seed)
    return tmp_path / "recordings"


@pytest.fixture
def prepare(gesturekit, tmp_path):
    """prepare(*arguments): the command, into tmp_path/corpus.jsonl."""
    return lambda *arguments: gesturekit("prepare", *arguments, "--out", tmp_path / "corpus.jsonl")


def test_all_recordings_are_used(prepare, recordings, tmp_path):
    done = prepare(recordings, "--style", "calm")
    assert (done.status, done.err) == (0, "")
    assert "paired        3 recordings, 6.0 s: train 2 (4.0 s), test 1 (2.0 s)" in done.out
    assert (tmp_path / "corpus.jsonl").is_file()


def test_some_files_are_left_out(prepare, recordings):
    (recordings / "a.wav").write_text("no sound")
    (recordings / "alone.wav").write_bytes((recordings / "b.wav").read_bytes())
    done = prepare(recordings, "--holdout", "0")
    assert done.status == 1
    broken, alone = done.err.splitlines()
    assert broken.startswith("error: ") and str(recordings / "a.wav") in broken
    assert alone.startswith("left out: speech without motion") and "alone.wav" in alone
    assert "paired        2 recordings" in done.out
    assert "left out      1 recording with errors, 1 file not used" in done.out


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
def test_nothing_can_start(prepare, arguments):
    done = prepare(*arguments)
    assert done.status == 2
    assert "Error: " in done.err and "Traceback" not in done.err


def test_nothing_usable(prepare, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("e").mkdir()
    done = prepare("e")
    assert done.status == 2
    assert "no usable recording" in done.err
    assert "warning: e: neither sound (.wav, " in done.err and ".npz" in done.err
    assert not (tmp_path / "corpus.jsonl").exists()


def test_the_height_asked_for_is_kept_in_the_manifest(prepare, recordings, tmp_path):
    done = prepare(recordings, "--height", "1.2", "--in-up", "y")
    assert (done.status, done.err) == (0, "")
    assert '"reading": {"up": "y", "height": 1.2}' in (tmp_path / "corpus.jsonl").read_text()
    summary = inspect(tmp_path / "corpus.jsonl")
    assert dict(summary.rows)["reading"] == "up y, height 1.2 (3)"
    prepare(recordings)
    assert "reading" not in (tmp_path / "corpus.jsonl").read_text()
