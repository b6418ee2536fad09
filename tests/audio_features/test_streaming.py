"""Acoustic features of sound that arrives block by block."""

from __future__ import annotations

import numpy as np
import pytest
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
    assert spectrum.times[0] == 0.0 and np.ptp(np.diff(spectrum.times)) < 1e-9


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
    assert stream.window(60.0)[0].n_frames == 100, "a second"
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
