"""Speech of their own for some levels of a multires model."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

import audio_features as af
import gesturekit as gk


@pytest.fixture(scope="module")
def two_voices(write_speech, tmp_path_factory):
    """Two sounds of 4 s."""
    folder = tmp_path_factory.mktemp("voices")
    calm = write_speech(folder / "calm.wav", 4.0, level=0.05)
    wave = af.Wave.load(write_speech(folder / "lively.wav", 6.1))
    return calm, af.Wave(wave.samples[-4 * wave.sample_rate :], wave.sample_rate, None)


RAW = {"foot_lock": False, "smooth": 0.0, "recall": False, "fps": 30.0}


def test_levels_follow_a_speech_of_their_own(two_voices):
    model, (calm, lively) = gk.load("demo"), two_voices

    def rotations(speech, **controls):
        return model.generate(speech, **RAW, **controls).rotations

    of_calm, of_lively = rotations(calm), rotations(lively)
    fine = rotations(calm, level_speech={"5-8": lively})
    assert np.abs(fine - of_calm).max() > 1e-3 and np.abs(fine - of_lively).max() > 1e-3
    every = rotations(calm, level_speech={"1-4": lively, "5-8": lively})
    np.testing.assert_array_equal(every, of_lively)
    np.testing.assert_array_equal(rotations(lively, level_speech={"1-8": calm}), of_calm)
    coarse = {"levels": 4, "recall": False, "foot_lock": False}
    own, finer, coarser = (
        model.generate(calm, level_speech=spoken, **coarse).rotations
        for spoken in (None, {"5-8": lively}, {"1": lively})
    )
    np.testing.assert_array_equal(own, finer)
    assert np.abs(own - coarser).max() > 1e-3


def test_level_speech_is_cut_to_the_motion_or_followed_by_silence(two_voices):
    model, (_, lively) = gk.load("demo"), two_voices
    short = model.generate(seconds=2.0, level_speech={"1-8": lively}, **RAW)
    assert short.n_frames == 60
    idle = model.generate(seconds=16.0, **RAW)
    spoken = model.generate(seconds=16.0, level_speech={"1-8": lively}, **RAW)
    assert np.abs(spoken.rotations[:120] - idle.rotations[:120]).max() > 0.01
    np.testing.assert_allclose(spoken.rotations[-90:], idle.rotations[-90:], atol=1e-5)


@pytest.mark.parametrize(
    ("levels", "file", "message"),
    [
        ("7-9", "here.wav", "level speech '7-9': the model has levels 1 .coarse. to 8"),
        ("fine", "here.wav", "level speech 'fine': it looks like 7-10=b.wav"),
        ("7-8", "gone.wav", "level_speech: .*gone.wav: no such file"),
    ],
)
def test_invalid_level_speech_is_an_error(levels, file, message, tmp_path):
    (tmp_path / "here.wav").touch()
    with pytest.raises(gk.GestureKitError, match=message):
        gk.load("demo").check_controls(level_speech={levels: tmp_path / file})


def test_level_speech_from_the_command_line(two_voices, tmp_path, render):
    calm, _ = two_voices
    named = shutil.copy(calm, tmp_path / "motion.wav")  # the name of a motion without sound
    made = []
    for options in ([named], ["--seconds", 4, "--level-speech", f"1-4={calm},5-8={calm}"]):
        assert render("demo", "--no-recall", *options).status == 0
        (file,) = (tmp_path / "out").glob("*.bvh")
        made.append(gk.Motion.load(file).rotations)
        file.unlink()
    np.testing.assert_array_equal(*made)
    done = render("demo", "--seconds", 4, "--level-speech", "7-8")
    assert done.status == 2 and "names no file: 7-10=b.wav" in done.err
