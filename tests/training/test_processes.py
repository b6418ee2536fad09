"""Processes that torchrun starts share a batch and agree on its gradient."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from gesturekit.errors import ConfigError
from gesturekit.training.run.processes import Processes

SCRIPT = """
import json, sys, torch
from pathlib import Path
from gesturekit.training.run.processes import Processes

with Processes.from_environment("cpu") as processes:
    torch.manual_seed(0)
    net, unused = torch.nn.Linear(4, 1), torch.nn.Linear(4, 1)
    batch = torch.randn(5, 4)
    mine = processes.share(len(batch))
    (whole,) = torch.autograd.grad(net(batch).square().mean(), net.weight)
    net(batch[mine]).square().mean().backward()
    parameters = [*net.parameters(), *unused.parameters()]
    weight = (mine.stop - mine.start) / len(batch)
    processes.average_gradients(parameters, weight)
    told = {
        "gradient": net.weight.grad[0].tolist(),
        "whole": whole[0].tolist(),
        "unused": unused.weight.grad[0].tolist(),
        "mean": float(processes.mean(torch.tensor(float(processes.rank)))),
        "first": processes.is_first,
    }
    processes.wait()
    Path(sys.argv[1], f"{processes.rank}.json").write_text(json.dumps(told))
"""


def test_two_processes_find_the_gradient_of_one(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    subprocess.run(
        [sys.executable, *launch, str(script), str(tmp_path)],
        check=True,
        timeout=120,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    two = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2)]
    for told in two:
        assert told["gradient"] == pytest.approx(told["whole"], abs=1e-6)
        assert told["unused"] == [0.0] * 4
        assert told["mean"] == 0.5
    assert two[0]["gradient"] == two[1]["gradient"]
    assert [told["first"] for told in two] == [True, False]


def test_shares_make_up_the_whole():
    for n in (0, 1, 7, 8):
        shares = [Processes(rank, 3).share(n) for rank in range(3)]
        assert [i for share in shares for i in range(n)[share]] == list(range(n))


def test_an_incomplete_environment_is_reported(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "two")
    monkeypatch.setenv("RANK", "0")
    with pytest.raises(ConfigError, match="torchrun"), Processes.from_environment():
        pass
