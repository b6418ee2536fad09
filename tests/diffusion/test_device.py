"""Training and sampling on a GPU: the CPU's weights and motion, and the same ones again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from runs import apart, same_weights

import gesturekit as gk
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.training.data import TrainingData
from gesturekit.diffusion.training.trainer import train
from gesturekit.errors import ModelError
from gesturekit.training.run.checkpoint import Checkpoints

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


@pytest.mark.parametrize("kind", RUNS)
def test_a_gpu_trains_the_same_model_as_the_cpu(gpu, run, kind):
    assert apart(run("cuda", **RUNS[kind]), run("cpu", **RUNS[kind]))[-1] < 1e-3


def test_training_on_a_gpu_is_the_same_again_after_a_kill(gpu, run, tmp_path):
    # Dropout draws from the GPU's own generator.
    options = {**EVERYTHING, "network": {"dropout": 0.2}}
    whole = run("cuda", **options)
    again = {**options, "out": str(tmp_path / "again")}
    run("cuda", **again)
    checkpoints = Checkpoints(tmp_path / "again" / "checkpoints")
    checkpoints.path(checkpoints.steps()[-1]).unlink()
    assert same_weights(run("cuda", **again, resume=True), whole)


def test_bfloat16_trains_nearly_the_same(gpu, run):
    half = run("cuda", training={"precision": "bfloat16"})
    assert 0 < apart(half, run("cpu"))[-1] < 0.03


def test_features_are_extracted_on_the_gpu(gpu, make_config, write_wavlm, tmp_path, wavlm_devices):
    write_wavlm(tmp_path / "wavlm", seed=12)  # features of other tests' weights are in the cache
    encoder = {"extractors": [{"kind": "wavlm"}], "weights": str(tmp_path / "wavlm")}
    config = make_config(features=encoder, device="cuda")
    train(config)
    assert wavlm_devices == {"cuda"}
    data = TrainingData.load(config.out / "data", config, "cuda")
    assert data.conditions.conditioner.extractor.parts[0]._device.type == "cuda"


@pytest.fixture
def models(untrained, tmp_path):
    """models(device): a model with styles, another one, and one that follows a path."""
    kinds = {
        "styled": untrained(styles=("old", "angry"), droppable=("styles",)),
        "other": untrained(seed=1),
        "walker": untrained(path=True),
    }
    for name, model in kinds.items():
        model.save(tmp_path / name)
    walk = "time,x,z,heading\n0,0,0,0\n2,1,2,90\n"
    (tmp_path / "walker" / "walk.csv").write_text(walk)

    def make(device: str, **options) -> dict[str, gk.Model]:
        return {name: gk.load(tmp_path / name, device=device, **options) for name in kinds}

    return make


QUICK = {"steps": 4, "foot_lock": False}
FEW = {"seconds": 3.0, **QUICK}
MIXED = {"style": "old:0.25,angry:0.75", "guidance": 1.5}
REQUESTS = {
    "published": lambda of: of["styled"].generate(**{**FEW, "steps": None}, style="old"),
    "dpm": lambda of: of["other"].generate(**FEW),
    "ddim": lambda of: of["other"].generate(**FEW, solver="ddim"),
    "long": lambda of: of["other"].generate(**{**FEW, "seconds": 20.0}),
    "tiles": lambda of: replace(of["other"], window=60).generate(**FEW),
    "product": lambda of: of["styled"].generate(
        **FEW, **MIXED, experts=[(of["other"], "0.2@0-1.5,0.4@1.5-3")]
    ),
    "edit": lambda of: of["other"].generate(**FEW, like=of["other"].generate(**FEW), change=0.3),
    "path": lambda of: of["walker"].generate(path=of["walker"].folder / "walk.csv", **QUICK),
}


@pytest.mark.parametrize("name", REQUESTS)
def test_a_gpu_makes_the_motion_of_the_cpu(gpu, models, name):
    here, there = (REQUESTS[name](models(device)).positions() for device in ("cpu", "cuda"))
    # A tenth of a millimetre is less than any motion capture resolves.
    assert np.abs(here - there).max() < 1e-4


def test_bfloat16_on_a_gpu_is_that_of_the_cpu(gpu, models):
    here, there = (
        models(device, dtype="bf16")["other"].generate(**FEW).positions()
        for device in ("cpu", "cuda")
    )
    assert np.abs(here - there).max() < 0.02


@pytest.fixture
def spoken(make_config, write_speech, tmp_path) -> Path:
    """A folder with a model that takes speech, and four sounds."""
    train(make_config(out=str(tmp_path / "spoken"), device="cpu", training={"updates": 2}))
    for k, seconds in enumerate((1.0, 2.0, 3.0, 1.5)):
        write_speech(tmp_path / "sounds" / f"{k}.wav", seconds)
    return tmp_path


@pytest.fixture
def rendered(spoken, gesturekit):
    """rendered("out", *sounds, workers=2): motions made on a GPU, {name: bytes}; and errors."""

    def run(out: str, *sounds: Path, **options) -> tuple[dict[str, bytes], str]:
        command = (*sounds, "--model", spoken / "spoken", "--device", "cuda", "--steps", 3)
        more = [word for name, value in options.items() for word in (f"--{name}", value)]
        done = gesturekit("render", *command, "--out", spoken / out, "--format", "npz", *more)
        made = {path.name: path.read_bytes() for path in (spoken / out).glob("*.npz")}
        assert done.status == (0 if len(made) == len(sounds) else 1)
        return made, done.err

    return run


def test_other_sounds_do_not_change_a_result(gpu, spoken, rendered):
    sounds = sorted((spoken / "sounds").iterdir())
    whole, _ = rendered("whole", *sounds)
    assert len(whole) == 4 and rendered("last", sounds[-1])[0]["3.npz"] == whole["3.npz"]
    if gpu == "cuda":  # processes of their own cannot be simulated
        assert rendered("workers", *sounds, workers=2)[0] == whole


def test_a_gpu_whose_memory_runs_out_fails_one_sound(gpu, spoken, rendered, monkeypatch):
    sounds = sorted((spoken / "sounds").iterdir())
    (whole, _), own = rendered("whole", *sounds), Denoiser.for_condition

    def fail_on_long_ones(self, condition, steps):
        if condition.shape[1] >= 90:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return own(self, condition, steps)

    monkeypatch.setattr(Denoiser, "for_condition", fail_on_long_ones)
    del whole["2.npz"]
    made, said = rendered("fails", *sounds)
    assert made == whole and "2.wav: CUDA out of memory. Tried to allocate 2.00 GiB." in said


def test_models_on_two_devices_cannot_be_multiplied(gpu, models):
    experts = [(models("cuda")["other"], 0.5)]
    with pytest.raises(ModelError, match="expert 1: is on cuda:0, this model on cpu; load both"):
        models("cpu")["styled"].generate(**FEW, experts=experts)


def test_a_gpu_without_memory_is_named(gpu, models, run, monkeypatch):
    def fail(*args, **kwargs):
        raise torch.cuda.OutOfMemoryError(
            "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 1 GiB."
        )

    ran_out = r"memory ran out \(CUDA out of memory. Tried to allocate 2.00 GiB\); "
    monkeypatch.setattr(Denoiser, "to", fail)
    with pytest.raises(ModelError, match=rf"styled: the GPU's {ran_out}free it, or load .* cpu"):
        models("cuda")
    with pytest.raises(ModelError, match=rf"cuda.*: the GPU's {ran_out}set a smaller training.bat"):
        run("cuda")
