"""Faces by rules in `generate`, `render`, `demo` and `live`."""

import json
import logging
import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import soundfile
from loud import LoudModel, LoudStream
from small_models import small_diffusion
from sounds import voiced

import audio_features as af
import gesturekit as gk
from gesturekit import systems
from gesturekit.errors import ModelError
from gesturekit.motion import Motion
from gesturekit.motion.face import FaceTrack
from gesturekit.systems import bundled_speech

TEXT = "Hello, I am going to show you how this works."


@pytest.fixture(scope="module", params=["multires", "diffusion"])
def model(request, gesture) -> gk.Model:
    return gk.load("demo") if request.param == "multires" else small_diffusion(gesture)


@pytest.fixture(scope="module")
def wave() -> af.Wave:
    """Three seconds: speech, then as much silence."""
    speech = af.Wave.load(bundled_speech()).slice(1.0, 3.0)
    return af.Wave(np.pad(speech.samples, (0, len(speech.samples))), speech.sample_rate)


def test_a_face_speaks_and_leaves_the_body_alone(model, wave):
    plain, made = model.generate(wave, fps=60.0), model.generate(wave, fps=60.0, face="energy")
    assert plain.face is None
    np.testing.assert_array_equal(made.rotations, plain.rotations)
    np.testing.assert_array_equal(made.translation, plain.translation)
    jaw = made.face.channel("jawOpen")
    assert made.face.origin == "rules" and len(jaw) == wave.n_frames(60.0)
    assert jaw[:180].mean() > 0.1 and jaw[190:].max() < 0.02


def test_mouths_follow_the_sound_and_blinks_are_drawn(model, wave):
    asked = [{"seed": 1}, {"item": "a"}, {"item": "b"}]
    faces = [model.generate(wave, face="energy", **each).face for each in asked]
    faces += [motion.face for motion in model.generate(wave, face="energy", samples=2)]
    gaze = [face.values[:, [n.startswith("eye") for n in face.names]] for face in faces]
    assert not any(np.array_equal(one, other) for one, other in combinations(gaze, 2))
    for face in faces:
        np.testing.assert_array_equal(face.channel("jawOpen"), faces[0].channel("jawOpen"))
    again = model.generate(wave, face="energy", item="a").face
    np.testing.assert_array_equal(again.values, faces[1].values)


def test_without_speech_the_mouth_stays_closed(model, caplog):
    with caplog.at_level(logging.WARNING):
        first, _ = model.generate(seconds=20.0, face="energy", samples=2)
    assert [record.getMessage() for record in caplog.records if "face" in record.getMessage()] == [
        "face='energy': there is no speech; the mouth stays closed"
    ]
    assert first.face.channel("jawOpen").max() == 0 < first.face.channel("eyeBlinkLeft").max()


def test_what_no_face_can_be_made_of_is_an_error_before_generating(model, monkeypatch):
    for asked, says in (
        ({"face": "loud"}, "energy, phones, off"),
        ({"face": "energy", "transcript": "hello"}, "--face phones"),
        ({"transcript": "hello"}, "--face phones"),
    ):
        with pytest.raises(ModelError, match=says):
            model.check_controls(**asked)
    monkeypatch.setattr("gesturekit.training.model_folder.find_spec", lambda _: None)
    with pytest.raises(ModelError, match=re.escape("gesturekit[face]")):
        model.check_controls(face="phones")


def face_of(path) -> tuple[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as arrays:
        return str(arrays["face"]), arrays["face_values"]


@pytest.fixture
def speech(tmp_path):
    """Folder with three sounds; the text of a is empty, c has words and another kind of text."""
    folder = tmp_path / "speech"
    folder.mkdir()
    part = af.Wave.load(bundled_speech(), duration=3.2)
    for name in "abc":
        soundfile.write(folder / f"{name}.wav", part.samples, part.sample_rate)
    (folder / "a.txt").write_text("\n")
    (folder / "b.txt").write_text(f"\ufeff{TEXT}\n", "utf-8")
    starts = [0.0, 0.2, 0.4, 0.6, 1.0, 1.2, 1.5, 1.7, 2.0, 2.3]
    timed = zip(TEXT.split(), starts, strict=True)
    words = [{"word": word, "start": start, "end": start + 0.2} for word, start in timed]
    (folder / "c.words.json").write_text(json.dumps(words))
    (folder / "c.txt").write_text("4\t0.1\t2.0\tbeat")
    return folder


def test_render_makes_faces_and_says_so(gesturekit, speech, tmp_path):
    what = ("render", speech, "--model", "demo", "--out", tmp_path / "out", "--format", "npz,bvh")
    done = gesturekit(*what, "--face", "energy").ok()
    assert "Faces by rules, not recorded: 3 items from energy" in done.err
    origin, values = face_of(tmp_path / "out" / "a.npz")
    made = gk.load("demo").generate(speech / "a.wav", item="a", face="energy")
    assert origin == "rules" and np.array_equal(values, made.face.values)
    before = (tmp_path / "out" / "a.bvh").read_bytes()
    plain = gesturekit(*what, "--existing", "replace").ok()
    assert "Faces" not in plain.err and (tmp_path / "out" / "a.bvh").read_bytes() == before
    assert Motion.load(tmp_path / "out" / "a.npz").face is None


def test_render_finds_transcripts_beside_the_sounds(gesturekit, speech, tmp_path):
    pytest.importorskip("pocketsphinx")
    out = tmp_path / "out"

    def is_of(name: str, text: str | None, **interval: float) -> bool:
        """Return whether a mouth is that of a text, or of recognised phones."""
        wave = af.Wave.load(speech / "a.wav", **interval)
        face = gk.face.face_from_speech(wave, 30.0, wave.n_frames(30.0), "phones", text)
        mouth = [i for i, channel in enumerate(face.names) if not channel.startswith("eye")]
        made = face_of(out / f"{name}.npz")[1]
        return np.array_equal(made[:, mouth], face.values[:, mouth])

    what = ("render", "--model", "demo", "--format", "npz", "--face", "phones", "--out", out)
    done = gesturekit(*what, speech).ok()
    assert "1 item from phones, 2 items from phones, with a transcript given" in done.err
    assert is_of("a", None) and is_of("b", TEXT) and is_of("c", TEXT) and not is_of("b", None)
    (speech / "b.txt").write_text("Another text")
    gesturekit(*what, speech).fails(2, "b.npz", "transcript")
    lines = [
        {"audio": "speech/b.wav", "id": "part", "start": 1.0, "seconds": 1},
        {"audio": "speech/c.wav", "id": "words", "start": 1.0, "seconds": 1},
        {"audio": "speech/c.wav", "id": "own", "transcript": "Hello"},
    ]
    (tmp_path / "list.jsonl").write_text("\n".join(map(json.dumps, lines)))
    gesturekit(*what, tmp_path / "list.jsonl").ok()
    assert is_of("part", None, start=1.0, duration=1.0), "the text is of the whole sound"
    assert is_of("words", "to show you how", start=1.0, duration=1.0)
    assert is_of("own", "Hello")
    both = (speech / "a.wav", tmp_path / "list.jsonl")
    gesturekit(*what, *both, "--transcript", TEXT, "--existing", "replace").ok()
    assert is_of("a", TEXT) and is_of("own", "Hello")


@pytest.fixture
def live(gesturekit, monkeypatch, tmp_path, write_speech):
    """live(*options): `gesturekit live`, of three seconds of speech, and the recorded motion."""
    monkeypatch.setattr(systems, "load", lambda **_: LoudModel())
    speech = write_speech(tmp_path / "a.wav", 3.0)

    def run(*options: object) -> Motion:
        out = tmp_path / "take.npz"
        what = ("live", "--from", speech, "--fast", "--existing", "replace")
        gesturekit(*what, "--to", f"record:{out}", *options).ok()
        return Motion.load(out)

    run.speech = speech
    return run


def test_live_speech_moves_a_face_from_energy(live):
    wave, made = af.Wave.load(live.speech), live("--seed", 4)
    rules = gk.face.EnergyFace(wave.sample_rate, 30.0, seed=4)
    values = np.concatenate([rules.step(wave.samples), rules.step(np.zeros(16_000, np.float32))])
    assert made.face.origin == "rules" and made.face.names == rules.names
    np.testing.assert_array_equal(made.face.values, values[: made.n_frames])
    assert made.face.channel("jawOpen").max() > 0.1
    # Without a look-ahead, a frame has the newest face: late by the rules' delay at most.
    late, lag = live("--seed", 4, "--look-ahead", 0).face.values, int(rules.delay * 30) + 2
    ages = [(values[k - lag : k + 1] == late[k]).all(axis=1) for k in range(lag, made.n_frames - 1)]
    assert all(age.any() for age in ages) and not any(age[-1] for age in ages[10:60])
    assert live("--face", "off").face is None


def test_a_live_mouth_moves_at_the_time_of_the_sound(live):
    sound = np.concatenate([np.zeros(16_000), 0.1 * voiced(1.0), np.zeros(16_000)])
    soundfile.write(live.speech, sound, 16_000)
    made = live("--look-ahead", 0.3)
    moving = np.flatnonzero(made.face.channel("jawOpen") > 0.05) / made.fps
    said = np.flatnonzero(abs(sound) > 0.05) / 16_000
    np.testing.assert_allclose(moving[[0, -1]], said[[0, -1]], atol=0.05)


def test_the_recorded_face_that_a_model_plays_live_stays(live, monkeypatch):
    step = LoudStream._up_to

    def smiling(stream: LoudStream, seconds: float) -> Motion | None:
        motion = step(stream, seconds)
        if motion is None:
            return None
        return replace(motion, face=FaceTrack(("smile",), np.ones((motion.n_frames, 1))))

    monkeypatch.setattr(LoudStream, "_up_to", smiling)
    face = live().face
    assert (face.names, face.origin) == (("smile",), "recorded") and (face.values == 1).all()
