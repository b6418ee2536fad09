"""Several processes that import librosa for the first time, with an empty cache of numba."""

import os
import subprocess
import sys

import pytest
from filelock import FileLock

CODE = """
import sys
import numpy as np
import audio_features as af
from audio_features.acoustic import import_librosa
from gesturekit.evaluation import music_beats, speech_onsets
import_librosa()
if "compute" in sys.argv:
    clicks = np.zeros(48000)
    clicks[[16000, 32000]] = 1
    music_beats(af.Wave(clicks, 16000))
    print(speech_onsets(af.Wave(clicks, 16000)).round(1).tolist())
input()
"""


def start(folder, *arguments: str) -> subprocess.Popen:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    return subprocess.Popen(
        [sys.executable, "-c", CODE, *arguments],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


@pytest.mark.stress
def test_processes_that_fill_the_cache_at_once_leave_one_that_works(tmp_path):
    for _ in range(2):
        for process in [start(tmp_path, "compute") for _ in range(3)]:
            assert process.communicate("\n", timeout=200)[0] == "[1.0, 2.0]\n"
            assert process.returncode == 0


@pytest.mark.stress
def test_a_process_holds_the_lock_only_while_it_imports(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    process = start(os.environ.get("NUMBA_CACHE_DIR", ""))
    try:
        deadline = 60
        while not (locks := list(tmp_path.glob("librosa-*.lock"))) and deadline:
            deadline -= 1
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(timeout=1)
        with FileLock(locks[0], timeout=60):
            assert process.poll() is None
    finally:
        process.communicate("\n", timeout=60)
