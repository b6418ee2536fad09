"""Sounds the tests share."""

from __future__ import annotations

import numpy as np
import pytest

from audio_features import Wave


@pytest.fixture
def speech() -> Wave:
    """4 s of syllables at 16 kHz."""
    return synthetic_speech(4.0)


def synthetic_speech(seconds: float, rate: int = 16_000) -> Wave:
    """Syllables of 250 ms every 400 ms: harmonics of a gliding fundamental under an envelope."""
    times = np.arange(round(seconds * rate)) / rate
    fundamental = 150.0 + 30.0 * np.sin(2 * np.pi * 0.5 * times)
    phase = 2 * np.pi * np.cumsum(fundamental) / rate
    voice = sum(np.sin(k * phase) / k for k in range(1, 20))
    place = (times % 0.4) / 0.25
    envelope = np.where(place < 1, np.sin(np.pi * np.minimum(place, 1.0)) ** 2, 0.0)
    return Wave((0.15 * envelope * voice).astype(np.float32), rate, "synthetic speech")
