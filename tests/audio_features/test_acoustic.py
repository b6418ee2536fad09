"""Acoustic features: bands, pitch, energy, onsets, prosodic_range, and vocal effort."""

import numpy as np
import pytest
import soundfile

from audio_features import (
    MFCC,
    Effort,
    FeatureError,
    LogMel,
    Onset,
    ProsodicRange,
    Prosody,
    Stack,
    Wave,
)
from audio_features import acoustic as analysis
from audio_features.acoustic import import_librosa, track_pitch

EVERYTHING = Stack([LogMel(), MFCC(), Prosody()])


def test_a_stack_and_long_sounds_give_what_parts_give(speech):
    """Thirty-six seconds are more than is processed at a time."""
    alone = [part.extract(speech).values for part in EVERYTHING.parts]
    np.testing.assert_array_equal(EVERYTHING.extract(speech).values, np.concatenate(alone, 1))
    long = EVERYTHING.extract(Wave(np.tile(speech.samples, 9), 16_000)).values[400:3200]
    periods = long.reshape(7, 400, -1)
    np.testing.assert_allclose(periods, np.broadcast_to(periods[:1], periods.shape), atol=2e-3)


def columns(track, name: str) -> np.ndarray:
    return track.values[:, track.names.index(name)]


def test_the_same_words_20_db_quieter_in_16_bits_give_the_same_features(speech, tmp_path):
    tracks = []
    room = 1e-4 * np.random.default_rng(0).standard_normal(len(speech.samples))
    for name, gain in (("loud.wav", 1.0), ("quiet.wav", 0.1)):
        soundfile.write(tmp_path / name, gain * (speech.samples + room), 16_000, subtype="PCM_16")
        tracks.append(EVERYTHING.extract(Wave.load(tmp_path / name)))
    loud, quiet = tracks
    difference = np.sqrt(np.mean((loud.values - quiet.values) ** 2, axis=0))
    assert difference[:24].max() < 1.5  # dB
    assert (difference / loud.values.std(axis=0))[-4:].max() < 0.1


@pytest.mark.parametrize("seconds", [0.025, 0.05, 3.0])
def test_silence_is_the_floor(seconds):
    wave = Wave(np.zeros(round(16_000 * seconds), np.float32), 16_000)
    track = EVERYTHING.extract(wave)
    np.testing.assert_allclose(track.values[:, :24], -60, atol=1e-3)
    assert (columns(track, "f0") == 0).all() and (columns(track, "voicing") == 0).all()
    np.testing.assert_allclose(columns(track, "energy"), -60, atol=1e-3)
    assert (columns(track, "onset") == 0).all()


@pytest.mark.parametrize("kind", ["noise", "clicks", "constant", "quiet noise"])
def test_sound_without_a_voice_gives_finite_prosody(kind):
    samples = np.zeros(32_000, np.float32)
    if "noise" in kind:
        samples += np.random.default_rng(0).standard_normal(32_000).astype(np.float32)
        samples *= 1e-7 if kind == "quiet noise" else 0.1
    elif kind == "clicks":
        samples[::4_001] = 1.0
    else:
        samples += 0.5
    track = Prosody().extract(Wave(samples, 16_000))  # FeatureTrack refuses what is not finite
    assert np.mean(columns(track, "voicing") > 0.6) < 0.05


def test_prosody_follows_the_voice(speech):
    track = Prosody().extract(speech)
    voiced = columns(track, "voicing") > 0.8
    assert voiced.mean() > 0.3
    hertz = 150.0 + 30.0 * np.sin(2 * np.pi * 0.5 * track.times)
    expected = 12 * np.log2(hertz / np.median(hertz[voiced]))
    error = np.abs(columns(track, "f0") - expected)[voiced]
    assert np.median(error) < 0.2 and np.mean(error < 0.5) > 0.95
    syllable = (track.times % 0.4) < 0.2
    pause = np.abs(track.times % 0.4 - 0.325) < 0.03
    assert columns(track, "energy")[pause].max() < -35 < -15 < columns(track, "energy").max()
    assert columns(track, "onset")[syllable].mean() > 3 * columns(track, "onset")[pause].mean()


def test_settings_out_of_range_are_refused():
    assert (LogMel(80).n_mels, LogMel(1).n_mels, MFCC(40).n, MFCC(1).n) == (80, 1, 40, 1)
    for kind, wrong in ((LogMel, 0), (LogMel, 81), (MFCC, 41), (MFCC, 2.5)):
        with pytest.raises(FeatureError, match=str(wrong)):
            kind(wrong)


def test_an_unknown_tracker_or_backend_is_named():
    with pytest.raises(FeatureError, match="(?=.*'crepe').*yin"):
        Prosody("crepe")
    with pytest.raises(FeatureError, match="(?=.*'librosa').*numpy"):
        LogMel(backend="librosa")


def test_onsets_are_where_syllables_begin(speech):
    track = Onset().extract(speech)
    peaks = track.times[columns(track, "onset_peak") == 1]
    rise = peaks[peaks > 0.1] % 0.4
    assert 8 <= len(rise) <= 16 and np.mean(np.minimum(rise, 0.4 - rise) < 0.08) > 0.7
    prosody = Prosody().extract(speech)
    np.testing.assert_array_equal(columns(track, "onset_strength"), columns(prosody, "onset"))


def test_values_are_those_of_librosa_which_is_not_imported(speech):
    librosa = import_librosa()
    for n_mels in (1, 24, 80):
        theirs = librosa.filters.mel(sr=16_000, n_fft=512, n_mels=n_mels, fmin=50.0, norm=None)
        np.testing.assert_allclose(analysis.mel_filters(n_mels), theirs, atol=1e-6)
    noise = 0.1 * np.random.default_rng(0).standard_normal(16_000).astype(np.float32)
    for wave in (speech, Wave(noise, 16_000)):
        prepared = analysis.ShortTimeSpectrum(wave)
        f0, _ = track_pitch(prepared.wave.samples, prepared.n_frames)
        padded = np.pad(prepared.wave.samples, (512, 1024))
        frames = {"sr": 16_000, "frame_length": 1024, "hop_length": 160, "center": False}
        theirs = librosa.yin(padded, fmin=60.0, fmax=500.0, **frames)
        np.testing.assert_allclose(f0, theirs[: len(f0)], rtol=1e-4)
        around = {"pre_max": 3, "post_max": 1, "pre_avg": 10, "post_avg": 11}
        picked = librosa.util.peak_pick(prepared.onset, **around, delta=1.0, wait=3)
        assert len(picked) > 3
        bands = LogMel(40).extract(wave).values.T
        theirs = librosa.feature.mfcc(S=bands, n_mfcc=20)
        np.testing.assert_allclose(MFCC(20).extract(wave).values.T, theirs, atol=1e-3)
        np.testing.assert_array_equal(np.flatnonzero(Onset().extract(wave).values[:, 1]), picked)


RATE = 16_000


def sine(hertz: float, seconds: float = 1.0, level_db: float = 0.0) -> np.ndarray:
    """A tone with an amplitude of 0.1 at 0 dB."""
    times = np.arange(round(seconds * RATE)) / RATE
    return 0.1 * 10 ** (level_db / 20) * np.sin(2 * np.pi * hertz * times)


def wave(*parts: np.ndarray) -> Wave:
    return Wave(np.concatenate(parts).astype(np.float32), RATE)


def test_prosodic_range_is_the_mean_distance_from_the_local_mean():
    """Half seconds of two kinds: both are half of the difference away from their mean."""
    quick = ProsodicRange(2.0).extract(wave(*[sine(150), sine(189)] * 4)).values[400]
    assert quick == pytest.approx([2.0, 0.0], abs=0.3)  # 12 log2(189 / 150) = 4
    loud = ProsodicRange(2.0).extract(wave(*[sine(150), sine(150, level_db=-12)] * 4)).values[400]
    assert loud == pytest.approx([0.0, 6.0], abs=0.3)
    assert ProsodicRange(0.5).spec["seconds"] == 0.5
    for wrong in (0.01, 100, "1", None):
        with pytest.raises(FeatureError, match=repr(wrong)):
            ProsodicRange(wrong)


def test_effort_is_a_quantile_with_half_a_second_of_the_clips_own():
    """Six seconds an octave above 60 Hz, then two seconds of two octaves, 12 and 24 semitones."""
    effort = Effort(1.5).extract(wave(sine(120, 6.0), sine(240, 2.0)))
    assert not any(Effort.centred), "calm clips have low values throughout"
    # Of the clip the median is 12 and the 90 % quantile 24; windows have 1.5 s.
    early, late = effort.values[200], effort.values[700]
    assert early[:2] == pytest.approx([12, (1.5 * 12 + 0.5 * 24) / 2], abs=0.2)
    assert late[:2] == pytest.approx([(1.5 * 24 + 0.5 * 12) / 2, 24], abs=0.2)
    # Of 1 to 5 kHz and below 1 kHz, 1 % of the power; at 6 kHz there may be as much as one likes.
    bright = wave(sine(500, 2.0) + sine(2000, 2.0, -20) + sine(6000, 2.0))
    assert Effort().extract(bright).values[100, 2] == pytest.approx(-20, abs=0.2)


def test_voicing_is_the_share_of_power_that_repeats():
    """Half of a tone and noise of equal power is the same one period later."""
    tone = sine(200, 2.0)
    noise = tone.std() * np.random.default_rng(0).standard_normal(len(tone))
    for share, sound in ((1.0, tone), (0.5, tone + noise)):
        voicing = columns(Prosody().extract(wave(sound)), "voicing")[20:180]
        assert np.median(voicing) == pytest.approx(share, abs=0.1)


def test_energy_and_power_are_relative_to_active_speech():
    """A second each, 12 dB apart: their mean is (1 + 0.0631) / 2 of the louder, -2.75 dB."""
    energy = columns(Prosody().extract(wave(sine(200), sine(200, level_db=-12))), "energy")
    np.testing.assert_allclose(energy[20:80], 2.75, atol=0.2)
    np.testing.assert_allclose(energy[120:180], 2.75 - 12, atol=0.2)
    # All of a steady sound is at the mean, and so is the sum of its powers (Parseval's theorem).
    steady = wave(sine(1_000))
    power = analysis.ShortTimeSpectrum(steady).power
    np.testing.assert_allclose(power[10:90].sum(axis=1), 1.0, rtol=0.01)
    assert (power[10:90].argmax(axis=1) == 32).all(), "bins of 31.25 Hz"
    bands = LogMel(8).extract(steady).values[10:90]
    np.testing.assert_allclose((10 ** (bands / 10)).sum(axis=1), 1.0, rtol=0.01)


def test_a_click_is_in_the_frame_of_its_time_and_a_step_an_onset_of_its_size():
    click = np.zeros(2 * RATE)
    click[RATE] = 0.5
    assert analysis.ShortTimeSpectrum(wave(click)).power.sum(axis=1).argmax() == 100
    pulses = np.zeros(2 * RATE)
    pulses[::160] = 0.1  # one a frame: all bands, and all frames alike
    pulses[RATE:] *= 10
    onset = columns(Prosody().extract(wave(pulses)), "onset")
    assert onset.max() == pytest.approx(20, abs=1.5) and abs(onset.argmax() - 100) <= 2
    assert onset[10:95].max() < 0.1 and onset[105:190].max() < 0.1
