"""Sounds for tests."""

import io

import numpy as np
import soundfile
from scipy.signal import lfilter


def voiced(seconds: float, rate: int = 16_000) -> np.ndarray:
    """Return (N,) of a voice: syllables of a fifth of a second with moving pitch and vowels."""
    time = np.arange(round(seconds * rate)) / rate
    pitch = 140.0 * 2.0 ** (0.3 * np.sin(2 * np.pi * 0.45 * time))
    glottal = 2.0 * (np.cumsum(pitch) / rate % 1.0) - 1.0
    vowels = []
    for formants in ((700.0, 1200.0), (350.0, 1900.0)):
        sound = glottal
        for hertz in formants:
            radius = np.exp(-np.pi * 90.0 / rate)
            turn = 2.0 * radius * np.cos(2 * np.pi * hertz / rate)
            sound = lfilter([1.0 - radius], [1.0, -turn, radius**2], sound)
        vowels.append(sound / np.sqrt(np.mean(sound**2)))
    share = 0.5 + 0.5 * np.sin(2 * np.pi * 0.9 * time)
    return (share * vowels[0] + (1.0 - share) * vowels[1]) * (np.sin(2 * np.pi * 2.5 * time) > 0)


def wav(seconds: float = 1.0, rate: int = 16_000, channels: int = 1) -> bytes:
    """Return a wav file of a voice on all channels."""
    with io.BytesIO() as out:
        sound = np.tile(0.1 * voiced(seconds, rate)[:, None], (1, channels))
        soundfile.write(out, sound, rate, format="WAV")
        return out.getvalue()


def swelling(seconds: float, level: float = 0.1, seed: int = 0) -> np.ndarray:
    """Return (N,) float32 at 16 kHz of noise and a tone whose loudness and colour change."""
    rng = np.random.default_rng(seed)
    times = np.arange(round(seconds * 16_000)) / 16_000
    noise = rng.standard_normal(len(times)) + 3 * np.sin(2 * np.pi * 150 * times)
    return (level * noise * (1.05 + np.sin(2 * np.pi * 1.5 * times)) + 0.01).astype(np.float32)


def distance(values: np.ndarray, truth: np.ndarray) -> float:
    """Return the relative L2 distance of values of one shape."""
    assert values.shape == truth.shape
    return float(np.linalg.norm(values - truth) / np.linalg.norm(truth))
