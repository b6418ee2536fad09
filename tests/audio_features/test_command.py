"""gesturekit features, through its own command."""

from __future__ import annotations

import numpy as np
import pytest
import soundfile
from click.testing import CliRunner

from audio_features import FeatureTrack
from gesturekit.cli.features import command


@pytest.fixture
def folder(tmp_path, speech, monkeypatch):
    soundfile.write(tmp_path / "a.wav", speech.samples, 16_000)
    soundfile.write(tmp_path / "silent.wav", np.zeros(16_000), 16_000)
    (tmp_path / "broken.wav").write_text("text")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments: str):
    return CliRunner().invoke(command, list(arguments), standalone_mode=False)


def test_features_on_motion_frames(folder):
    result = run("a.wav", "--extractor", "logmel,prosody", "--out", "out", "--fps", "25")
    assert result.return_value == 0
    track = FeatureTrack.load(folder / "out" / "a.npz")
    assert track.values.shape == (100, 28)
    assert track.spec["kind"] == "stack"


def test_one_bad_file_is_listed_and_the_others_are_done(folder):
    result = run("broken.wav", "silent.wav", "a.wav", "--out", "out")
    assert result.return_value == 1
    assert "Error: broken.wav" in result.output and "1 of 3 files failed" in result.output
    assert "Warning: silent.wav" in result.output
    assert sorted(path.name for path in (folder / "out").iterdir()) == ["a.npz", "silent.npz"]


def test_what_cannot_start_says_why(folder):
    from click import UsageError

    from audio_features import WeightsError

    (folder / "sub").mkdir()
    same = run("a.wav", "sub/a.wav", "--out", "out")
    assert isinstance(same.exception, UsageError) and "same file" in str(same.exception)
    unknown = run("a.wav", "--extractor", "mell", "--out", "out")
    assert isinstance(unknown.exception, UsageError) and "mell" in str(unknown.exception)
    wavlm = run("a.wav", "--extractor", "wavlm", "--out", "out")
    assert isinstance(wavlm.exception, WeightsError) and "--weights" in str(wavlm.exception)
    assert not (folder / "out").exists()
