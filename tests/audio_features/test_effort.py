"""Vocal effort: pitch in semitones and spectral tilt, whatever the level of the recording."""

from __future__ import annotations

import numpy as np
import pytest

from audio_features import Effort, FeatureError, Wave

RATE = 16_000
COLUMNS = ("effort_f0_median", "effort_f0_high", "effort_tilt")


def harmonic(hertz: np.ndarray | float, seconds: float = 3.0) -> np.ndarray:
    """Five harmonics of a pitch, each half of the one before."""
    phase = 2 * np.pi * np.cumsum(np.broadcast_to(hertz, round(seconds * RATE))) / RATE
    return 0.1 * sum(np.sin(k * phase) / 2**k for k in range(1, 6))


def band(low: float, high: float, seconds: float = 3.0) -> np.ndarray:
    """Noise of these frequencies only."""
    noise = np.fft.rfft(np.random.default_rng(0).standard_normal(round(seconds * RATE)))
    hertz = np.fft.rfftfreq(round(seconds * RATE), 1 / RATE)
    noise[(hertz < low) | (hertz > high)] = 0.0
    return 0.05 * np.fft.irfft(noise)


def effort(samples: np.ndarray, **options) -> np.ndarray:
    track = Effort(**options).extract(Wave(samples.astype(np.float32), RATE))
    assert track.names == COLUMNS
    assert Effort.centred == (False,) * 3  # calm clips have low values throughout
    return track.values


@pytest.mark.parametrize("hertz", [90.0, 120.0, 240.0, 400.0])
def test_pitch_is_in_semitones_above_60_hz(hertz):
    values = effort(harmonic(hertz))
    expected = 12 * np.log2(hertz / 60)  # 12 for 120 Hz, 24 for 240 Hz
    np.testing.assert_allclose(values[:, :2], expected, atol=0.15)


def test_effort_has_median_and_high_pitch_of_a_rising_voice():
    glide = np.where(np.arange(4 * RATE) < 3.2 * RATE, 120.0, 240.0)
    values = effort(harmonic(glide, 4.0), seconds=120)
    np.testing.assert_allclose(values[:, 0], 12.0, atol=0.3)
    np.testing.assert_allclose(values[:, 1], 24.0, atol=0.3)


def test_windows_follow_a_voice_that_becomes_calmer():
    halves = np.concatenate([harmonic(240.0, 12.0), harmonic(120.0, 12.0)])
    median = effort(halves, seconds=4.0)[:, 0]
    before, after = median[400], median[-400]
    # Half a second of the clip's own value counts too.
    assert 22.0 < before < 24.2 and 11.8 < after < 14.0
    assert (np.diff(median) < 0.2).all(), "no jump up on the way"
    assert np.ptp(effort(halves, seconds=120)[:, 0]) < np.ptp(median) / 4


def test_a_window_holds_half_a_second_of_the_clips_own_value():
    """Most of the clip is at 100 Hz, 8.84 semitones; 4 s at 200 Hz, 20.84: (4 + 0.5) s in all."""
    samples = np.concatenate([harmonic(100.0, 12.0), harmonic(200.0, 6.0)])
    median = effort(samples, seconds=4.0)[:, 0]
    assert median[1500] == pytest.approx((4.0 * 20.84 + 0.5 * 8.84) / 4.5, abs=0.15)


def test_tilt_is_the_power_above_1_khz_over_that_below():
    time = np.arange(3 * RATE) / RATE

    def tilt(samples: np.ndarray) -> float:
        return float(np.median(effort(samples)[:, 2]))

    low, high = np.sin(2 * np.pi * 500 * time), np.sin(2 * np.pi * 2500 * time)
    assert tilt(0.1 * low + 0.01 * high) == pytest.approx(-20.0, abs=1.0)
    assert tilt(0.05 * low + 0.05 * high) == pytest.approx(0.0, abs=1.0)
    assert tilt(band(100, 800)) < -20 and tilt(band(1200, 4800)) > 20
    assert abs(tilt(band(100, 800) + band(1200, 4800))) < 15


def test_the_level_of_the_recording_does_not_count(speech):
    loud, quiet = (effort(gain * speech.samples) for gain in (1.0, 0.1))
    np.testing.assert_allclose(quiet, loud, atol=0.1)
    assert np.ptp(loud[:, 2]) < 60 and loud[:, 2].mean() < 0


@pytest.mark.parametrize("seconds", [0.025, 0.05, 3.0])
@pytest.mark.parametrize("level", [0.0, 1e-7])
def test_silence_is_finite(seconds, level):
    noise = np.random.default_rng(0).standard_normal(round(seconds * RATE))
    values = effort(level * noise)
    assert len(values) and np.isfinite(values).all()
    assert (values[:, :2] == 0).all()
    if not level:
        assert (values[:, 2] == -30).all()


def test_pauses_do_not_lower_the_effort():
    voice = harmonic(200.0, 4.0)
    paused = voice.copy()
    for start in range(0, 4 * RATE, RATE):
        paused[start + RATE // 4 : start + RATE] = 0.0
    np.testing.assert_allclose(effort(paused)[:, :2], effort(voice)[:, :2], atol=0.3)


@pytest.mark.parametrize("seconds", [0, -1.0, 0.4, 121, float("nan"), "8", None])
def test_a_bad_window_is_one_error(seconds):
    with pytest.raises(FeatureError, match="seconds=.*: a number from 0.5 to 120"):
        Effort(seconds=seconds)
