"""The presets against DiffuseStyleGesture's pipelines, written down here as published."""

from __future__ import annotations

import numpy as np
import pytest

import audio_features as af

torch = pytest.importorskip("torch")
functional = torch.nn.functional


@pytest.fixture(scope="module")
def large(tmp_path_factory, write_wavlm):
    folder = tmp_path_factory.mktemp("large")
    return folder, write_wavlm(folder, norm="layer")


def noise(seconds: float) -> np.ndarray:
    n = round(seconds * 16_000)
    return np.random.default_rng(0).normal(0.01, 0.1, n).astype(np.float32)


def stretched(features, size: int):
    """(1, T, D) to (size, D)."""
    return functional.interpolate(
        features.transpose(1, 2), size=size, align_corners=True, mode="linear"
    )[0].T.numpy()


def test_dsg_extracts_clips_with_the_eight_frames_before_them(large):
    folder, model = large
    samples = noise(9.3)
    stride, seed = 64_000, 6_400  # 80 and 8 motion frames of 800 samples
    clips = [samples[at : at + stride] for at in (0, stride)]
    before = [np.zeros(seed, np.float32), clips[0][-seed:]]
    expected = []
    with torch.no_grad():
        for earlier, clip in zip(before, clips):
            heard = torch.from_numpy(np.concatenate([earlier, clip]))[None]  # not normalised
            expected.append(stretched(model(heard).last_hidden_state, 88)[8:])
    track = af.WavLM(folder, preset="dsg").extract(af.Wave(samples, 16_000))
    assert track.values.shape == (186, 32)  # they drop the 26 frames after the last whole clip
    np.testing.assert_allclose(track.values[:160], np.concatenate(expected), atol=1e-4)
    np.testing.assert_allclose(track.times, np.arange(186) / 20)
    assert len(af.WavLM(folder, preset="dsg").extract(af.Wave(samples[:400], 16_000)).times) == 1


@pytest.mark.parametrize("seconds", [5.0, 12.1])
def test_dsg_plus_squeezes_its_padding_into_the_sound(large, seconds):
    folder, model = large
    samples = noise(seconds)
    sound = torch.from_numpy(samples)
    sound = functional.layer_norm(sound, sound.shape)
    pieces = len(sound) // 80_000 + 1
    sound = functional.pad(sound, (0, pieces * 80_000 - len(sound))).reshape(pieces, 80_000)
    with torch.no_grad():
        features = model(sound).last_hidden_state
    size = round(seconds * 30)
    expected = stretched(features.reshape(1, -1, 32), size)
    # The folder is Hugging Face's, whose own eps is 1e-7; theirs is 1e-5 whatever the file says.
    track = af.WavLM(folder, preset="dsg+").extract(af.Wave(samples, 16_000))
    np.testing.assert_allclose(track.values, expected, atol=1e-4)
    np.testing.assert_allclose(track.times, np.arange(size) / 30)
