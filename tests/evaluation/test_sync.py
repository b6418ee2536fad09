from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from audio_features import Wave
from gesturekit.errors import MotionError
from gesturekit.evaluation import arm_speed, speech_envelope, sync

ELBOW, SHOULDER = "LeftForeArm", "RightArm"


@pytest.mark.parametrize("shift", [-5, 0, 3])
def test_the_lag_of_a_motion_made_from_the_sound_is_found(turning, speaking, curve, shift):
    loudness = curve(500, seed=0)
    speed = 4.0 * np.roll(loudness, shift)
    # From frame k to k + 1 it turns with the mean of what it is to have at either.
    motion = turning({ELBOW: 0.5 * (speed + np.roll(speed, -1))})
    result = sync(motion, speaking(5.0 * loudness))
    assert result.r > 0.97
    assert result.lag == pytest.approx(shift / 25.0)  # positive: after the sound
    assert result.z > 3.0 and result.note == ""


def test_a_motion_shifted_out_of_reach_scores_no_better_than_chance(turning, speaking, curve):
    loudness = curve(1500, seed=0)
    result = sync(turning({ELBOW: 4.0 * np.roll(loudness, 700)}), speaking(5.0 * loudness))
    assert result.r < 0.4
    assert abs(result.z) < 2.5


def test_unrelated_motion_scores_z_near_zero_on_average(turning, speaking, curve):
    z = [
        sync(turning({ELBOW: 4.0 * curve(500, seed)}), speaking(5.0 * curve(500, 100 + seed))).z
        for seed in range(40)
    ]
    assert abs(np.mean(z)) < 0.5
    assert 0.6 < np.std(z) < 1.6


def test_the_figures_are_those_of_the_definition_written_out(turning, speaking, curve):
    fps, n = 25.0, 120
    motion = turning({ELBOW: 4.0 * curve(n, 0), SHOULDER: 2.0 * curve(n, 1)}, fps)
    wave = speaking(5.0 * curve(n, 0) + curve(n, 3), fps)
    x = gaussian_filter1d(arm_speed(motion), 0.1 * fps, mode="nearest")
    y = gaussian_filter1d(speech_envelope(wave, fps, n), 0.1 * fps, mode="nearest")

    def best(y):
        rs = []
        for lag in range(-7, 8):
            k = np.arange(max(0, -lag), n - max(0, lag))
            rs.append(np.corrcoef(x[k + lag], y[k])[0, 1])
        return max(rs), (int(np.argmax(rs)) - 7) / fps

    chance = [best(np.roll(y, shift))[0] for shift in range(26, n - 25)]
    result = sync(motion, wave)
    assert (result.r, result.lag) == pytest.approx(best(y), abs=1e-9)
    assert result.chance_mean == pytest.approx(np.mean(chance), abs=1e-9)
    assert result.chance_sd == pytest.approx(np.std(chance), abs=1e-9)
    assert result.z == pytest.approx((result.r - np.mean(chance)) / np.std(chance), abs=1e-6)


def test_louder_or_quieter_speech_scores_the_same(turning, speaking, curve):
    loudness = curve(300, seed=0)
    motion, wave = turning({ELBOW: 4.0 * loudness}), speaking(5.0 * loudness + 3.0)
    quieter = Wave(0.5 * wave.samples, wave.sample_rate)
    assert sync(motion, quieter).r == pytest.approx(sync(motion, wave).r, abs=5e-3)


def test_standing_still_and_silence_score_zero_and_say_why(turning, speaking, curve):
    loudness = curve(200, seed=0)
    moving, wave = turning({ELBOW: 4.0 * loudness}), speaking(5.0 * loudness)
    still = turning({ELBOW: np.zeros(200)})
    silence = Wave(np.zeros_like(wave.samples), wave.sample_rate)
    for result, reason in (
        (sync(still, wave), "arms do not move"),
        (sync(moving, silence), "silence"),
    ):
        assert (result.r, result.lag, result.chance_mean, result.z) == (0.0, 0.0, 0.0, 0.0)
        assert reason in result.note and reason in str(result)


def test_a_clip_too_short_for_chance_says_so_and_a_shorter_one_is_refused(turning, speaking, curve):
    loudness = curve(200, seed=0)
    wave = speaking(5.0 * loudness)
    result = sync(turning({ELBOW: 4.0 * loudness[:40]}), wave)
    assert math.isfinite(result.r) and result.z == 0.0 and "too short" in result.note
    with pytest.raises(MotionError, match="8 frames at 25 fps"):
        sync(turning({ELBOW: 4.0 * loudness[:8]}), wave)


def test_the_envelope_is_the_rms_around_each_frame():
    rate, fps = 16000, 25.0
    time = np.arange(2 * rate) / rate
    loud = np.where(time < 1.0, 0.01, 0.1)
    wave = Wave((loud * np.sqrt(2) * np.sin(2 * np.pi * 400 * time)).astype(np.float32), rate)
    envelope = speech_envelope(wave, fps, 60)
    assert envelope[[5, 20]] == pytest.approx(np.log(0.01 + 1e-4), abs=1e-3)
    assert envelope[[30, 45]] == pytest.approx(np.log(0.1 + 1e-4), abs=1e-3)
    assert envelope[25] == pytest.approx(np.log(np.sqrt((0.01**2 + 0.1**2) / 2) + 1e-4), abs=1e-2)
    assert envelope[55] == pytest.approx(np.log(1e-4))
