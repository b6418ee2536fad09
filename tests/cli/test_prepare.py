"""`gesturekit prepare` as a user meets it: exit codes and one clear line a problem."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

BVH = """HIERARCHY
ROOT Hips
{{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Spine
  {{
    OFFSET 0 50 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT Head
    {{
      OFFSET 0 40 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {{
        OFFSET 0 20 0
      }}
    }}
  }}
}}
MOTION
Frames: {frames}
Frame Time: 0.0333333333
"""


@pytest.fixture
def recordings(tmp_path: Path) -> Path:
    folder = tmp_path / "recordings"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for name in ("a", "b", "c"):
        soundfile.write(folder / f"{name}.wav", 0.1 * rng.standard_normal(32000), 16000)
        angle = 10 * np.sin(np.arange(60)[:, None] / 10 + rng.uniform(0, 6, 9))
        rows = "".join(f"0 90 0 {' '.join(f'{x:.4f}' for x in row)}\n" for row in angle)
        (folder / f"{name}.bvh").write_text(BVH.format(frames=60) + rows)
    return folder


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from gesturekit.cli import main; main()", "prepare"]
        + [str(argument) for argument in arguments],
        capture_output=True,
        text=True,
        check=False,
    )


def test_all_used(recordings, tmp_path):
    done = run(recordings, "--out", tmp_path / "corpus.jsonl", "--style", "calm")
    assert (done.returncode, done.stderr) == (0, "")
    assert "paired        3 items, 6.0 s: train 2 (4.0 s), test 1 (2.0 s)" in done.stdout
    assert (tmp_path / "corpus.jsonl").is_file()


def test_some_left_out(recordings, tmp_path):
    (recordings / "a.wav").write_text("no sound")
    (recordings / "alone.wav").write_bytes((recordings / "b.wav").read_bytes())
    done = run(recordings, "--out", tmp_path / "corpus.jsonl", "--holdout", "0")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    told = done.stderr.splitlines()
    assert len(told) == 2
    assert told[0].startswith("error: ") and str(recordings / "a.wav") in told[0]
    assert told[1].startswith("left out: speech without motion") and "alone.wav" in told[1]
    assert "paired        2 items" in done.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["nowhere"],
        ["--hold-out-seconds", "ten", "."],
        ["--style-pattern", "(", "."],
        ["--holdout", "1", "."],
    ],
)
def test_nothing_can_start(arguments, tmp_path):
    done = run(*arguments, "--out", tmp_path / "corpus.jsonl")
    assert done.returncode == 2
    assert "Error: " in done.stderr and "Traceback" not in done.stderr


def test_nothing_usable(tmp_path):
    (tmp_path / "empty").mkdir()
    done = run(tmp_path / "empty", "--out", tmp_path / "corpus.jsonl")
    assert done.returncode == 2
    assert "no usable recording" in done.stderr
    assert not (tmp_path / "corpus.jsonl").exists()
