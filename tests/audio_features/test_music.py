from __future__ import annotations

import numpy as np
import pytest

from audio_features import FeatureError, Music, Prosody, Stack, Wave
from audio_features.acoustic import music as music_module
from audio_features.acoustic.analysis import ShortTimeSpectrum
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
    for wrong in (0, 99):
        with pytest.raises(FeatureError, match=str(wrong)):
            Music(n_chroma=wrong)


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


def clicks(bpm: float, seconds: float = 18.0) -> np.ndarray:
    """A flux (T,) of bells around each beat, the first of which is half a beat after 0."""
    beats = np.arange(round(100 * seconds)) / 100 * bpm / 60
    return np.exp(-0.5 * ((beats % 1 - 0.5) / 0.1) ** 2)


@pytest.mark.parametrize(("bpm", "agrees"), [(52.0, True), (196.0, True), (230.0, False)])
def test_tempos_up_to_200_beats_a_minute_are_searched(bpm, agrees):
    flux = clicks(bpm)
    inner = slice(300, 1500)
    pulse = local_pulse(flux)[inner]
    assert (np.median(pulse[flux[inner] > 0.99]) > 0.9) == agrees
    assert pulse[flux[inner] < 0.01].max(initial=0.0) < 0.1 or not agrees


def test_a_tempo_below_50_is_answered_by_its_double():
    flux, pulse = clicks(30.0), local_pulse(clicks(30.0))
    twice = np.arange(1800) % 100 == 0
    assert twice.sum() == 18 and (pulse[300:1500][twice[300:1500]] > 0.9).all()
    assert (flux[twice] > 0.99).sum() == 9
    assert not local_pulse(np.full(2000, 3.0))[600:-600].any(), "a steady flux has no beat"
    assert len(local_pulse(flux[:250])) == 250
