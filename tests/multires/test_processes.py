"""Two processes under torchrun come to the weights of one."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import nullcontext

import pytest
import yaml
from safetensors.torch import load_file

from gesturekit.errors import ConfigError
from gesturekit.multires.training.trainer import train
from gesturekit.training.config import to_dict
from gesturekit.training.run.processes import Processes

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
