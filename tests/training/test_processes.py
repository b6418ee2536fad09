"""Processes that torchrun would start share a batch and agree on its gradient."""

import json
import socket
from datetime import timedelta

import pytest
import torch
from runs import ended, launch

from gesturekit.errors import ConfigError
from gesturekit.training.session import Processes

SCRIPT = """
import json, os, sys, torch
from pathlib import Path
from gesturekit.training.session import Processes

os.environ["RANK"] = os.environ["LOCAL_RANK"] = "0" if os.fork() else "1"
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
    own = torch.tensor(float(processes.rank))
    result = {
        "gradient": net.weight.grad[0].tolist(),
        "whole": whole[0].tolist(),
        "unused": unused.weight.grad[0].tolist(),
        "mean": float(processes.mean(own)),
        "own": float(own),
        "first": processes.is_first,
    }
    processes.wait()
    Path(sys.argv[1], f"{processes.rank}.json").write_text(json.dumps(result))
if processes.is_first:
    assert os.wait()[1] == 0
"""


def test_two_processes_find_the_gradient_of_one(tmp_path, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    told = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    for name, value in {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", **told}.items():
        monkeypatch.setenv(name, value)
    (tmp_path / "script.py").write_text(SCRIPT)
    ended(launch(tmp_path / "script.py", tmp_path))
    two = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2)]
    for result in two:
        assert result["gradient"] == pytest.approx(result["whole"], abs=1e-6)
        assert result["unused"] == [0.0] * 4
        assert result["mean"] == 0.5
    assert [result["own"] for result in two] == [0.0, 1.0], "a mean changes nothing in place"
    assert two[0]["gradient"] == two[1]["gradient"]
    assert [result["first"] for result in two] == [True, False]


@pytest.mark.parametrize(
    ("gpus", "device", "backend", "places"),
    [
        (0, "auto", "gloo", ["auto", "auto"]),
        (1, "auto", "gloo", ["cuda:0", "cuda:0"]),  # NCCL refuses two processes on one GPU
        (2, "cuda", "nccl", ["cuda:0", "cuda:1"]),
        (2, "cuda:1", "gloo", ["cuda:1", "cuda:1"]),
        (2, "cpu", "gloo", ["cpu", "cpu"]),
    ],
)
def test_processes_share_gpus_if_there_are_too_few(
    monkeypatch, caplog, gpus, device, backend, places
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(torch.cuda, "set_device", lambda name: chosen.append(name))
    monkeypatch.setattr(
        torch.distributed, "init_process_group", lambda name, timeout: begun.append((name, timeout))
    )
    monkeypatch.setattr(torch.distributed, "destroy_process_group", lambda: None)
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    begun, chosen = [], []
    for rank in range(2):
        monkeypatch.setenv("RANK", str(rank))
        monkeypatch.setenv("LOCAL_RANK", str(rank))
        with Processes.from_environment(device) as processes:
            assert processes.device(device) == places[rank]
    # Others wait while the first process reads hours of recordings.
    assert [name for name, _ in begun] == [backend] * 2 and begun[1][1] >= timedelta(hours=12)
    assert chosen == (places if gpus and device in ("auto", "cuda") else [])
    assert ("1 GPU" in caplog.text) == (gpus == 1)


def test_shares_make_up_the_whole():
    for n in (0, 1, 7, 8):
        shares = [Processes(rank, 3).share(n) for rank in range(3)]
        assert [i for share in shares for i in range(n)[share]] == list(range(n))


@pytest.mark.parametrize(("name", "value"), [("WORLD_SIZE", "two"), ("RANK", None)])
def test_a_wrong_or_missing_variable_of_torchrun_is_refused_by_name(monkeypatch, name, value):
    for other in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE"):
        monkeypatch.setenv(other, "1")
    monkeypatch.setenv(name, value) if value else monkeypatch.delenv(name)
    with pytest.raises(ConfigError, match=name), Processes.from_environment("cpu"):
        pass
