"""Outputs of a training run, and training in separate processes."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

from gesturekit.training.run_folder import Checkpoints


def weights(folder: Path) -> dict[str, torch.Tensor]:
    """Return the tensors of a model folder."""
    return load_file(folder / "model.safetensors")


def same_weights(one: Path, other: Path) -> bool:
    """Return whether all tensors of two model folders are equal to the last bit."""
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys()
    return all(torch.equal(value, second[name]) for name, value in first.items())


def apart(one: Path, other: Path) -> list[float]:
    """Return the relative differences of each tensor of two models, and of all together last."""
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys()
    pairs = [tuple(own[name].double().flatten() for own in (first, second)) for name in first]
    pairs.append(tuple(map(torch.cat, zip(*pairs, strict=True))))
    return [float((a - b).norm() / (b.norm() + 1e-6)) for a, b in pairs]


def logged(run: Path, kind: str | None = None) -> list[dict[str, Any]]:
    """Return the lines of this kind that a run logged, losses by default, without durations."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    lines = [line for line in lines if line.get("kind") == kind]
    return [{key: x for key, x in line.items() if "seconds" not in key} for line in lines]


def cut_off(run: Path, step: int) -> None:
    """Remove the checkpoint of a step and the model, as if the run had been killed before it."""
    Checkpoints(run / "checkpoints").path(step).unlink()
    for file in (run / "model").iterdir():
        file.unlink()


def launch(*arguments: object, processes: int = 0) -> subprocess.Popen[str]:
    """Start Python with these arguments; or so many processes of it, through torchrun."""
    torchrun = ("-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={processes}")
    return subprocess.Popen(
        [sys.executable, *(torchrun if processes else ()), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
    )


def ended(process: subprocess.Popen[str]) -> str:
    """Wait until a process ends well; return what it wrote."""
    output, _ = process.communicate(timeout=240)
    assert process.returncode == 0, output
    return output
