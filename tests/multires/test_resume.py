"""A killed run goes on from its last checkpoint to the very same weights."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest
import torch
import yaml
from safetensors.torch import load_file

from gesturekit.training.config import to_dict


def start(config_file, *more: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "gesturekit", "train", str(config_file), *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def steps(run) -> list[int]:
    try:
        return [json.loads(x)["step"] for x in (run / "metrics.jsonl").read_text().splitlines()]
    except (FileNotFoundError, ValueError):
        return []


@pytest.fixture
def config_file(make_config, tmp_path):
    """120 iterations over two pairs of levels, a checkpoint every 30."""
    config = make_config(
        training={"first_stage": 60, "further_stages": 60, "renew_every": 20, "window": 2.0},
        checkpoint_every=30,
        log_every=2,
    )
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(to_dict(config)))
    return path


def test_killed_between_checkpoints_and_resumed_bitwise(config_file, tmp_path):
    whole = start(config_file, f"out={tmp_path / 'whole'}")
    killed = start(config_file, f"out={tmp_path / 'killed'}")
    deadline = time.monotonic() + 240
    while not any(72 <= step <= 108 for step in steps(tmp_path / "killed")):
        assert killed.poll() is None and time.monotonic() < deadline, killed.communicate()[0]
        time.sleep(0.02)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    reached = steps(tmp_path / "killed")[-1]
    assert 72 <= reached < 120
    assert whole.wait(timeout=240) == 0, whole.communicate()[0]

    resumed = start(config_file, f"out={tmp_path / 'killed'}", "--resume")
    output, _ = resumed.communicate(timeout=240)
    assert resumed.returncode == 0, output
    after = 30 * (reached // 30)
    assert f"Resuming after step {after}." in output
    one, other = (
        load_file(tmp_path / run / "model" / "model.safetensors") for run in ("whole", "killed")
    )
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)

    def losses(run):
        lines = [json.loads(x) for x in (tmp_path / run / "metrics.jsonl").read_text().splitlines()]
        return [{k: v for k, v in line.items() if "seconds" not in k} for line in lines]

    assert losses("whole") == losses("killed"), "the log has no gap and nothing twice"


def test_a_damaged_checkpoint_falls_back_on_the_one_before(config_file, tmp_path):
    run = tmp_path / "run"
    short = ("training.first_stage=10", "training.further_stages=10", "checkpoint_every=5")
    process = start(config_file, *short)
    assert process.wait(timeout=240) == 0, process.communicate()[0]
    last = sorted((run / "checkpoints").iterdir())[-1]
    last.write_bytes(last.read_bytes()[:1000])
    resumed = start(config_file, *short, "--resume")
    output, _ = resumed.communicate(timeout=240)
    assert resumed.returncode == 0, output
    assert "cannot be read" in output and "Resuming after step 15." in output
