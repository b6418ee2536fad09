"""Acoustic features: bands, pitch, energy, onsets, prosodic_range, and vocal effort."""

import sys

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
from audio_features.acoustic import analysis
from audio_features.acoustic.analysis import FLOOR_DB, track_pitch
from audio_features.librosa_import import import_librosa

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
    np.testing.assert_allclose(track.values[:, :24], FLOOR_DB, atol=1e-3)
    assert (columns(track, "f0") == 0).all() and (columns(track, "voicing") == 0).all()
    np.testing.assert_allclose(columns(track, "energy"), FLOOR_DB, atol=1e-3)
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
    for make in (lambda: LogMel(0), lambda: LogMel(81), lambda: MFCC(41), lambda: MFCC(2.5)):
        with pytest.raises(FeatureError, match="whole number"):
            make()


@pytest.mark.parametrize(
    "tracker",
    # librosa compiles pyin for seconds.
    [pytest.param("pyin", marks=pytest.mark.stress), "parselmouth", "pyworld"],
)
def test_other_pitch_trackers_find_the_same_melody(speech, tracker):
    if tracker != "pyin":
        pytest.importorskip(tracker)
    extractor = Prosody(tracker)
    assert extractor.spec == {"kind": "prosody", "f0": tracker}
    ours, theirs = Prosody().extract(speech), extractor.extract(speech)
    assert theirs.names == ours.names and theirs.values.shape == ours.values.shape
    both = (columns(ours, "voicing") > 0.8) & (columns(theirs, "voicing") > 0.8)
    assert both.mean() > 0.25
    assert np.median(np.abs(columns(ours, "f0") - columns(theirs, "f0"))[both]) < 0.5
    for seconds in (0.025, 0.1):
        short = Wave(speech.samples[: round(16_000 * seconds)], 16_000)
        assert len(extractor.extract(short).values) == short.n_frames(100)


def test_a_tracker_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "parselmouth", None)
    with pytest.raises(FeatureError, match="pip install praat-parselmouth.*f0='yin'"):
        Prosody("parselmouth")
    with pytest.raises(FeatureError, match="'crepe': .* yin, pyin"):
        Prosody("crepe")
    with pytest.raises(FeatureError, match="'librosa': .* numpy, torchaudio"):
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
        np.testing.assert_array_equal(analysis.mel_filters(n_mels), theirs)
    noise = 0.1 * np.random.default_rng(0).standard_normal(16_000).astype(np.float32)
    for wave in (speech, Wave(noise, 16_000)):
        prepared = analysis.ShortTimeSpectrum(wave)
        f0, _ = track_pitch(prepared.wave.samples, prepared.n_frames)
        padded = np.pad(prepared.wave.samples, (512, 1024))
        frames = {"sr": 16_000, "frame_length": 1024, "hop_length": 160, "center": False}
        theirs = librosa.yin(padded, fmin=60.0, fmax=500.0, **frames)
        np.testing.assert_allclose(f0, theirs[: len(f0)], rtol=1e-6)
        around = {"pre_max": 3, "post_max": 1, "pre_avg": 10, "post_avg": 11}
        picked = librosa.util.peak_pick(prepared.onset, **around, delta=1.0, wait=3)
        assert len(picked) > 3
        bands = LogMel(40).extract(wave).values.T
        theirs = librosa.feature.mfcc(S=bands, n_mfcc=20)
        np.testing.assert_allclose(MFCC(20).extract(wave).values.T, theirs, atol=1e-3)
        np.testing.assert_array_equal(np.flatnonzero(Onset().extract(wave).values[:, 1]), picked)


RATE = 16_000
COLUMNS = ("effort_f0_median", "effort_f0_high", "effort_tilt")


def effort(samples: np.ndarray, **options) -> np.ndarray:
    track = Effort(**options).extract(Wave(samples.astype(np.float32), RATE))
    assert track.names == COLUMNS
    assert Effort.centred == (False,) * 3  # calm clips have low values throughout
    return track.values


def gaussian_mean(values: np.ndarray, sigma: float) -> np.ndarray:
    """Sums with Gaussian weights, of 4 deviations, that add up to 1 within a long clip."""
    reach = round(4 * sigma)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.convolve(values, weights / weights.sum())[reach : reach + len(values)]


@pytest.mark.parametrize("seconds", [0.5, 1.0])
def test_prosodic_range_is_the_mean_distance_from_the_local_mean(speech, seconds):
    melody = analysis.ShortTimeSpectrum(speech).melody()
    voiced, sigma = melody.voiced.astype(float), seconds * 100
    weight = gaussian_mean(voiced, sigma) + 0.02
    found = ProsodicRange(seconds).extract(speech)
    for column, values in enumerate((melody.semitones.clip(-7, 7), melody.energy)):
        mean = gaussian_mean(voiced * values, sigma) / weight
        expected = gaussian_mean(voiced * np.abs(values - mean), sigma) / weight
        np.testing.assert_allclose(found.values[:, column], expected, rtol=1e-4, atol=1e-5)
    assert ProsodicRange(0.05).spec == {"kind": "prosodic_range", "seconds": 0.05}
    assert ProsodicRange(60).seconds == 60.0
    for wrong in (0.049, 60.1, "1", None):
        with pytest.raises(FeatureError, match="0.05 to 60"):
            ProsodicRange(wrong)


@pytest.mark.parametrize("seconds", [1.5, 8.0])
def test_effort_is_a_quantile_with_half_a_second_of_the_clips_own(speech, seconds):
    """Windows are half a second apart; between them values are interpolated."""
    spectrum = analysis.ShortTimeSpectrum(speech)
    melody, power = spectrum.melody(), spectrum.power.astype(float)
    hertz = np.arange(257) * 31.25
    low, high = (
        power[:, (hertz >= a) & (hertz < b)].sum(axis=1) for a, b in ((80, 1000), (1000, 5000))
    )
    tilt = 10 * np.log10((high + 1e-6) / (low + 1e-6))
    pitch = 12 * np.log2(melody.f0 / 60)
    found = Effort(seconds).extract(speech).values
    curves = [(pitch, melody.voiced, share) for share in (0.5, 0.9)]
    curves.append((tilt, melody.energy >= -30, 0.9))
    half = round(seconds * 50)
    for column, (values, valid, share) in enumerate(curves):
        own, expected = np.quantile(values[valid], share), []
        for centre in range(0, 401, 50):
            window = slice(max(0, centre - half), centre + half)
            inside = values[window][valid[window]]
            near = np.quantile(inside, share) if len(inside) else own
            expected.append((len(inside) * near + 50 * own) / (len(inside) + 50))
        np.testing.assert_allclose(found[::50, column], expected[:8], rtol=1e-4, atol=1e-3)
        middle = (np.array(expected[:-1]) + expected[1:]) / 2
        np.testing.assert_allclose(found[25::50, column], middle, rtol=1e-4, atol=1e-3)


def test_periodicity_is_the_correlation_with_the_frame_one_period_later(speech):
    """A sum has 756 samples: a frame of 64 ms less the longest period, of 60 Hz, and one."""
    sound = speech.samples[:RATE]
    f0, found = track_pitch(sound, 100)
    padded = np.pad(sound, (512, 1024)).astype(float)
    for k in range(0, 100, 7):
        frame = padded[160 * k :]
        now, later = (frame[at : at + 756] for at in (0, round(16_000 / f0[k])))
        size = np.sqrt((now @ now) * (later @ later))
        expected = max(0.0, now @ later / size) if size > 1e-6 else 0.0
        assert found[k] == pytest.approx(expected, abs=1e-4)


def test_energy_and_bands_are_relative_to_active_speech(speech):
    """50 ms of its mean square, and 25 ms in bands; to both, 10^-6 is added."""
    spectrum = analysis.ShortTimeSpectrum(speech)
    active = 10 ** (-23 / 10)
    sound = np.pad(spectrum.wave.samples, 512).astype(float)
    energy = spectrum.melody().energy
    for k in (20, 133, 250, 371):
        middle = 512 + 160 * k
        loud = np.square(sound[middle - 400 : middle + 400]).mean() / active
        assert energy[k] == pytest.approx(10 * np.log10(loud + 1e-6), abs=0.05)
        window = np.hanning(401)[:-1]
        power = np.abs(np.fft.rfft(sound[middle - 200 : middle + 200] * window, 512)) ** 2
        power *= 2 / (np.square(window).sum() * 512 * active)
        np.testing.assert_allclose(spectrum.power[k], power, rtol=1e-3, atol=1e-7)
        bands = 10 * np.log10(analysis.mel_filters(24) @ power + 1e-6)
        np.testing.assert_allclose(spectrum.log_mel(24)[k], bands, atol=0.01)
    rise = np.maximum(spectrum.log_mel(40)[2:] - spectrum.log_mel(40)[:-2], 0).mean(axis=1)
    np.testing.assert_allclose(spectrum.onset, [0, 0, *rise], atol=1e-5)


# Packages of other trackers, by what their documentation says.
