"""Acoustic features of sound that arrives block by block."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import resample_poly
from sounds import voiced

import audio_features as af
from audio_features.acoustic.analysis import ShortTimeSpectrum
from audio_features.acoustic.streaming import SpectrumStream, check_streams


def streamed(samples: np.ndarray, rate: int = 16_000, block: int = 1000, seconds: float = 20.0):
    """The spectrum and the speech activity of a whole stream."""
    stream = SpectrumStream(rate, seconds)
    for first in range(0, len(samples), block):
        for _ in stream.push(
            samples[first : first + block], lambda: 3 * (stream.n_frames // 3) + 3
        ):
            assert stream.n_frames % 3 < 2, "computed as soon as they are wanted"
    return stream, *stream.window(seconds)


@pytest.mark.parametrize("rate", [8000, 16_000, 22_050, 44_100, 48_000])
def test_a_stream_computes_what_offline_extraction_does(rate):
    """At the end, level and pitch are those of the whole clip; a constant part has no influence."""
    sound = voiced(4.0, rate).astype(np.float32)
    _, spectrum, active = streamed(0.1 * sound + 0.05, rate)
    whole = ShortTimeSpectrum(af.Wave.from_array(sound, rate))
    mels, found = whole.log_mel(24), spectrum.log_mel(24)
    middle = slice(150, len(found) - 10)
    loud = mels[middle] > -20
    difference = (found - mels[: len(found)])[middle][loud]
    # The level is that of voiced frames, without the quieter ones between them.
    assert abs(difference.mean()) < 2.0 and difference.std() < 1.0
    both = (spectrum.melody().voiced & whole.melody().voiced[: len(found)])[middle]
    assert both.mean() > 0.35, "every other fifth of a second has a voice"
    for name in ("f0", "energy"):
        own, other = getattr(spectrum.melody(), name), getattr(whole.melody(), name)
        own, other = own[middle][both], other[: len(found)][middle][both]
        assert np.median(np.abs(own - other)) < 0.02 * np.abs(other).mean() + 2.0 * (name != "f0")
    assert 0.4 < active[middle].mean() < 0.8
    np.testing.assert_allclose(spectrum.times, np.arange(len(found)) / 100, atol=1e-9)


@pytest.mark.parametrize("rate", [16_000, 44_100])
def test_the_size_of_blocks_changes_no_bit(rate):
    sound = voiced(1.5, rate).astype(np.float32)
    first, spectrum, _ = streamed(sound, rate, block=len(sound))
    for block in (17, 160, 4096):
        stream, other, _ = streamed(sound, rate, block)
        assert stream.n_frames == first.n_frames
        np.testing.assert_array_equal(other.power, spectrum.power)
        np.testing.assert_array_equal(other.melody().semitones, spectrum.melody().semitones)


def test_a_frame_waits_for_no_more_sound_than_promised():
    """Frame k is there after its 32 ms of sound and the delay; sound behind it changes nothing."""
    for rate in (16_000, 44_100):
        stream = SpectrumStream(rate, 2.0)
        sound = voiced(1.0, rate).astype(np.float32)
        promised = int((0.5 + 0.032 + stream.delay) * rate) + 1
        list(stream.push(sound[:promised], lambda: 51))
        assert stream.n_frames > 50, "frame 50 is at half a second"
        assert stream.delay < 0.03


def test_level_and_loudness_of_the_microphone_do_not_matter():
    sound = voiced(3.0).astype(np.float32)
    _, loud, _ = streamed(sound)
    _, quiet, _ = streamed(0.1 * sound)
    np.testing.assert_allclose(loud.log_mel(24), quiet.log_mel(24), atol=0.05)


def test_sound_without_voice_is_silent_and_a_voice_is_not():
    noise = np.random.default_rng(0).normal(0, 0.05, 5 * 16_000).astype(np.float32)
    silent = streamed(np.zeros(5 * 16_000, np.float32))[1].log_mel(8)
    assert streamed(noise)[1].log_mel(8).max() == silent.max() == pytest.approx(-60.0)
    voice = 0.3 * voiced(3.0).astype(np.float32)
    found = streamed(np.concatenate([voice, 0.1 * noise]))[1].log_mel(8).max(axis=1)
    assert np.median(found[50:250]) > -10
    assert found[300:480].max() > -50, "a pause of 2 s is a part of speech"
    assert found[530:].max() == pytest.approx(-60.0), "later, noise is no speech"


def test_memory_is_bounded():
    stream = SpectrumStream(16_000, 1.0)
    sizes = []
    for _ in range(6):
        list(stream.push(voiced(3.0).astype(np.float32), lambda: stream.n_frames + 1))
        sizes.append(sum(np.asarray(value).nbytes for value in stream.state().values()))
    last = stream.window(60.0)[0]
    assert last.n_frames == 100, "a second"
    assert last.times[0] == pytest.approx(stream.n_frames / 100 - 1)
    assert max(sizes) < 200_000, "a second of frames, and the voiced ones of 15 s"


def test_unusual_rates_are_refused():
    with pytest.raises(af.FeatureError, match="sample_rate=15999: .*16000"):
        SpectrumStream(15_999, 1.0)


@pytest.mark.parametrize(
    "extractor, wrong",
    [
        (af.Stack([af.LogMel(), af.Prosody(), af.ProsodicRange(), af.Effort(), af.MFCC()]), None),
        (af.Onset(), None),
        (af.Stack([af.LogMel(), af.Music()]), "music"),
        (af.Prosody(f0="pyin"), "prosody"),
    ],
)
def test_features_that_need_the_whole_sound_are_named(extractor, wrong):
    if wrong is None:
        return check_streams(extractor)
    with pytest.raises(af.FeatureError, match=f"{wrong}: .*whole sound"):
        check_streams(extractor)
    return None


# Worked out by hand, on five harmonics of a pitch.


def harmonic(hertz: float, seconds: float, level_db: float = 0.0, rate: int = 16_000) -> np.ndarray:
    """A sound with a mean square of 0.01 at 0 dB."""
    time = np.arange(round(seconds * rate)) / rate
    tone = sum(np.sin(2 * np.pi * k * hertz * time) / k for k in range(1, 6))
    return (0.1 * 10 ** (level_db / 20) * tone / tone.std()).astype(np.float32)


@pytest.mark.parametrize(
    ("rate", "delay"),
    [
        (16_000, 0.01),
        (8_000, 0.01 + 11 / 8_000),
        (11_030, 0.1 + 11 / 11_030),
        (44_100, 0.01 + 29 / 44_100),
        (48_000, 0.01 + 31 / 48_000),
    ],
)
def test_the_delay_is_a_step_and_the_filter_of_the_resampling(rate, delay):
    """scipy's filter reaches 10 samples of the lower rate: 27.6 of 44.1 kHz, 30 of 48 kHz.

    11.03 kHz and 16 kHz meet every 0.1 s, the longest step.
    """
    assert SpectrumStream(rate, 1.0).delay == pytest.approx(delay)


@pytest.mark.parametrize("rate", [8_000, 44_100, 48_000])
def test_sound_is_resampled_without_borders_between_blocks(rate):
    sound = voiced(1.5, rate).astype(np.float32)
    sound -= sound.mean()
    common = np.gcd(rate, 16_000)
    whole = resample_poly(sound, 16_000 // common, rate // common).astype(np.float32)
    _, found, _ = streamed(sound, rate, 441)
    _, expected, _ = streamed(whole, 16_000)
    n = min(len(found.power), len(expected.power))
    assert n > 140
    loud = expected.log_mel(24)[:n] > -40
    apart = np.abs(found.log_mel(24)[:n] - expected.log_mel(24)[:n])[loud]
    assert apart.max() < 0.2
    np.testing.assert_allclose(found.melody().f0[20:n], expected.melody().f0[20:n], rtol=2e-3)


@pytest.mark.parametrize(("quieter", "louder"), [(-30.0, 0.0), (-15.0, -10 * np.log10(0.5158))])
def test_frames_twenty_db_below_the_mean_are_not_part_of_the_level(quieter, louder):
    """Half of the voice is 15 dB quieter: the mean is (1 + 0.0316) / 2 of the louder half."""
    sound = np.concatenate([harmonic(160, 1.0), harmonic(160, 1.0, quieter)])
    _, spectrum, active = streamed(sound)
    energy = spectrum.melody().energy
    np.testing.assert_allclose(energy[20:90], louder, atol=0.1)
    np.testing.assert_allclose(energy[120:180], louder + quieter, atol=0.1)
    total = 10 * np.log10((10 ** (spectrum.log_mel(40) / 10)).sum(axis=1))
    assert total[20:90].mean() == pytest.approx(energy[20:90].mean(), abs=1.0)
    assert active[20:90].all() and active[120:180].all() == (quieter > -20)
    assert active[120:180].any() == (quieter > -20)


def test_pitch_is_relative_to_the_median_of_the_voice_so_far():
    """Two of three seconds are at 200 Hz, an octave above the first."""
    sound = np.concatenate([harmonic(100, 1.0), harmonic(200, 2.0)])
    _, spectrum, _ = streamed(sound)
    melody = spectrum.melody()
    np.testing.assert_allclose(melody.semitones[20:90], -12, atol=0.1)
    np.testing.assert_allclose(melody.semitones[120:280], 0, atol=0.1)
    np.testing.assert_allclose(melody.f0[20:90], 100, rtol=0.01)
    assert (melody.voicing[20:90] > 0.95).all()


def test_the_level_is_that_of_the_last_quarter_of_a_minute_of_voice():
    """After 8 s at 10 dB less, 7 of 15 s are as before: (7 + 8 · 0.1) / 15 of that."""
    sound = np.concatenate([harmonic(160, 12.0), harmonic(160, 8.0, -10)])
    _, spectrum, _ = streamed(sound, seconds=2.0)
    expected = -10 - 10 * np.log10((7 + 8 * 0.1) / 15)
    np.testing.assert_allclose(spectrum.melody().energy[:190], expected, atol=0.1)
    assert spectrum.n_frames == 200
    assert 19.9 < spectrum.times[-1] == pytest.approx(spectrum.times[0] + 1.99)


@pytest.mark.parametrize(("amplitude", "is_voice"), [(0.0012, False), (0.0018, True)])
def test_a_voice_is_above_60_db_below_full_scale(amplitude, is_voice):
    """A sine's mean square is half of its amplitude's square; 10^-6 is that of 0.0014."""
    time = np.arange(16_000) / 16_000
    _, spectrum, _ = streamed((amplitude * np.sin(2 * np.pi * 150 * time)).astype(np.float32))
    assert (spectrum.log_mel(8).max() > -50) == is_voice


def test_two_seconds_after_the_last_voiced_frame_sound_is_silence():
    noise = np.random.default_rng(0).normal(0, 0.03, 3 * 16_000).astype(np.float32)
    sound = np.concatenate([harmonic(160, 1.0), noise, harmonic(160, 0.5)])
    for block in (700, len(sound)):
        _, spectrum, _ = streamed(sound, block=block)
        melody = spectrum.melody()
        last = np.flatnonzero(melody.voiced[:350])[-1]
        assert 98 <= last <= 103
        assert (melody.energy[last + 1 : last + 201] > -30).all()
        quiet = slice(last + 201, 390)
        np.testing.assert_allclose(melody.energy[quiet], -60.0, atol=1e-6)
        assert (spectrum.power[quiet] == 0).all() and (spectrum.power[last + 200] > 0).any()
        assert (melody.energy[410:440] > -3).all(), "a voice again"


def test_a_constant_offset_has_no_power():
    sound = harmonic(160, 1.5)
    _, plain, _ = streamed(sound)
    _, offset, _ = streamed(sound + np.float32(0.3))
    assert 10 * np.log10(offset.power[60:, 0].mean()) < -20, "of 0 Hz"
    np.testing.assert_allclose(offset.log_mel(8)[4:, 2:], plain.log_mel(8)[4:, 2:], atol=0.5)


def test_torch_and_other_trackers_do_not_stream():
    class OnADevice(af.LogMel):
        device = property(lambda self: "cpu", lambda self, value: None)

    for extractor in (OnADevice(), af.Stack([af.Onset(), OnADevice()])):
        with pytest.raises(af.FeatureError, match="logmel: .*backend numpy"):
            check_streams(extractor)
