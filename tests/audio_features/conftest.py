"""Sounds the tests share."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from audio_features import Wave


@pytest.fixture
def speech() -> Wave:
    """4 s: syllables of 250 ms every 400 ms, harmonics of a gliding pitch under an envelope."""
    rate = 16_000
    times = np.arange(4 * rate) / rate
    fundamental = 150.0 + 30.0 * np.sin(2 * np.pi * 0.5 * times)
    phase = 2 * np.pi * np.cumsum(fundamental) / rate
    voice = sum(np.sin(k * phase) / k for k in range(1, 20))
    place = (times % 0.4) / 0.25
    envelope = np.where(place < 1, np.sin(np.pi * np.minimum(place, 1.0)) ** 2, 0.0)
    return Wave((0.15 * envelope * voice).astype(np.float32), rate, "synthetic speech")


@pytest.fixture(scope="module", params=["group", "layer"])
def wavlm_folder(request, tmp_path_factory, write_wavlm) -> Path:
    """A tiny Base and a tiny Large in which no tensor is all zeros or ones."""
    path = tmp_path_factory.mktemp(request.param)
    write_wavlm(path, norm=request.param)
    return path


@pytest.fixture
def wavlm_copy(wavlm_folder, tmp_path) -> Path:
    """The folder again, to be changed."""
    shutil.copytree(wavlm_folder, tmp_path / "copy")
    return tmp_path / "copy"
