"""Sounds the tests share."""

from __future__ import annotations

import shutil
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from audio_features import Wave
from audio_features.acoustic import torchaudio_backend


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


@pytest.fixture
def torchaudio(monkeypatch):
    """torchaudio, with a stub in place of the extension where that is built for another torch.

    The functions compared here are plain torch; on a CPU-only torch the registry's torchaudio
    fails in nothing but loading its CUDA extension.
    """
    from importlib.util import find_spec

    if find_spec("torchaudio") is None:
        pytest.skip("torchaudio is not installed")
    torchaudio_backend.import_torchaudio.cache_clear()
    if torchaudio_backend.import_torchaudio()[0] is None:
        stub = types.ModuleType("torchaudio._extension")
        stub._IS_TORCHAUDIO_EXT_AVAILABLE = stub._IS_ALIGN_AVAILABLE = False
        stub.fail_if_no_align = lambda function: function
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchaudio"]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, "torchaudio._extension", stub)
        torchaudio_backend.import_torchaudio.cache_clear()
    yield torchaudio_backend.import_torchaudio()[0]
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchaudio"]:
        monkeypatch.delitem(sys.modules, name)
    torchaudio_backend.import_torchaudio.cache_clear()
