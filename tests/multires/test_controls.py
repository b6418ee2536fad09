"""Speech of their own for some levels of a multires model."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

import audio_features as af
import gesturekit as gk
from gesturekit.errors import ModelError


@pytest.fixture(scope="module")
def two_voices(write_speech, tmp_path_factory):
    """Two sounds of 4 s."""
    folder = tmp_path_factory.mktemp("voices")
    calm = write_speech(folder / "calm.wav", 4.0, level=0.05)
    wave = af.Wave.load(write_speech(folder / "lively.wav", 6.1))
    return calm, af.Wave(wave.samples[-4 * wave.sample_rate :], wave.sample_rate, None)


RAW = {"foot_lock": False, "smooth": 0.0, "fps": 30.0}


def body_of(model: gk.Model, motion: gk.Motion) -> np.ndarray:
    """Rotations of the joints that the network moves; fingers follow the main speech."""
    return motion.rotations[:, [motion.skeleton.index(j) for j in model.representation.joints]]


def test_levels_follow_a_speech_of_their_own(two_voices):
    """The state of movement is given, as a drawn one follows the main speech too."""
    model, (calm, lively) = gk.load("demo"), two_voices
    state = model.state_process.mean[None]

    def rotations(speech, **controls):
        return body_of(model, model.generate(speech, state=state, **{**RAW, **controls}))

    of_calm, of_lively = rotations(calm), rotations(lively)
    fine = rotations(calm, level_speech={"4-6": lively})
    assert np.abs(fine - of_calm).max() > 1e-3 and np.abs(fine - of_lively).max() > 1e-3
    every = rotations(calm, level_speech={"1-3": lively, "4-6": lively})
    np.testing.assert_array_equal(every, of_lively)
    np.testing.assert_array_equal(rotations(lively, level_speech={"1-6": calm}), of_calm)
    own, finer, coarser = (
        rotations(calm, level_speech=spoken, levels=3, fps=None)
        for spoken in (None, {"4-6": lively}, {"1": lively})
    )
    np.testing.assert_array_equal(own, finer)
    assert np.abs(own - coarser).max() > 1e-3


def test_level_speech_is_cut_to_the_motion_or_followed_by_silence(two_voices):
    model, (_, lively) = gk.load("demo"), two_voices
    short = model.generate(seconds=2.0, level_speech={"1-6": lively}, **RAW)
    assert short.n_frames == 60
    idle = model.generate(seconds=16.0, **RAW)
    spoken = model.generate(seconds=16.0, level_speech={"1-6": lively}, **RAW)
    assert np.abs(spoken.rotations[:120] - idle.rotations[:120]).max() > 0.01
    np.testing.assert_allclose(spoken.rotations[-90:], idle.rotations[-90:], atol=1e-5)


@pytest.mark.parametrize(
    ("levels", "file", "message"),
    [
        ("5-9", "here.wav", r"(?=.*5-9)(?=.*\b6\b)"),
        ("fine", "here.wav", "'fine'"),
        ("5-6", "gone.wav", "(?=.*level_speech)(?=.*gone.wav)"),
    ],
)
def test_invalid_level_speech_is_an_error(levels, file, message, tmp_path):
    (tmp_path / "here.wav").touch()
    with pytest.raises(gk.GestureKitError, match=message):
        gk.load("demo").check_controls(level_speech={levels: tmp_path / file})


def test_level_speech_from_the_command_line(two_voices, tmp_path, render):
    calm, _ = two_voices
    named = shutil.copy(calm, tmp_path / "motion.wav")  # the name of a motion without sound
    model, made = gk.load("demo"), []
    np.save(tmp_path / "state.npy", model.state_process.mean[None])
    for options in ([named], ["--seconds", 4, "--level-speech", f"1-3={calm},4-6={calm}"]):
        render("demo", "--state", tmp_path / "state.npy", *options).ok()
        (file,) = (tmp_path / "out").glob("*.bvh")
        made.append(body_of(model, gk.Motion.load(file)))
        file.unlink()
    np.testing.assert_array_equal(*made)
    render("demo", "--seconds", 4, "--level-speech", "5-6").fails(2, "5-6")


@pytest.fixture(scope="module")
def models():
    """The bundled model with two speakers, without speakers, and without a state of movement."""
    model = gk.load("demo")
    known = replace(model, speakers={"bob": model.skeleton, "ann": model.skeleton.scaled(0.9)})
    undrawn = replace(model, library=None, state_process=None)
    return {"known": known, "plain": replace(model, speakers={}), "undrawn": undrawn}


@pytest.mark.parametrize(
    ("kind", "asked", "message"),
    [
        ("known", {"levels": 0}, "levels=0"),
        ("known", {"levels": 9}, r"(?=.*levels=9)(?=.*\b6\b)"),
        ("known", {"keyframe_level": 0}, "keyframe_level=0"),
        ("known", {"speaker": "eve"}, "(?=.*speaker='eve')(?=.*ann)(?=.*bob)"),
        ("plain", {"speaker": "eve"}, "speaker='eve'"),
        ("known", {"style": "sad"}, "style='sad'"),
        ("known", {"level_style": "1=sad"}, "level_style='1=sad'"),
        ("known", {"fps": 24.0, "levels": 5}, "(?=.*fps=24)(?=.*levels=5)"),
        *(("known", {"liveliness": x}, f"liveliness={x!r}") for x in (0, -1.0, np.nan, "high")),
        *(("known", {"mood_seed": x}, f"mood_seed={x!r}") for x in (-1, 1.5, "one", True)),
        ("undrawn", {"liveliness": 1.5}, "liveliness=1.5"),
        ("undrawn", {"mood_seed": 0}, "mood_seed=0"),
        ("undrawn", {"state": np.zeros((1, 2))}, "state"),
    ],
)
def test_controls_that_a_model_does_not_take_are_refused(models, kind, asked, message):
    model = models[kind]
    with pytest.raises(ModelError, match=message):
        model.generate(seconds=1.0, **asked) if "fps" in asked else model.check_controls(**asked)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"path": 1, "like": 1}, "(?=.*path)(?=.*like)"),
        ({"like": 1, "liveliness": 0.5}, "(?=.*like)(?=.*liveliness=0.5)"),
        ({"like": 1, "levels": 5}, "(?=.*like)(?=.*levels)"),
        ({"speaker": "ann", "levels": 5}, "(?=.*speaker)(?=.*levels)"),
        ({"speaker": "ann", "keep": 1}, "(?=.*keep)(?=.*speaker)"),
    ],
)
def test_controls_that_exclude_each_other_are_refused(models, gesture, asked, message):
    model, clip = models["known"], gesture(1.0)
    given = {"path": clip, "keyframes": clip, "like": clip, "keep": {0.0: clip}}
    asked = {name: given.get(name, value) for name, value in asked.items()}
    with pytest.raises(ModelError, match=message):
        model.generate(**asked)


def test_lengths_of_motions_are_those_of_their_controls(models, gesture):
    """Without speech and seconds; a second at 30 fps, which is 30 frames of the model."""
    model, clip = models["plain"], gesture(1.0)
    for asked, frames in (
        ({"like": clip}, 30),
        ({"keep": {0.5: clip}}, 45),
        ({"path": clip, "levels": 6}, 30),
        ({"like": clip, "speaker": "ann"}, 30),
    ):
        own = models["known"] if "speaker" in asked else model
        made = own.generate(**asked, foot_lock=False, fps=own.fps)
        assert (made.n_frames, made.fps) == (frames, 30.0)
    small = models["known"].generate(seconds=0.5, speaker="ann", foot_lock=False)
    assert small.skeleton.offsets[1:] == pytest.approx(0.9 * model.skeleton.offsets[1:])
