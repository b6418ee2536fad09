"""Acoustic features of sound that arrives block by block."""

import numpy as np
import pytest
from sounds import voiced

import audio_features as af
from audio_features.acoustic import ShortTimeSpectrum
from audio_features.acoustic.streaming import SpectrumStream, check_streams


def streamed(samples: np.ndarray, rate: int = 16_000, block: int = 1000, seconds: float = 20.0):
    """The spectrum and the speech activity of a whole stream."""
    stream = SpectrumStream(rate, seconds)
    for first in range(0, len(samples), block):
        list(stream.push(samples[first : first + block], lambda: stream.n_frames + 3))
    return stream, *stream.window(seconds)


@pytest.mark.parametrize("rate", [8000, 44_100, 48_000])
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
    both = (spectrum.melody.voiced & whole.melody.voiced[: len(found)])[middle]
    assert both.mean() > 0.35, "every other fifth of a second has a voice"
    for name in ("f0", "energy"):
        own, other = getattr(spectrum.melody, name), getattr(whole.melody, name)
        own, other = own[middle][both], other[: len(found)][middle][both]
        assert np.median(np.abs(own - other)) < 0.02 * np.abs(other).mean() + 2.0 * (name != "f0")
    assert 0.4 < active[middle].mean() < 0.8
    np.testing.assert_allclose(spectrum.times, np.arange(len(found)) / 100, atol=1e-9)


def test_a_frame_waits_for_no_more_sound_than_promised():
    """Frame k is there after its 32 ms of sound and the delay; sound behind it changes nothing."""
    for rate in (16_000, 44_100):
        stream = SpectrumStream(rate, 2.0)
        sound = voiced(1.0, rate).astype(np.float32)
        promised = int((0.5 + 0.032 + stream.delay) * rate) + 1
        list(stream.push(sound[:promised], lambda: 51))
        assert stream.n_frames > 50, "frame 50 is at half a second"
        assert stream.delay < 0.03


def test_sound_without_voice_is_silent_and_a_voice_is_not():
    noise = np.random.default_rng(0).normal(0, 0.05, 2 * 16_000).astype(np.float32)
    silent = streamed(np.zeros(2 * 16_000, np.float32))[1].log_mel(8)
    assert streamed(noise)[1].log_mel(8).max() == silent.max() == pytest.approx(-60.0)
    voice = 0.3 * voiced(3.0).astype(np.float32)
    noise = np.tile(noise, 2)
    found = streamed(np.concatenate([voice, 0.1 * noise]))[1].log_mel(8).max(axis=1)
    assert np.median(found[50:250]) > -10
    assert found[300:420].max() > -50, "a pause of 2 s is a part of speech"
    assert found[530:].max() == pytest.approx(-60.0), "later, noise is no speech"


def test_features_that_need_the_whole_sound_are_named():
    with pytest.raises(af.FeatureError, match="15999.*48000"):
        SpectrumStream(15_999, 20.0)
    check_streams(af.Stack([af.LogMel(), af.Prosody(), af.ProsodicRange(), af.Effort(), af.MFCC()]))
    with pytest.raises(af.FeatureError, match="music"):
        check_streams(af.Stack([af.Onset(), af.Music()]))


def harmonic(hertz: float, seconds: float, level_db: float = 0.0, rate: int = 16_000) -> np.ndarray:
    """A sound with a mean square of 0.01 at 0 dB."""
    time = np.arange(round(seconds * rate)) / rate
    tone = sum(np.sin(2 * np.pi * k * hertz * time) / k for k in range(1, 6))
    return (0.1 * 10 ** (level_db / 20) * tone / tone.std()).astype(np.float32)


@pytest.mark.parametrize(("quieter", "louder"), [(-30.0, 0.0), (-15.0, -10 * np.log10(0.5158))])
def test_frames_twenty_db_below_the_mean_are_not_part_of_the_level(quieter, louder):
    """Half of the voice is 15 dB quieter: the mean is (1 + 0.0316) / 2 of the louder half."""
    sound = np.concatenate([harmonic(160, 1.0), harmonic(160, 1.0, quieter)])
    _, spectrum, active = streamed(sound)
    energy = spectrum.melody.energy
    np.testing.assert_allclose(energy[20:90], louder, atol=0.1)
    np.testing.assert_allclose(energy[120:180], louder + quieter, atol=0.1)
    total = 10 * np.log10((10 ** (spectrum.log_mel(40) / 10)).sum(axis=1))
    assert total[20:90].mean() == pytest.approx(energy[20:90].mean(), abs=1.0)
    assert active[20:90].all() and active[120:180].all() == (quieter > -20)
    assert active[120:180].any() == (quieter > -20)


def test_two_seconds_after_the_last_voiced_frame_sound_is_silence():
    noise = np.random.default_rng(0).normal(0, 0.03, 3 * 16_000).astype(np.float32)
    sound = np.concatenate([harmonic(160, 1.0), noise, harmonic(160, 0.5)])
    for block in (700, len(sound)):
        _, spectrum, _ = streamed(sound, block=block)
        melody = spectrum.melody
        last = np.flatnonzero(melody.voiced[:350])[-1]
        assert 98 <= last <= 103
        assert (melody.energy[last + 1 : last + 201] > -30).all()
        quiet = slice(last + 201, 390)
        np.testing.assert_allclose(melody.energy[quiet], -60.0, atol=1e-6)
        assert (spectrum.power[quiet] == 0).all() and (spectrum.power[last + 200] > 0).any()
        assert (melody.energy[410:440] > -3).all(), "a voice again"
