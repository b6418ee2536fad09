"""Files that are broken or hostile: our error or a result, in bounded time and memory."""

import json
import os
import re
import resource
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from targets import TARGETS

import audio_features as af

FUZZ = Path(__file__).with_name("fuzz.py")
EXECUTIONS = 10
QUICK = [name for name, target in TARGETS.items() if not target.is_slow]

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="memory is bounded by Linux' limits"
)


def fuzz(*arguments: str) -> dict[str, dict]:
    root = str(FUZZ.parents[2])
    done = subprocess.run(
        [sys.executable, str(FUZZ), "--inside", "--engine", "own", *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    return {(found := json.loads(line))["target"]: found for line in done.stdout.splitlines()}


def test_mutated_files_are_read_or_refused():
    found = fuzz(*QUICK, "--executions", str(EXECUTIONS))
    assert {name: one["broken"] for name, one in found.items() if one["broken"]} == {}
    assert len(found) == len(QUICK) > 20
    assert all(one["executions"] >= EXECUTIONS for one in found.values())


@pytest.mark.stress
def test_many_mutated_files():
    """Run for minutes, those that load a model too: the mutators alone, on every machine."""
    found = fuzz("--executions", "3000", "--seconds", "60")
    assert {name: one["broken"] for name, one in found.items() if one["broken"]} == {}


def test_a_feature_file_of_zeros_is_not_unpacked(tmp_path):
    path = tmp_path / "a.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("values.npy", "w") as member,
    ):
        about = {"descr": "<f4", "fortran_order": False, "shape": (30 << 20, 1)}
        np.lib.format.write_array_header_1_0(member, about)
        for _ in range(30):
            member.write(bytes(4 << 20))
    assert path.stat().st_size < 1 << 20
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(af.FeatureError, match=re.escape(str(path))):
        af.FeatureTrack.load(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20 << 10
