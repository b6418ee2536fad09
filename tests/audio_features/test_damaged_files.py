"""Mutated sound files: our error, or the sound that was meant; never a part of it unannounced.

GESTUREKIT_FUZZ=10000 makes it run that many mutations instead of a few hundred.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest
import soundfile

from audio_features import AudioError, Wave

MUTATIONS = int(os.environ.get("GESTUREKIT_FUZZ", "400"))
RATE = 16_000
KINDS = {
    "pcm16.wav": {"format": "WAV", "subtype": "PCM_16"},
    "stereo24.wav": {"format": "WAVEX", "subtype": "PCM_24"},
    "float.wav": {"format": "WAV", "subtype": "FLOAT"},
    "rf64.wav": {"format": "RF64", "subtype": "PCM_16"},
    "mulaw.wav": {"format": "WAV", "subtype": "ULAW"},
    "pcm16.flac": {"format": "FLAC", "subtype": "PCM_16"},
    "stereo24.flac": {"format": "FLAC", "subtype": "PCM_24"},
    "vorbis.ogg": {"format": "OGG", "subtype": "VORBIS"},
    "opus.ogg": {"format": "OGG", "subtype": "OPUS"},
}


def content(folder: Path, name: str) -> bytes:
    """A quarter of a second of noise under a tone, with a title, so that chunks follow it."""
    rng = np.random.default_rng(0)
    tone = 0.2 * np.sin(2 * np.pi * 440 * np.arange(RATE // 4) / RATE)
    sound = tone + 0.02 * rng.standard_normal(RATE // 4)
    if name.startswith("stereo"):
        sound = np.stack([sound, 0.5 * sound], axis=1)
    path = folder / name
    channels = 1 if sound.ndim == 1 else 2
    with soundfile.SoundFile(path, "w", RATE, channels, **KINDS[name]) as file:
        file.title = "a title"
        file.write(sound)
    return path.read_bytes()


def mutated(whole: bytes, rng: np.random.Generator) -> bytes:
    """One to three flips, cuts or edits of the header."""
    data = bytearray(whole)
    for _ in range(rng.integers(1, 4)):
        if len(data) < 8:
            break
        how = rng.integers(5)
        if how == 0:  # bits anywhere
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        elif how == 1:  # bytes of the header
            data[rng.integers(min(96, len(data)))] = rng.integers(256)
        elif how == 2:  # a number of the header
            at = rng.integers(min(96, len(data)) - 4)
            extreme = rng.choice([0, 1, 0xFFFFFFFF, 0x7FFFFFFF, 0x80000000, rng.integers(1 << 16)])
            data[at : at + 4] = struct.pack("<I", int(extreme))
        elif how == 3:  # a copy that broke off
            del data[rng.integers(len(data)) :]
        else:  # a hole
            at = rng.integers(len(data))
            del data[at : at + rng.integers(1, 600)]
    return bytes(data)


@pytest.mark.parametrize("name", KINDS)
def test_damage_is_refused_or_harmless(name, tmp_path):
    whole = content(tmp_path, name)
    meant = Wave.load(tmp_path / name).samples
    path = tmp_path / f"mutated{Path(name).suffix}"
    rng = np.random.default_rng(list(KINDS).index(name))
    read = 0
    for case in range(-(-MUTATIONS // len(KINDS))):
        data = mutated(whole, rng)
        path.write_bytes(data)
        try:
            wave = Wave.load(path)
        except AudioError as error:
            assert str(path) in str(error)
            continue
        read += 1
        assert wave.sample_rate == RATE, case
        assert len(wave.samples) >= len(meant), case
        differing = np.count_nonzero(wave.samples[: len(meant)] != meant)
        if name.endswith(".wav"):  # it has no checksum: a sample may be wrong where a byte is
            changed = sum(a != b for a, b in zip(whole, data))
            assert differing <= changed, case
        else:
            assert differing == 0, case
    print(f"{name}: {read} of {case + 1} mutated files were read")


def test_a_small_file_cannot_take_gigabytes_of_samples(tmp_path):
    """65 blocks of 2^20 zeros are 260 MB of samples; FLAC holds them in 250 kB."""
    with soundfile.SoundFile(tmp_path / "a.flac", "w", 655350, 1, "PCM_16") as file:
        for _ in range(65):
            file.write(np.zeros(1 << 20, np.int16))
    with pytest.raises(AudioError, match=r"a\.flac: 68157440 samples .*over 20 times the file"):
        Wave.load(tmp_path / "a.flac")
    assert len(Wave.load(tmp_path / "a.flac", start=3, duration=2).samples) == 2 * 655350
