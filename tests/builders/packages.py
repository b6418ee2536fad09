"""A package that adds an extractor, installed as pip leaves it: a module and its dist-info."""

import sys
from pathlib import Path

import pytest

CODE = '''
import numpy as np
import audio_features as af

class Loudness:
    """Columns: ln of the RMS, times a gain; and a clock."""
    def __init__(self, gain=1.0):
        self.spec = {"kind": "loudness", "gain": gain}
        self.names, self.centred, self.gain = ("rms", "clock"), (True, False), gain

    def extract(self, wave):
        if "bad" in str(wave.source):
            raise RuntimeError("CALL")
        times = np.arange(wave.n_frames(20)) / 20
        rms = self.gain * np.log(wave.rms(times) + 1e-3)
        return af.FeatureTrack(np.stack([rms, times + wave.offset], axis=1), times)
'''


def install(
    folder: Path, patch: pytest.MonkeyPatch, version: str = "1.2", code: str = CODE
) -> None:
    """Install the package own-features, with the extractor `loudness`, into a folder."""
    info = folder / "own_features.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (folder / "own_features.py").write_text(code, encoding="utf-8")
    about = f"Metadata-Version: 2.1\nName: own-features\nVersion: {version}\n"
    (info / "METADATA").write_text(about, encoding="utf-8")
    entry = "[gesturekit.extractors]\nloudness = own_features:Loudness\n"
    (info / "entry_points.txt").write_text(entry, encoding="utf-8")
    patch.syspath_prepend(folder)
    patch.setitem(sys.modules, "own_features", None)
    del sys.modules["own_features"]
