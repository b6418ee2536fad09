"""Voice activity: speech is found at any level and in noise; noise, hum and clicks are not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from sounds import voiced

import audio_features as af

RATE = 16_000


def coloured(slope: float, seconds: float, seed: int = 0) -> np.ndarray:
    """Noise whose power falls by `slope` · 3 dB an octave above 20 Hz, RMS 1."""
    n = round(seconds * RATE)
    hertz = np.maximum(np.fft.rfftfreq(n, 1 / RATE), 20.0)
    white = np.fft.rfft(np.random.default_rng(seed).standard_normal(n))
    noise = np.fft.irfft(white * hertz ** (-slope / 2), n)
    return noise / noise.std()


def hum(hertz: float, seconds: float) -> np.ndarray:
    """Twenty harmonics over a faint noise floor, RMS 1."""
    time = np.arange(round(seconds * RATE)) / RATE
    tones = sum(np.sin(2 * np.pi * k * hertz * time + k * k) / k for k in range(1, 21))
    return tones / tones.std() + 0.03 * coloured(1.0, seconds)


def typing(seconds: float) -> np.ndarray:
    """Five keystrokes a second, each a click of a few milliseconds and a softer one after it."""
    rng = np.random.default_rng(3)
    n = round(seconds * RATE)
    clicks = np.zeros(n)
    strokes = np.cumsum(rng.uniform(0.12, 0.28, 10 * round(seconds)))
    for delay, size in ((0.0, 1.0), (0.09, 0.4)):
        times = ((strokes + delay) * RATE).astype(int)
        clicks[times[times < n]] = size
    decay = np.exp(-np.arange(400) / 50) * rng.standard_normal(400)
    return np.convolve(clicks, decay)[:n] + 1e-3 * rng.standard_normal(n)


def breath(seconds: float) -> np.ndarray:
    """Noise through a resonance at 600 Hz, which swells and fades every 1.25 s."""
    time = np.arange(round(seconds * RATE)) / RATE
    noise = lfilter([1.0], [1.0, -1.87, 0.93], coloured(0.0, seconds))
    return noise / noise.std() * np.square(np.sin(2 * np.pi * 0.4 * time))


def wave(samples: np.ndarray, rate: int = RATE) -> af.Wave:
    return af.Wave(samples.astype(np.float32), rate)


SOUNDS = {
    "white": coloured(0.0, 20.0),
    "pink": coloured(1.0, 20.0),
    "brown": coloured(2.0, 20.0),
    "blue": coloured(-1.0, 20.0),
    "hum 50": hum(50.0, 20.0),
    "hum 60": hum(60.0, 20.0),
    "buzz 120": hum(120.0, 20.0),
    "typing": typing(20.0),
    "breath": breath(20.0),
}


@pytest.mark.parametrize("name", SOUNDS)
def test_a_sound_without_voice_has_no_voice_at_any_level(name):
    for level in (0.1, 0.001):
        sound = wave(level * SOUNDS[name])
        assert af.voice_activity(sound).shape == (0, 2)
        silenced = af.speech_only(sound)
        assert not silenced.samples.any() and silenced.duration == sound.duration


@pytest.mark.parametrize("name", ["white", "pink", "brown", "hum 50"])
def test_speech_is_found_in_noise_of_half_its_level(name):
    speech = 0.1 * voiced(6.0)
    spoken = speech.std() * SOUNDS[name][: len(speech)]
    for ratio in (0.03, 0.5):
        assert af.voice_activity(wave(speech + ratio * spoken)).tolist() == [[0.0, 6.0]]


@pytest.mark.parametrize("rate", [8_000, 22_050, 48_000])
def test_clean_speech_is_left_as_it_is(rate):
    speech = wave(0.1 * voiced(4.0, rate), rate)
    assert af.speech_only(speech) is speech


def test_the_level_has_no_influence():
    speech = np.concatenate([voiced(3.0), np.zeros(8 * RATE), voiced(4.0)])
    found = af.voice_activity(wave(0.1 * speech + 1e-3 * coloured(1.0, 15.0)))
    quiet = af.voice_activity(wave(0.01 * speech + 1e-4 * coloured(1.0, 15.0)))
    assert found.tolist() == quiet.tolist() and len(found) == 2


def test_only_long_pauses_become_silent_and_the_sound_beside_them_fades():
    floor = 0.01 * coloured(1.0, 19.0)
    long, short, said = np.zeros(8 * RATE), np.zeros(2 * RATE), voiced(3.0)
    sound = wave(0.2 * np.concatenate([said, long, said, short, said]) + floor)
    found = af.voice_activity(sound)
    # Half a second around the voice; the pause of 2 s from 14 s on is part of the speech.
    np.testing.assert_allclose(found, [[0.0, 3.4], [10.6, 19.0]], atol=0.2)
    silenced = af.speech_only(sound).samples
    (_, stop), (start, _) = np.rint(found * RATE).astype(int)
    assert not silenced[stop:start].any()
    np.testing.assert_array_equal(silenced[: stop - RATE // 4], sound.samples[: stop - RATE // 4])
    np.testing.assert_array_equal(silenced[start + RATE // 4 :], sound.samples[start + RATE // 4 :])
    near, last = slice(start, start + RATE // 25), slice(stop - RATE // 25, stop)
    for edge, half in ((near, start + RATE // 8), (last, stop - RATE // 8)):
        assert np.abs(silenced[edge]).max() < 0.02 * np.abs(sound.samples[edge]).max()
        assert silenced[half] == pytest.approx(sound.samples[half] / 8, rel=0.01)


def test_a_pause_of_three_seconds_at_an_end_becomes_silent():
    pause = np.zeros(4 * RATE)
    sound = np.concatenate([pause, voiced(3.0), pause]) + 0.05 * coloured(0.0, 11.0)
    np.testing.assert_allclose(af.voice_activity(wave(sound)), [[3.5, 7.4]], atol=0.2)
    short = sound[2 * RATE : 9 * RATE]
    assert af.voice_activity(wave(short)).tolist() == [[0.0, 7.0]]


def test_less_than_a_second_counts_as_voice():
    assert af.voice_activity(wave(0.1 * SOUNDS["white"][:15_000])).tolist() == [[0.0, 0.9375]]
    assert len(af.voice_activity(wave(0.1 * SOUNDS["white"][:16_000]))) == 0


def test_a_word_in_ten_seconds_of_noise_is_found():
    word = np.zeros(10 * RATE)
    word[4 * RATE :][: RATE // 2] = voiced(0.5)
    found = af.voice_activity(wave(0.1 * word + 0.02 * SOUNDS["pink"][: len(word)]))
    np.testing.assert_allclose(found, [[3.5, 5.0]], atol=0.25)


def test_recorded_speech_is_found_down_to_10_db(shared_data):
    files = sorted((shared_data / "speech").glob("*/*.flac"))[1::6]
    assert files
    for number, file in enumerate(files):
        speech = af.Wave.load(file).resample(RATE)
        level = 10 ** (speech.active_level() / 20 - 0.5)
        noise = coloured(1.0, speech.duration + 1, seed=number)[: len(speech.samples)]
        for sound in (speech, wave(speech.samples + level * noise)):
            kept = np.ptp(af.voice_activity(sound), axis=1).sum() / speech.duration
            assert kept > 0.9, file.name


def test_a_long_sound_is_judged_in_pieces_as_a_short_one():
    minute = 0.1 * voiced(60.0) + 0.01 * coloured(1.0, 60.0)
    minute[20 * RATE : 40 * RATE] = 0.01 * coloured(1.0, 20.0)
    found = af.voice_activity(wave(minute))
    np.testing.assert_allclose(found, [[0.0, 20.4], [39.6, 60.0]], atol=0.2)
    part = af.voice_activity(wave(minute[: 30 * RATE]))
    np.testing.assert_allclose(part, [found[0]], atol=0.05)


def tone(seconds: float, hertz: float = 150.0, rate: int = RATE) -> np.ndarray:
    """A steady voice: nine harmonics of a pitch."""
    time = np.arange(round(seconds * rate)) / rate
    return 0.1 * sum(np.sin(2 * np.pi * k * hertz * time) for k in range(1, 10))


def spoken_at(total: float, *parts: tuple[float, float]) -> np.ndarray:
    """Noise with voices (begin, end), seconds."""
    sound = 0.002 * coloured(1.0, total)
    for begin, end in parts:
        at = round(begin * RATE)
        voice = tone(end - begin)
        sound[at : at + len(voice)] += voice
    return sound


@pytest.mark.parametrize(
    ("parts", "stretches"),
    [
        # Stretches begin half a second before a voice; the first 3 s belong to what follows them.
        ([(3.35, 4.35)], [(0.0, 4.85)]),
        ([(3.65, 4.65)], [(3.15, 5.15)]),
        ([(7.35, 8.35)], [(6.85, 8.85)]),
        ([(7.65, 8.65)], [(7.15, 12.0)]),
        # Pauses of less than 3 s between two voices are part of the speech.
        ([(4.0, 5.0), (7.85, 8.0)], [(3.5, 8.5)]),
        ([(4.0, 4.8), (8.0, 8.2)], [(3.5, 5.3), (7.5, 8.7)]),
    ],
)
def test_stretches_are_worked_out_from_voices(parts, stretches):
    """Frames are 20 ms apart and see 64 ms, so that ends are found within 40 ms."""
    found = af.voice_activity(wave(spoken_at(12.0, *parts)))
    np.testing.assert_allclose(found, stretches, atol=0.05)


@pytest.mark.parametrize(("seconds", "is_voice"), [(0.1, False), (0.2, True)])
def test_a_voice_lasts_a_seventh_of_a_second(seconds, is_voice):
    found = af.voice_activity(wave(spoken_at(12.0, (6.0, 6.0 + seconds))))
    assert (len(found) == 1) == is_voice


@pytest.mark.parametrize(("hertz", "is_voice"), [(55.0, False), (75.0, True), (450.0, True)])
def test_a_voice_is_above_65_hz(hertz, is_voice):
    sound = 0.002 * coloured(1.0, 12.0)
    sound[5 * RATE : 7 * RATE] += tone(2.0, hertz)
    assert (len(af.voice_activity(wave(sound))) == 1) == is_voice


@pytest.mark.parametrize(("step", "is_one_voice"), [(0.06, True), (0.3, False)])
def test_pitch_that_leaps_is_no_voice(step, is_one_voice):
    """Tones of 0.1 s each, a twelfth or a third apart: links reach over a change of ln 0.12."""
    sound = 0.002 * coloured(1.0, 12.0)
    for k in range(12):
        at = round((5 + 0.1 * k) * RATE)
        own = tone(0.1, 150 * np.exp(step * (k % 2)))
        sound[at : at + len(own)] += own
    assert (len(af.voice_activity(wave(sound))) == 1) == is_one_voice
