"""The bundled model does what the README promises."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
from pages import bundled, data_of

import audio_features as af
import gesturekit as gk
from gesturekit.evaluation import arm_speed, max_speed
from gesturekit.motion.parts import find_parts
from gesturekit.motion.rotations import IDENTITY, rotation_angles
from gesturekit.systems import bundled_speech
from gesturekit.viewer.human.body import is_baked

RECIPE = Path(__file__).resolve().parents[1] / "recipes" / "demo"


@pytest.fixture(scope="module")
def model():
    return gk.load("demo")


@pytest.fixture(scope="module")
def speech() -> af.Wave:
    return af.Wave.load(bundled_speech())


@bundled
@pytest.mark.skipif(not is_baked(), reason="the human body is not baked (make setup)")
def test_the_demo_is_drawn_as_a_human_unless_a_rig_or_body_is_given(model, tmp_path):
    model.generate(seconds=0.2).save(tmp_path / "rig.bvh")
    pictures, has_skin = {}, {}
    for name, options in {
        "default": {},
        "human": {"body": "human"},
        "mannequin": {"body": "mannequin"},
        "rig": {"rig": tmp_path / "rig.bvh"},
    }.items():
        files = gk.render("demo", (), tmp_path / name, seconds=0.2, formats="html,png", **options)
        page, picture = files[0].files
        has_skin[name] = "skin" in data_of(page)["figures"][0]
        pictures[name] = picture.read_bytes()
    assert has_skin == {"default": True, "human": True, "mannequin": False, "rig": False}
    assert pictures["default"] == pictures["human"] != pictures["mannequin"]


@pytest.fixture(scope="module")
def say():
    """Return say(pitch_range, swing), which varies pitch and energy of the same sentences."""
    pytest.importorskip("espeakng_loader", reason="pip install espeakng-loader")
    sys.path.insert(0, str(RECIPE))
    from voice import Voice, speak

    def make(pitch_range: int, swing: float) -> af.Wave:
        sentences = [
            "I had not thought that it could be so *simple*.",
            "But then we *tried* it again, and this time everything *worked*!",
            "So what I would say is *this*: take your time.",
        ]
        spoken, rate = speak(sentences, Voice("en-us+m2", pitch_range=pitch_range))
        pause = np.zeros(rate // 2, np.float32)
        samples = np.concatenate([part for s in spoken for part in (s, pause)])
        time = np.arange(len(samples)) / rate
        loudness = np.exp(swing * np.sin(2 * np.pi * 0.8 * time))
        return af.Wave((0.5 * samples * loudness).astype(np.float32), rate, None)

    yield make
    sys.path.remove(str(RECIPE))
    sys.modules.pop("voice", None)


def test_the_model_is_small_and_says_where_it_comes_from():
    folder = bundled_speech().parent
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 5 * 2**20
    assert "synthetic" in (folder / "README.md").read_text()


def test_motion_is_plausible(model, speech):
    motion = model.generate(speech)
    assert np.isfinite(motion.rotations).all() and max_speed(motion) < 10.0
    still = [
        name
        for name in model.representation.joints
        if rotation_angles(
            motion.rotations[:, j := motion.skeleton.index(name)], motion.rotations[:1, j]
        ).max()
        < 1e-4
    ]
    assert not still, "joints that move in training"
    feet = motion.positions()[:, [motion.skeleton.index(f"{s}Foot") for s in ("Left", "Right")]]
    assert np.ptp(feet[..., 1]) < 0.1, "feet stay near the floor"


def test_fingers_move_with_the_hands_and_relax(model, speech):
    motion = model.generate(speech)
    fingers = [motion.skeleton.index(name) for name in find_parts(motion.skeleton).fingers]
    assert len(fingers) == 30
    angles = np.degrees(rotation_angles(motion.rotations[:, fingers], IDENTITY))
    assert np.median(np.ptp(angles, axis=0)) > 25
    assert angles.max() < 110
    speed = rotation_angles(motion.rotations[1:, fingers], motion.rotations[:-1, fingers]) * 30
    assert speed.max() < 16  # rad/s
    still = model.generate(seconds=4.0).rotations[:, fingers]
    assert np.degrees(rotation_angles(still, still[:1])).max() < 15


def test_silence_moves_less_than_speech(model, speech):
    silence = af.Wave(np.zeros_like(speech.samples), speech.sample_rate, None)
    idle = arm_speed(model.generate(silence)).mean()
    assert idle < 0.3 * arm_speed(model.generate(speech)).mean()


def test_twenty_decibels_quieter_is_the_same_motion(model, speech):
    quiet = speech.samples * np.float32(0.1)
    # As in a 16-bit file. Rounding may change the choice of a recalled piece, but seldom does.
    rounded = np.round(quiet * 32768) / np.float32(32768)

    def change(samples: np.ndarray, seed: int) -> float:
        soft = model.generate(af.Wave(samples, speech.sample_rate), seed=seed)
        loud = model.generate(speech, seed=seed)
        return np.degrees(rotation_angles(loud.rotations, soft.rotations).max())

    assert change(quiet, 0) < 0.01
    assert np.median([change(rounded, seed) for seed in range(3)]) < 0.1


def test_livelier_speech_moves_the_arms_more(model, say):
    flat, lively = say(pitch_range=5, swing=0.0), say(pitch_range=95, swing=0.7)
    speeds = [
        np.mean([arm_speed(model.generate(wave, seed=seed)).mean() for seed in range(4)])
        for wave in (flat, lively)
    ]
    assert speeds[1] > 1.05 * speeds[0]


def test_sound_without_voice_gives_idle_motion_and_a_warning(model, speech, caplog):
    time = np.arange(6 * speech.sample_rate) / speech.sample_rate
    silence = af.Wave(np.zeros(len(time), np.float32), speech.sample_rate)
    idle = model.generate(silence)
    caplog.clear()
    for sound in (
        1e-3 * np.random.default_rng(0).standard_normal(len(time)),
        0.1 * sum(np.sin(2 * np.pi * 50 * k * time) / k for k in range(1, 9)),
    ):
        wave = af.Wave(sound.astype(np.float32), speech.sample_rate, "fan.wav")
        motion = model.generate(wave)
        np.testing.assert_array_equal(motion.rotations, idle.rotations)
        (warning,) = caplog.messages
        assert warning.startswith("fan.wav: no voice found") and "vad=False (--no-vad)" in warning
        caplog.clear()
        unjudged = model.generate(wave, vad=False)
        assert not caplog.messages
        assert arm_speed(unjudged).mean() > 5 * arm_speed(motion).mean()


def test_a_noise_floor_between_sentences_is_idle(model, speech):
    part, rate = speech.slice(0.0, 6.0), speech.sample_rate
    sound = np.concatenate([part.samples, np.zeros(10 * rate, np.float32), part.samples])
    level = 10 ** (speech.active_level() / 20 - 1)
    floor = level * np.random.default_rng(0).standard_normal(len(sound))
    speed = arm_speed(model.generate(af.Wave((sound + floor).astype(np.float32), rate)))
    said, quiet = speed[: 6 * 30].mean(), speed[8 * 30 : 14 * 30].mean()
    assert quiet < 0.15 * said and speed[-5 * 30 :].mean() > 0.7 * said


def test_bytes_do_not_depend_on_caches(tmp_path):
    speech = af.Wave.load(bundled_speech(), duration=10.0)
    soundfile.write(tmp_path / "speech.wav", speech.samples, speech.sample_rate, subtype="FLOAT")
    kernels = tmp_path / "kernels"
    kernels.mkdir()
    empty = {"NUMBA_CACHE_DIR": str(kernels), "GESTUREKIT_CACHE": str(tmp_path / "features")}
    subprocess.run(
        [sys.executable, "-m", "gesturekit", "render", "speech.wav", "--model=demo", "--out=cold"],
        cwd=tmp_path,
        env={**os.environ, **empty},
        check=True,
        capture_output=True,
    )
    model = gk.load("demo")
    model.generate(seconds=2)  # its kernels are in the cache from here on
    model.generate(tmp_path / "speech.wav", item="speech").save(tmp_path / "warm.bvh")
    cold = (tmp_path / "cold" / "speech.bvh").read_bytes()
    assert cold == (tmp_path / "warm.bvh").read_bytes()
