from __future__ import annotations

import sys

import numpy as np
import pytest

from audio_features import FeatureError, Music, Prosody, Stack, Wave
from audio_features.acoustic import music as music_module
from audio_features.acoustic.music import local_pulse
from audio_features.librosa_import import import_librosa

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


def test_chroma_names_the_notes():
    track = Music().extract(song(120))
    chroma = track.values[:, :12]
    assert chroma.min() >= 0 and np.abs(chroma[100:-50].sum(axis=1) - 1).max() < 1e-2
    a_major, c_major = chroma[120:200].mean(axis=0), chroma[320:400].mean(axis=0)
    assert set(np.argsort(a_major)[-3:]) == {0, 4, 7}  # A, C sharp, E
    assert set(np.argsort(c_major)[-3:]) == {3, 7, 10}  # C, E, G


def test_silence_and_steady_noise_have_no_beat():
    silence = Music().extract(Wave(np.zeros(80_000, np.float32), 16_000))
    assert not silence.values.any()
    noise = 0.1 * np.random.default_rng(0).standard_normal(160_000)
    steady = Music().extract(Wave(noise.astype(np.float32), 16_000)).values[:, -1]
    assert steady.mean() < Music().extract(song(120)).values[:, -1].mean()


def test_the_pulse_agrees_with_librosas_and_does_not_depend_on_blocks(monkeypatch):
    librosa = import_librosa()
    flux = Music().extract(song(110)).values[:, -2].astype(np.float64)
    whole = local_pulse(flux)
    tempo = {"win_length": 600, "tempo_min": 50, "tempo_max": 200}
    theirs = librosa.beat.plp(onset_envelope=flux, sr=100, hop_length=1, **tempo)
    assert np.corrcoef(whole, theirs)[0, 1] > 0.98
    monkeypatch.setattr(music_module, "_BLOCK_FRAMES", 271)
    np.testing.assert_allclose(local_pulse(flux), whole, atol=1e-6)


def test_sizes_of_music():
    wave = song(120, 3.0)
    three = Music(n_chroma=1).extract(wave)
    assert three.names == ("chroma_0", "spectral_flux", "beat_activation")
    np.testing.assert_array_equal(three.values[:, 0], Prosody().extract(wave).values[:, 2])
    both = Stack([Music(), Prosody()]).extract(wave)
    np.testing.assert_array_equal(both.values[:, :14], Music().extract(wave).values)
    for wrong in ({"n_chroma": 0}, {"n_chroma": 99}, {"beats": "ear"}):
        with pytest.raises(FeatureError, match=str(*wrong.values())):
            Music(**wrong)


def test_madmom_is_optional_and_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "madmom", None)
    with pytest.raises(FeatureError, match="needs the package madmom.*beats='librosa'"):
        Music(beats="madmom")
