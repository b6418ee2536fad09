"""torchaudio is optional: equal where it imports, and no harm where it is broken."""

import numpy as np
import pytest

import audio_features as af


@pytest.fixture
def torchaudio():
    try:
        return pytest.importorskip("torchaudio")
    except OSError:  # one that is built for another torch
        return pytest.skip("torchaudio cannot be imported")


def sound(seconds: float, rate: int) -> af.Wave:
    times = np.arange(round(seconds * rate)) / rate
    voice = sum(np.sin(2 * np.pi * 130 * k * times) / k for k in range(1, 25))
    noise = np.random.default_rng(0).standard_normal(len(times))
    samples = 0.05 * voice * np.clip(np.sin(20 * times), 0, 1) + 1e-3 * noise
    return af.Wave(samples.astype(np.float32), rate)


@pytest.mark.parametrize("seconds", [0.03, 3.017, 61.0])
@pytest.mark.parametrize("kind", [af.LogMel, af.MFCC])
def test_parity_with_the_default_backend(torchaudio, kind, seconds):
    wave = sound(seconds, 16_000)
    ours, theirs = kind(20).extract(wave), kind(20, backend="torchaudio").extract(wave)
    assert theirs.names == ours.names and theirs.spec["backend"] == "torchaudio"
    np.testing.assert_array_equal(theirs.times, ours.times)
    np.testing.assert_allclose(theirs.values, ours.values, atol=2e-3)  # dB
