"""Training and sampling on a GPU: the CPU's weights and motion, and the same ones again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from runs import apart, same_weights

import gesturekit as gk
from gesturekit.diffusion import train
from gesturekit.training.run_folder import Checkpoints

EVERYTHING = {
    "eval_every": 3,
    "noise": {"predict": "clean"},
    "training": {"ema": 0.5, "dropout_condition": 0.3, "changes": 0.3, "min_snr": 5.0},
}
RUNS = {"published": {}, "everything": EVERYTHING}


@pytest.fixture
def run(make_config, tmp_path):
    """run(device, resume=False): the folder of a short training without dropout."""

    def make(device: str, *, resume: bool = False, **changes) -> Path:
        network = {"dropout": 0.0, **changes.pop("network", {})}
        own = {"out": str(tmp_path / device), "network": network, **changes}
        return train(make_config(device=device, **own), resume=resume)

    return make


@pytest.mark.parametrize(
    "kind", ["published", pytest.param("everything", marks=pytest.mark.stress)]
)
def test_a_gpu_trains_the_same_model_as_the_cpu(gpu, run, kind):
    assert apart(run("cuda", **RUNS[kind]), run("cpu", **RUNS[kind]))[-1] < 1e-3


@pytest.mark.stress
def test_training_on_a_gpu_is_the_same_again_after_a_kill(gpu, run, tmp_path):
    # Dropout draws from the GPU's own generator.
    options = {**EVERYTHING, "network": {"dropout": 0.2}}
    whole = run("cuda", **options)
    again = {**options, "out": str(tmp_path / "again")}
    run("cuda", **again)
    checkpoints = Checkpoints(tmp_path / "again" / "checkpoints")
    checkpoints.path(checkpoints.steps()[-1]).unlink()
    assert same_weights(run("cuda", **again, resume=True), whole)


@pytest.fixture(scope="module")
def models(untrained, tmp_path_factory):
    """models(device): a model with styles, another one, and one that follows a path."""
    kinds = {
        "styled": untrained(styles=("old", "angry"), droppable=("styles",)),
        "other": untrained(seed=1),
        "walker": untrained(path=True),
    }
    folder = tmp_path_factory.mktemp("models")
    for name, model in kinds.items():
        model.save(folder / name)
    walk = "time,x,z,heading\n0,0,0,0\n2,1,2,90\n"
    (folder / "walker" / "walk.csv").write_text(walk)

    def make(device: str) -> dict[str, gk.Model]:
        return {name: gk.load(folder / name, device=device) for name in kinds}

    return make


QUICK = {"steps": 4, "foot_lock": False}
FEW = {"seconds": 2.0, **QUICK}
MIXED = {"style": "old:0.25,angry:0.75", "guidance": 1.5}
REQUESTS = {
    "published": lambda of: of["styled"].generate(seconds=0.5, foot_lock=False, style="old"),
    "dpm": lambda of: of["other"].generate(**FEW),
    "ddim": lambda of: of["other"].generate(**FEW, solver="ddim"),
    "long": lambda of: of["other"].generate(**{**FEW, "seconds": 12.0}),
    "tiles": lambda of: replace(of["other"], window=40).generate(**FEW),
    "product": lambda of: of["styled"].generate(
        **FEW, **MIXED, experts=[(of["other"], "0.2@0-1,0.4@1-2")]
    ),
    "edit": lambda of: of["other"].generate(**FEW, like=of["other"].generate(**FEW), change=0.3),
    "path": lambda of: of["walker"].generate(path=of["walker"].folder / "walk.csv", **QUICK),
}


@pytest.mark.parametrize("name", REQUESTS)
def test_a_gpu_makes_the_motion_of_the_cpu(gpu, models, name):
    here, there = (REQUESTS[name](models(device)).positions() for device in ("cpu", "cuda"))
    # A tenth of a millimetre is less than any motion capture resolves.
    assert np.abs(here - there).max() < 1e-4
