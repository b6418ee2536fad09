"""Acoustic features: bands, pitch, energy, onsets, prosodic_range, and vocal effort."""

from __future__ import annotations

import sys
from types import SimpleNamespace

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


def columns(track, name: str) -> np.ndarray:
    return track.values[:, track.names.index(name)]


def test_shapes_times_and_names(speech):
    for extractor, dim in ((LogMel(), 24), (MFCC(), 20), (Prosody(), 4), (EVERYTHING, 48)):
        track = extractor.extract(speech)
        assert track.values.shape == (400, dim)
        assert extractor.dim == dim and track.names == extractor.names
        assert track.spec == extractor.spec
        np.testing.assert_allclose(track.times, np.arange(400) / 100)


def test_a_stack_gives_what_its_parts_give_from_one_spectrum(speech, monkeypatch):
    alone = [part.extract(speech).values for part in EVERYTHING.parts]
    made = []
    build = analysis.ShortTimeSpectrum.power.func

    def counted(self):
        made.append(self)
        return build(self)

    monkeypatch.setattr(analysis.ShortTimeSpectrum.power, "func", counted)
    np.testing.assert_array_equal(EVERYTHING.extract(speech).values, np.concatenate(alone, 1))
    assert len(made) == 1


class HalfBand(LogMel):
    """Mel bands on another device, where the spectrum is another one."""

    device = property(lambda self: "other", lambda self, value: None)

    def spectrum_of(self, wave):
        return analysis.ShortTimeSpectrum(wave.resample(8_000))


def test_parts_of_two_devices_in_a_stack_are_as_they_are_alone(speech):
    parts = [HalfBand(), MFCC(), Prosody()]
    for order in (parts, parts[::-1]):
        alone = np.concatenate([part.extract(speech).values for part in order], axis=1)
        np.testing.assert_array_equal(Stack(order).extract(speech).values, alone)


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


@pytest.mark.parametrize("rate", [8_000, 44_100, 48_000])
def test_the_rate_of_the_file_hardly_matters(speech, rate):
    there = speech.resample(rate)
    ours, theirs = LogMel().extract(speech), LogMel().extract(there)
    below_3_khz = slice(0, 14)
    difference = ours.values[5:-5, below_3_khz] - theirs.values[5:-5, below_3_khz]
    assert np.abs(difference).mean() < 0.5


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


def test_band_powers_add_up_to_the_level():
    samples = np.random.default_rng(0).standard_normal(64_000).astype(np.float32)
    bands = LogMel().extract(Wave(0.05 * samples, 16_000)).values[10:-10]
    total = 10 * np.log10(np.sum(10 ** (bands / 10), axis=1).mean())
    assert total == pytest.approx(0.0, abs=0.5)  # white noise is active throughout: 0 dB


def test_long_sound_does_not_depend_on_blocks(speech, monkeypatch):
    whole = EVERYTHING.extract(speech).values
    monkeypatch.setattr("audio_features.acoustic.analysis._BLOCK_FRAMES", 77)
    np.testing.assert_allclose(EVERYTHING.extract(speech).values, whole, atol=2e-3)


def test_settings_out_of_range_are_refused():
    assert (LogMel(80).n_mels, LogMel(1).n_mels, MFCC(40).n, MFCC(1).n) == (80, 1, 40, 1)
    for make in (lambda: LogMel(0), lambda: LogMel(81), lambda: MFCC(41), lambda: MFCC(2.5)):
        with pytest.raises(FeatureError, match="whole number"):
            make()


def test_prosodic_range_is_the_range_of_pitch_and_energy():
    rate = 16000
    time = np.arange(5 * rate) / rate

    def say(semitones: float, swell_db: float) -> Wave:
        pitch = 130 * 2 ** (semitones / 12 * np.sin(2 * np.pi * 0.7 * time))
        phase = 2 * np.pi * np.cumsum(pitch) / rate
        tone = sum(np.sin(k * phase) / k for k in range(1, 20))
        gain = 10 ** (swell_db / 20 * np.sin(2 * np.pi * 1.1 * time))
        return Wave((0.05 * tone * gain).astype(np.float32), rate, None)

    extractor = ProsodicRange()
    waves = (say(*how) for how in ((0.2, 0.5), (5.0, 0.5), (0.2, 6.0)))
    flat, high, loud = (extractor.extract(w).values[100:-100].mean(axis=0) for w in waves)
    assert high[0] > 5 * flat[0] and loud[0] < 2 * flat[0] + 0.2
    assert loud[1] > 3 * flat[1]
    silence = extractor.extract(Wave(np.zeros(rate, np.float32), rate, None)).values
    assert np.abs(silence).max() == 0.0
    with pytest.raises(FeatureError, match="seconds=0"):
        ProsodicRange(seconds=0)


@pytest.mark.parametrize("other", [300.0, 60.5])
def test_pitch_beyond_seven_semitones_counts_as_seven_for_prosodic_range(other):
    """Trackers make errors of an octave and more: here in .4 of the time, evenly spread."""
    time = np.arange(10 * 16_000) / 16_000
    pitch = np.where(time % 1.0 < 0.6, 121.0, other)
    phase = 2 * np.pi * np.cumsum(pitch) / 16_000
    tone = sum(np.sin(k * phase) / k for k in range(1, 20))
    values = ProsodicRange().extract(Wave((0.05 * tone).astype(np.float32), 16_000)).values
    # The mean is .4 · 7 = 2.8, and the mean distance from it .6 · 2.8 + .4 · 4.2 = 3.36.
    assert values[300:700, 0].mean() == pytest.approx(3.36, rel=0.05)


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
    with pytest.raises(FeatureError, match="'crepe': one of yin, pyin"):
        Prosody("crepe")
    with pytest.raises(FeatureError, match="backend='librosa': one of numpy, torchaudio"):
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


# Vocal effort: pitch in semitones and spectral tilt, whatever the level of the recording.

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
    def tilt(samples: np.ndarray) -> float:
        return float(np.median(effort(samples)[:, 2]))

    low, high = (np.sin(2 * np.pi * hertz * np.arange(3 * RATE) / RATE) for hertz in (500, 2500))
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
def test_effort_of_silence_is_finite(seconds, level):
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
def test_a_bad_window_of_effort_is_one_error(seconds):
    with pytest.raises(FeatureError, match="seconds=.*: a number from 0.5 to 120"):
        Effort(seconds=seconds)


# Against the formulas.


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
        with pytest.raises(FeatureError, match="a number from 0.05 to 60"):
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


def test_1_khz_belongs_to_the_upper_band_and_5_khz_to_none():
    """The expected power is that of a Hann window of 400 samples, in bins of 31.25 Hz."""
    time = np.arange(RATE) / RATE
    window = np.hanning(401)[:-1]

    def share(hertz: float, *bins: slice) -> list[float]:
        power = np.abs(np.fft.rfft(np.sin(2 * np.pi * hertz * time[:400]) * window, 512)) ** 2
        return [power[own].sum() for own in bins]

    low, high = share(1000, slice(3, 32), slice(32, 160))
    values = effort(0.1 * np.sin(2 * np.pi * 1000 * time))
    assert values[50, 2] == pytest.approx(10 * np.log10(high / low), abs=0.3)
    (upper,), (lower,) = share(5000, slice(32, 160)), share(500, slice(3, 32))
    both = np.sin(2 * np.pi * 5000 * time) + np.sin(2 * np.pi * 500 * time)
    assert effort(0.1 * both)[50, 2] == pytest.approx(10 * np.log10(upper / lower), abs=0.3)


def test_quiet_and_aperiodic_frames_have_no_pitch():
    """Frames from 30 dB below active speech on are audible, voiced from a periodicity of 0.6 on."""
    f0 = np.array([100.0, 200.0, 400.0, 300.0, 50.0])
    voicing = np.array([0.9, 0.6, 0.7, 0.59, 0.9])
    energy = np.array([-30.0, 0.0, 3.0, 0.0, -30.1])
    melody = analysis.audible_melody(f0, voicing, energy)
    assert melody.voiced.tolist() == [True, True, True, False, False]
    assert melody.voicing.tolist() == [0.9, 0.6, 0.7, 0.59, 0.0]
    np.testing.assert_allclose(melody.semitones, [-12, 0, 12, 0, 0])
    other = analysis.audible_melody(f0, voicing, energy, 100.0)
    np.testing.assert_allclose(other.semitones, [0, 12, 24, 0, 0])
    assert not analysis.audible_melody(f0, 0 * voicing, energy).semitones.any()


@pytest.mark.parametrize("marked", [False, True])
def test_periodicity_is_the_correlation_with_the_frame_one_period_later(
    speech, monkeypatch, marked
):
    """A sum has 756 samples: a frame of 64 ms less the longest period, of 60 Hz, and one."""
    hertz = np.linspace(60, 500, 100)
    hertz[marked * np.arange(100) % 2 == 1] = 0.0
    monkeypatch.setitem(analysis.TRACKERS, "mine", lambda samples, n_frames: hertz)
    sound = speech.samples[: RATE // 100 * 100]
    f0, found = track_pitch(sound, 100, "mine")
    padded = np.pad(sound, (512, 1024)).astype(float)
    for k in range(0, 100, 7):
        if hertz[k] == 0:
            assert f0[k] > 0 and found[k] == 0
            continue
        frame = padded[160 * k :]
        now, later = (frame[at : at + 756] for at in (0, round(16_000 / hertz[k])))
        size = np.sqrt((now @ now) * (later @ later))
        expected = max(0.0, now @ later / size) if size > 1e-6 else 0.0
        assert found[k] == pytest.approx(expected, abs=1e-4)
        assert f0[k] == hertz[k]


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


def test_praats_frames_are_found_by_their_times(monkeypatch):
    """Its first frame is at `x1` seconds, the others follow by `dx`."""
    asked = {}

    class Sound:
        def __init__(self, values, sampling_frequency):
            self.duration = len(values) / sampling_frequency

        def to_pitch_ac(self, time_step, pitch_floor, pitch_ceiling):
            asked.update(step=time_step, floor=pitch_floor, ceiling=pitch_ceiling)
            found = {"frequency": np.array([101.0, 102.0, 0.0, 104.0])}
            return SimpleNamespace(x1=0.024, dx=0.01, selected_array=found)

    monkeypatch.setitem(sys.modules, "parselmouth", SimpleNamespace(Sound=Sound))
    f0, voicing = track_pitch(np.ones(1600, np.float32), 10, "parselmouth")
    assert asked == {"step": 0.01, "floor": 60.0, "ceiling": 500.0}
    assert f0.tolist() == [60, 60, 101, 102, 60, 104, 60, 60, 60, 60]
    assert (voicing > 0).tolist() == [k in (2, 3, 5) for k in range(10)]
    # Praat wants three periods of 60 Hz, 0.05 s.
    asked.clear()
    assert (track_pitch(np.ones(799, np.float32), 5, "parselmouth")[1] == 0).all() and not asked
    track_pitch(np.ones(800, np.float32), 5, "parselmouth")
    assert asked


def test_worlds_frames_are_those_asked_for(monkeypatch):
    def dio(signal, rate, f0_floor, f0_ceil, frame_period):
        assert (signal.dtype, rate) == (np.float64, 16_000)
        assert (f0_floor, f0_ceil, frame_period) == (60.0, 500.0, 10.0)
        n = 1 + len(signal) // 160
        return 100.0 + np.arange(n), 0.01 * np.arange(n)

    def stonemask(signal, f0, times, rate):
        assert rate == 16_000 and len(times) == len(f0)
        return f0 + 0.5

    both = SimpleNamespace(dio=dio, stonemask=stonemask)
    monkeypatch.setitem(sys.modules, "pyworld", both)
    tone = np.sin(np.arange(1600)).astype(np.float32)
    for n_frames in (10, 11, 13):
        f0, voicing = track_pitch(tone, n_frames, "pyworld")
        known = min(n_frames, 11)
        np.testing.assert_allclose(f0[:known], 100.5 + np.arange(known))
        assert (f0[known:] == 60).all() and not voicing[known:].any()


def test_a_long_sound_is_searched_in_minutes_that_overlap_by_four_seconds(monkeypatch):
    """Two seconds before and after each minute have a part in its best path."""
    parts = []

    def pyin(y, fmin, fmax, sr, frame_length, hop_length, fill_na):
        assert (fmin, fmax, sr) == (60.0, 500.0, 16_000)
        assert (frame_length, hop_length, fill_na) == (1024, 160, 0.0)
        parts.append((y[0], len(y) // 160))
        return (y[::160] + 100.0, None, None)

    librosa = SimpleNamespace(pyin=pyin)
    monkeypatch.setattr(analysis, "import_librosa", lambda: librosa)
    n = 13_000
    ramp = np.repeat(np.arange(n) / 100, 160)
    f0, _ = track_pitch(ramp, n, "pyin")
    np.testing.assert_allclose(f0, 100 + np.arange(n) / 100)
    assert parts == [(0.0, 6200), (58.0, 6400), (118.0, 1200)]
    f0, _ = track_pitch(ramp[: 160 * 50], 50, "pyin")
    np.testing.assert_allclose(f0, 100 + np.arange(50) / 100)
