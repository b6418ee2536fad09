"""Files that are broken or hostile: our error or a motion, in bounded time and memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).with_name("fuzz.py")


@pytest.mark.skipif(sys.platform != "linux", reason="memory is bounded by Linux' limits")
def test_mutated_files_are_read_or_refused():
    """300 cases; `python tests/formats/fuzz.py --cases 10000` does more of the same."""
    root = str(FUZZ.parents[2])
    done = subprocess.run(
        [sys.executable, str(FUZZ), "--cases", "300"],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["broken"] == []
    assert sum(summary["results"].values()) == 300
    assert {"bvh read", "bvh refused", "npz read", "npz refused"} <= set(summary["results"])
