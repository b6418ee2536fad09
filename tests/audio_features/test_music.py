import numpy as np
import pytest

from audio_features import Music, Wave
from audio_features.acoustic.analysis import ShortTimeSpectrum

CHORDS = ((220.0, 277.18, 329.63), (261.63, 329.63, 392.0))  # A major, C major


def song(bpm: float, seconds: float = 16.0, rate: int = 22_050, start: float = 0.25) -> Wave:
    """Clicks on the beat, under chords that change every four beats."""
    times = np.arange(round(seconds * rate)) / rate
    beat = np.floor((times - start) * bpm / 60)
    since = (times - start) - beat * 60 / bpm
    sound = 0.3 * np.random.default_rng(0).standard_normal(len(times)) * np.exp(-since / 0.01)
    for k, chord in enumerate(CHORDS):
        tones = sum(np.sin(2 * np.pi * hertz * times) for hertz in chord)
        sound += np.where(beat // 4 % 2 == k, 0.1 * tones * np.exp(-since / 0.5), 0.0)
    return Wave(np.where(times < start, 0.0, sound).astype(np.float32), rate)


@pytest.mark.parametrize("bpm", [60, 97, 120, 150])
def test_beats_are_where_the_clicks_are(bpm):
    track = Music().extract(song(bpm))
    beats = track.values[:, track.names.index("beat_activation")]
    inner = slice(1, -1)
    tops = (beats[inner] > beats[:-2]) & (beats[inner] >= beats[2:]) & (beats[inner] > 0.3)
    found = track.times[inner][tops]
    found = found[found < 15.4]  # at the very end half of each window is empty
    meant = np.arange(0.25, 15.4, 60 / bpm)
    assert len(found) == len(meant)
    assert np.abs(found[:, None] - meant).min(axis=1).max() <= 0.04
    assert 0.9 < beats.max() <= 1.0 and beats.min() == 0.0


@pytest.mark.parametrize("n_chroma", [12, 5])
def test_chroma_are_shares_of_the_power_from_100_hz_to_5_khz(n_chroma):
    """The expected power is that of a Hann window of 3072 samples around each frame."""
    wave = song(120, 3.0, 16_000)
    prepared = ShortTimeSpectrum(wave).wave.samples.astype(float)
    found = Music(n_chroma).extract(wave).values[:, :n_chroma]
    padded, window = np.pad(prepared, 1536), np.hanning(3073)[:-1]
    hertz = np.arange(1537) * 16_000 / 3072
    inside = (hertz >= 100) & (hertz <= 5000)
    classes = np.rint(n_chroma * np.log2(np.maximum(hertz, 1) / 440)).astype(int) % n_chroma
    for k in (3, 40, 150, 299):
        power = np.abs(np.fft.rfft(padded[160 * k : 160 * k + 3072] * window)) ** 2
        own = np.bincount(classes[inside], power[inside], n_chroma)
        np.testing.assert_allclose(found[k], own / (own.sum() + 1e-3), atol=1e-3)
