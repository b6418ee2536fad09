"""Voice activity: speech is found at any level and in noise; noise, hum and clicks are not."""

import numpy as np
import pytest
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


def wave(samples: np.ndarray, rate: int = RATE) -> af.Wave:
    return af.Wave(samples.astype(np.float32), rate)


SOUNDS = {
    "white": coloured(0.0, 8.0),
    "pink": coloured(1.0, 8.0),
    "blue": coloured(-1.0, 8.0),
    "hum 50": hum(50.0, 8.0),
    "hum 60": hum(60.0, 8.0),
}


@pytest.mark.parametrize("name", SOUNDS)
def test_a_sound_without_voice_has_no_voice_at_any_level(name):
    for level in (0.1, 0.001):
        sound = wave(level * SOUNDS[name])
        assert af.voice_activity(sound).shape == (0, 2)
        silenced = af.speech_only(sound)
        assert not silenced.samples.any() and silenced.duration == sound.duration


@pytest.mark.parametrize("name", ["white", "pink", "hum 50"])
def test_speech_is_found_in_noise_of_half_its_level(name):
    speech = 0.1 * voiced(6.0)
    spoken = speech.std() * SOUNDS[name][: len(speech)]
    for ratio in (0.03, 0.5):
        assert af.voice_activity(wave(speech + ratio * spoken)).tolist() == [[0.0, 6.0]]


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
    for edge in (near, last):
        assert np.abs(silenced[edge]).max() < 0.1 * np.abs(sound.samples[edge]).max()


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
