"""The bundled model does what the README promises."""

import os
import subprocess
import sys

import numpy as np
import pytest
import soundfile

import audio_features as af
import gesturekit as gk
from gesturekit.evaluation import arm_speed, max_speed
from gesturekit.motion.rotations import rotation_angles
from gesturekit.systems import bundled_speech


@pytest.fixture(scope="module")
def model():
    return gk.load("demo")


@pytest.fixture(scope="module")
def speech() -> af.Wave:
    return af.Wave.load(bundled_speech())


def test_twenty_decibels_quieter_is_the_same_motion(model, speech):
    quiet = af.Wave(speech.samples * np.float32(0.1), speech.sample_rate)
    soft, loud = model.generate(quiet), model.generate(speech)
    assert np.degrees(rotation_angles(loud.rotations, soft.rotations).max()) < 0.01


def test_the_model_is_small_and_says_where_it_comes_from():
    folder = bundled_speech().parent
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 6 * 2**20
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


def test_sound_without_voice_gives_idle_motion_and_a_warning(model, speech, caplog):
    time = np.arange(3 * speech.sample_rate) / speech.sample_rate
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
        assert all(fact in warning for fact in ("fan.wav", "vad=False", "--no-vad"))
        caplog.clear()
        unjudged = model.generate(wave, vad=False)
        assert not caplog.messages
        assert arm_speed(unjudged).mean() > 1.5 * arm_speed(motion).mean()


@pytest.mark.stress
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
