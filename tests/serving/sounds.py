"""Sounds as bytes."""

from __future__ import annotations

import io

import numpy as np
import soundfile


def wav(seconds: float = 1.0, rate: int = 16_000, channels: int = 1) -> bytes:
    """Noise."""
    rng = np.random.default_rng(0)
    with io.BytesIO() as out:
        sound = 0.1 * rng.standard_normal((round(seconds * rate), channels))
        soundfile.write(out, sound, rate, format="WAV")
        return out.getvalue()
