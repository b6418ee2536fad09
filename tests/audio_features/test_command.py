"""gesturekit features, through its own command."""

import re

import numpy as np
import pytest
import soundfile
from click import UsageError
from click.testing import CliRunner
from matplotlib.image import imread

from audio_features import FeatureTrack, WeightsError
from gesturekit.cli.features import command
from gesturekit.errors import ConfigError


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


def test_an_npy_of_own_features_is_read_at_its_rate(folder):
    np.save("a.npy", np.arange(0, 4, 0.05)[:, None])  # 20 rows a second, each its time
    options = ("--extractor", "files:1", "--out", "out")
    result = run("a.wav", *options)
    assert result.return_value == 1 and "a.npz" in result.output
    assert run("a.wav", *options, "--rate", "20").return_value == 0
    track = FeatureTrack.load(folder / "out" / "a.npz")
    np.testing.assert_allclose(track.times, track.values[:, 0], atol=1e-6)
    assert track.times[-1] == pytest.approx(3.95)


def test_one_bad_file_is_listed_and_the_others_are_done(folder):
    result = run("broken.wav", "silent.wav", "a.wav", "--out", "out")
    assert result.return_value == 1
    assert "broken.wav" in result.output and "1 of 3" in result.output
    assert re.search(r"silent\.wav.* silence", result.output)
    made = sorted(path.name for path in (folder / "out").glob("*.npz"))
    assert made == ["a.npz", "silent.npz"]


def test_commands_that_cannot_start_give_a_reason(folder):
    (folder / "sub").mkdir()
    for given, error, says in (
        (["sub/a.wav"], ConfigError, "sub/a.wav"),
        (["--extractor", "mell"], UsageError, "mell"),
        (["--extractor", "wavlm"], WeightsError, "--weights"),
        (["--weights", "x"], UsageError, "--weights"),
        (["--layer", "3"], UsageError, "--layer"),
        (["--rate", "50"], UsageError, "--rate"),
        (["--full-context", "9"], UsageError, "--full-context"),
        (["--align", "mean"], UsageError, "--fps"),
    ):
        failed = run("a.wav", *given, "--out", "out").exception
        assert isinstance(failed, error) and says in str(failed)
    assert not (folder / "out").exists()


def test_sizes_methods_and_a_channel(folder, speech):
    two = np.stack([speech.samples, np.roll(speech.samples, 8_000)], axis=1)
    soundfile.write(folder / "two.wav", two, 16_000)
    tracks = []
    for channel in ((), ("--channel", "1"), ("--channel", "2")):
        replaced = ("--out", "out", "--existing", "replace")
        result = run("two.wav", "--extractor", "mfcc:16,onset,logmel:3", *replaced, *channel)
        assert result.return_value == 0, result.output
        tracks.append(FeatureTrack.load(folder / "out" / "two.npz"))
    assert tracks[0].values.shape == (400, 16 + 2 + 3)
    assert not np.allclose(tracks[1].values, tracks[2].values, atol=1)
    np.testing.assert_allclose(tracks[1].values[100:150, 3], tracks[2].values[150:200, 3], atol=1)


def test_a_picture_is_drawn_beside_the_features_of_every_sound(folder):
    result = run("a.wav", "silent.wav", "--extractor", "logmel:4", "--picture", "--out", "o")
    assert result.return_value == 0, result.output
    spoken, silent = (imread(folder / "o" / f"{name}.png") for name in ("a", "silent"))
    assert spoken.std() > 0.05 and len(np.unique(spoken)) > len(np.unique(silent))
