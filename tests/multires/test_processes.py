"""Trainings in processes of their own: killed and resumed to the same weights, or two as one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext

import pytest
import torch
import yaml
from safetensors.torch import load_file

from gesturekit.errors import ConfigError
from gesturekit.multires.training.trainer import train
from gesturekit.training.config import to_dict
from gesturekit.training.run.processes import Processes


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


STEPS = {"first_stage": 2, "further_stages": 2, "discriminator_steps": 2}


def test_two_processes_train_the_same_model_as_one(make_config, tmp_path, device):
    config = make_config(training=STEPS, out=str(tmp_path / "two"), device=device)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(config)))
    launch = ["torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    run = subprocess.run(
        [
            *(sys.executable, "-m", *launch, "-m", "gesturekit"),
            *("train", str(tmp_path / "config.yaml")),
        ],
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert run.returncode == 0, run.stderr
    train(make_config(training=STEPS, out=str(tmp_path / "one"), device=device))
    two, one = (load_file(tmp_path / n / "model" / "model.safetensors") for n in ("two", "one"))
    assert one.keys() == two.keys()
    for name, weight in one.items():
        # Adam makes whole steps of what rounding leaves of a gradient that is nearly zero.
        apart = float((two[name] - weight).norm() / (weight.norm() + 1e-6))
        assert apart < 2e-3, name


def test_more_processes_than_windows_are_refused(make_config, monkeypatch):
    three = nullcontext(Processes(count=3))
    monkeypatch.setattr(Processes, "from_environment", lambda device: three)
    monkeypatch.setattr(Processes, "wait", lambda self: None)
    with pytest.raises(ConfigError, match="training.batch: 2 "):
        train(make_config())
