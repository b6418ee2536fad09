import numpy as np
import pytest

from audio_features import Music, Wave

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


@pytest.mark.parametrize(("n_chroma", "of_c_sharp"), [(12, 4), (5, 2)])
def test_chroma_are_shares_of_the_power_from_100_hz_to_5_khz(n_chroma, of_c_sharp):
    """A and C sharp of half its amplitude, a fourth of its power; louder notes are out of range.

    C sharp is 4 of 12 steps above A, and 4 / 12 * 5 = 1.7 of 5.
    """
    times = np.arange(32_000) / 16_000
    notes = ((440.0, 0.1), (554.37, 0.05), (58.27, 0.2), (6644.9, 0.2))
    sound = sum(level * np.sin(2 * np.pi * hertz * times) for hertz, level in notes)
    found = Music(n_chroma).extract(Wave(sound.astype(np.float32), 16_000)).values[:, :n_chroma]
    expected = np.zeros(n_chroma)
    expected[[0, of_c_sharp]] = 0.8, 0.2
    np.testing.assert_allclose(found[20:180], np.tile(expected, (160, 1)), atol=0.03)
