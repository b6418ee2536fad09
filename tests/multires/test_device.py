"""Training on a GPU: every kind of run gives the CPU's weights, and the same ones again."""

import logging
import re
import shutil

import pytest
from runs import apart, cut_off, same_weights

from gesturekit.errors import ModelError
from gesturekit.multires import train

SHORT = {"first_stage": 1, "further_stages": 1}
STYLES = {"features": None, "styles": {}, "network": {"levels": 3, "modulate": "all"}}
RUNS = {
    "speech": {
        "network": {"levels": 2},
        "losses": {"arm_acceleration": 1.0, "coarse": 1.0},
        "training": {"margins": True, "first_stage": 2, "window": 1.0},
    },
    "styles": {
        **STYLES,
        "losses": {"detail": 1.0, "rec_input": "real", "penalty_on": "frame"},
        "training": {"window": None},
        "z_star_shuffle": 2,
    },
}


@pytest.fixture
def run(make_config, motions, tmp_path):
    """run(kind, device, resume=False): the folder of a short training of a kind of `RUNS`."""
    styled = str(motions(old=[3.0], angry=[4.0]))

    def make(kind: str, device: str, *, resume: bool = False, **changes):
        own = {"out": str(tmp_path / device), "backend": "torch", **RUNS[kind], **changes}
        own["training"] = {**SHORT, **own["training"]}
        own |= {"corpus": styled} if "styles" in own else {}
        return train(make_config(device=device, **own), resume=resume)

    return make


@pytest.mark.parametrize("kind", ["speech", pytest.param("styles", marks=pytest.mark.stress)])
def test_a_gpu_trains_the_same_model_as_the_cpu_and_again_after_a_kill(gpu, run, kind, tmp_path):
    changes = {"eval_every": 2 if kind == "styles" else 0, "checkpoint_every": 1}
    whole = run(kind, "cuda", **changes)
    # Adam makes whole steps of what rounding leaves of a gradient that is nearly zero.
    assert max(apart(whole, run(kind, "cpu"))) < 5e-3
    kept = shutil.copytree(whole, tmp_path / "kept")
    cut_off(whole.parent, 2)
    assert same_weights(run(kind, "cuda", **changes, resume=True), kept)


@pytest.mark.stress
def test_bfloat16_is_near_single_precision(gpu, run):
    half = apart(run("speech", "cuda", precision="bfloat16"), run("speech", "cpu"))
    assert 0 < half[-1] < 0.03


def test_a_gpu_extracts_features_and_trains_by_torch(
    gpu, make_config, write_wavlm, tmp_path, wavlm_devices, caplog
):
    caplog.set_level(logging.INFO)
    write_wavlm(tmp_path / "wavlm", seed=11)  # features of other tests' weights are in the cache
    encoder = {"extractors": [{"kind": "wavlm"}], "weights": str(tmp_path / "wavlm")}
    changes = {"device": "cuda", "training": SHORT, "network": {"levels": 2}}
    train(make_config(**changes, features=encoder))
    assert wavlm_devices == {"cuda"}
    assert re.search(r"(?i)backend\W+torch", caplog.text) and "float32" in caplog.text


def test_the_numba_engine_is_not_for_a_gpu(gpu, make_config):
    with pytest.raises(ModelError, match="(?=.*numba)(?=.*cuda)"):
        train(make_config(device="cuda", backend="numba", features=None, network={"levels": 2}))
