"""Sound: a recording as a browser can play it, and its outline for drawing."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile

from audio_features import AudioError, Wave
from audio_features.sound_file import soundfile_name

EMBED_LIMIT = 2_000_000
"""Recordings of at most this many bytes are embedded as they are; bigger ones become MP3."""
OUTLINE_RATE = 100
"""Values a second of a wave's outline."""

# What every current browser plays, by libsndfile's names.
_BROWSER_TYPES = {
    ("FLAC", "PCM_16"): "audio/flac",
    ("FLAC", "PCM_24"): "audio/flac",
    ("MP3", "MPEG_LAYER_III"): "audio/mpeg",
    ("WAV", "FLOAT"): "audio/wav",
    ("WAV", "PCM_16"): "audio/wav",
    ("WAV", "PCM_24"): "audio/wav",
    ("WAV", "PCM_U8"): "audio/wav",
}
_MP3_RATES = (16_000, 22_050, 24_000, 32_000, 44_100, 48_000)
_BLOCK = 1 << 16


Playable = str | os.PathLike[str] | Wave | tuple[np.ndarray, int]
"""A file, a `Wave`, or an array of samples with its rate in Hz."""


def as_sound(audio: Playable) -> str | os.PathLike[str] | Wave:
    """Return (samples (N,), rate) as a `Wave`, and anything else as it is.

    Raises AudioError if `audio` is not sound, or an array has no rate.
    """
    if isinstance(audio, tuple) and len(audio) == 2:
        return Wave.from_array(*audio, "audio")
    if not isinstance(audio, str | os.PathLike | Wave):
        raise AudioError(
            f"audio is {type(audio).__name__}: give a file, a Wave, or (samples, rate in Hz)"
        )
    return audio


@dataclass(frozen=True)
class Sound:
    """Encoded sound: the bytes of a file, and their media type."""

    data: bytes
    type: str

    @classmethod
    def of(cls, audio: str | os.PathLike[str] | Wave) -> Sound:
        """Return `audio` as a browser plays it.

        A WAV, FLAC or MP3 file of up to EMBED_LIMIT bytes is taken byte for byte, any other file
        is encoded: without loss (FLAC) while that stays under the limit, else as mono MP3.
        MP3 from here starts on the sample: its header tells players what to skip.

        Raises AudioError where the file is not sound.
        """
        if not isinstance(audio, Wave):
            path = Path(audio)
            wave = Wave.load(path)
            info = soundfile.info(soundfile_name(path))
            media_type = _BROWSER_TYPES.get((info.format, info.subtype))
            if media_type and path.stat().st_size <= EMBED_LIMIT:
                return cls(path.read_bytes(), media_type)
            audio = wave
        # FLAC takes about one byte a sample of speech.
        if len(audio.samples) <= EMBED_LIMIT:
            flac = _encode(audio, format="FLAC", subtype="PCM_16")
            if len(flac) <= EMBED_LIMIT:
                return cls(flac, "audio/flac")
        rate = next((rate for rate in _MP3_RATES if rate >= audio.sample_rate), _MP3_RATES[-1])
        mp3 = _encode(audio.resample(rate), format="MP3", subtype="MPEG_LAYER_III")
        return cls(mp3, "audio/mpeg")


def _encode(wave: Wave, **kind: str) -> bytes:
    buffer = io.BytesIO()
    with soundfile.SoundFile(
        buffer, "w", samplerate=wave.sample_rate, channels=1, **kind
    ) as encoder:
        for start in range(0, len(wave.samples), _BLOCK):
            encoder.write(wave.samples[start : start + _BLOCK])
    return buffer.getvalue()


def outline(wave: Wave) -> np.ndarray:
    """Return the largest |sample| of each 1/OUTLINE_RATE s as (M,) floats, 1 the clip's peak."""
    n = int(np.ceil(wave.duration * OUTLINE_RATE))
    edges = np.arange(n) * len(wave.samples) // n
    peaks = np.maximum.reduceat(np.abs(wave.samples), edges)
    return peaks / max(float(peaks.max()), 1e-9)
