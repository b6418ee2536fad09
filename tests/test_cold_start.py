"""The first render after installation gives the same bytes as later ones."""

from __future__ import annotations

import os
import subprocess
import sys

import soundfile

import audio_features as af
import gesturekit as gk
from gesturekit.systems import bundled_speech


def test_bytes_do_not_depend_on_caches(tmp_path):
    speech = af.Wave.load(bundled_speech(), duration=10.0)
    soundfile.write(tmp_path / "speech.wav", speech.samples, speech.sample_rate, subtype="FLOAT")
    kernels = tmp_path / "kernels"
    kernels.mkdir()
    empty = {"NUMBA_CACHE_DIR": str(kernels), "GESTUREKIT_CACHE": str(tmp_path / "features")}
    subprocess.run(
        [sys.executable, "-m", "gesturekit", "render", "speech.wav", "--model=demo", "--out=cold"],
        cwd=tmp_path,
        env={**os.environ, **empty},
        check=True,
        capture_output=True,
    )
    model = gk.load("demo")
    model.generate(seconds=2)  # its kernels are in the cache from here on
    model.generate(tmp_path / "speech.wav").save(tmp_path / "warm.bvh")
    cold = (tmp_path / "cold" / "speech.bvh").read_bytes()
    assert cold == (tmp_path / "warm.bvh").read_bytes()
