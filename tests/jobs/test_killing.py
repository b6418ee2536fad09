"""SIGKILL at random moments: a rerun completes, and gives what an undisturbed run gives."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

KILLS = 50
"""Number for each command; `make test` kills a few."""
SCRIPT = Path(__file__).with_name("killing.py")


def killed(kills: int, whole: list[object], again: list[object]) -> int:
    """Run `whole`; kill `again` so many times and run it to its end; return the kills in time."""
    arguments = [json.dumps(list(map(str, one))) for one in (whole, again)]
    done = subprocess.run(
        [sys.executable, SCRIPT, str(kills), "0", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=1800,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return int(done.stdout.splitlines()[-1])


@pytest.fixture
def recordings(tmp_path, write_pair) -> Path:
    for number in range(8):
        write_pair(tmp_path / "in", f"{number}", 1.0 + number % 3, fps=25.0, seed=number)
    return tmp_path / "in"


def content(folder: Path) -> dict[str, bytes]:
    """Bytes of all visible files."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in files
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }


@pytest.mark.parametrize("kills", [2, pytest.param(KILLS, marks=pytest.mark.stress)])
def test_features(recordings, tmp_path, kills):
    command = ["features", *sorted(recordings.glob("*.wav")), "--cache", "off", "--existing"]
    whole, out = tmp_path / "whole", tmp_path / "out"
    hits = killed(kills, [*command, "skip", "--out", whole], [*command, "skip", "--out", out])
    assert hits and content(whole).keys() == content(out).keys()
    for path in whole.glob("*.npz"):
        with np.load(path) as one, np.load(out / path.name) as other:
            assert (one["values"] == other["values"]).all()


@pytest.mark.stress
def test_prepare(recordings, tmp_path):
    whole, out = recordings / "whole.jsonl", recordings / "out.jsonl"
    command = ["prepare", recordings, "--existing", "replace", "--out"]
    assert killed(KILLS, [*command, whole], [*command, out]) > KILLS // 4
    assert whole.read_bytes() == out.read_bytes()


@pytest.mark.stress
def test_render(recordings, tmp_path):
    whole, out = tmp_path / "whole", tmp_path / "out"
    command = ["render", recordings, "--model", "demo", "--format", "bvh,npz", "--out"]
    assert killed(KILLS, [*command, whole], [*command, out]) > 5  # later ones find all done
    assert content(whole) == content(out) and len(content(out)) == 16
