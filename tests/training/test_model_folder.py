"""A model's folder, whatever the system: what is written is read, and what is wrong is named."""

import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import audio_features as af
import gesturekit as gk
from gesturekit.errors import ConfigError, ModelError
from gesturekit.training.model_folder import (
    ModelParts,
    TrainedModel,
    load_parts,
    model_digest,
    save_model,
)
from gesturekit.training.origin import check_conditions

CONFIG = {"kind": "puppet", "fps": 25, "recorded_fps": 50, "smooth": None, "styles": ["a", "b"]}
RIG = {"names": ["Hips"], "height": 1.5, "speakers": {}}
TENSORS = {"net.weight": torch.arange(6.0).reshape(2, 3), "mean": torch.ones(2)}


@pytest.fixture
def folder(tmp_path) -> Path:
    save_model(tmp_path / "model", CONFIG, RIG, TENSORS, "A puppet.\n")
    return tmp_path / "model"


class Puppet(TrainedModel):
    """A model whose own fields are not read but made, or fail."""

    kind = "puppet"
    skeleton = None
    make: Callable[[ModelParts], Any]

    @classmethod
    def _fields(cls, parts, weights, device, dtype):
        cls.make(parts)
        fields = dict.fromkeys(("representation", "conditions", "normaliser"))
        return fields | {"network": torch.nn.Identity()}

    _measured_state = _contents = _readme = None


@pytest.fixture
def load(folder, skeleton, monkeypatch) -> Callable[..., Any]:
    """load(make=...): the model of the folder; `make` gets its parts, and may fail."""

    def read(make: Callable[[ModelParts], Any] = lambda parts: None) -> Any:
        monkeypatch.setattr(Puppet, "skeleton", skeleton)
        monkeypatch.setattr(Puppet, "make", staticmethod(make), raising=False)
        return Puppet.load(folder)

    return read


def test_a_loaded_model_has_the_fingerprint_of_its_parts_and_sees_new_weights(tmp_path):
    """A copy is not known to be of a folder: all its parts are gone through."""
    model = gk.load("demo")
    first = model.fingerprint()
    assert first == replace(model).fingerprint() == gk.load("demo").fingerprint()
    model.save(tmp_path)  # in single precision; the demo is stored in half
    assert gk.load(tmp_path).fingerprint() == first
    with torch.no_grad():
        next(model.network.parameters()).add_(1)
    assert first != model.fingerprint() == replace(model).fingerprint()


def test_what_is_written_is_read(folder, load, caplog):
    model, parts = load(), load_parts(folder, "puppet")
    assert (model.fps, model.recorded_fps, model.smooth) == (25, 50, None)
    assert parts.folder == folder and CONFIG.items() <= parts.config.items() and parts.rig == RIG
    assert (
        set(parts.tensors) == set(TENSORS) and (folder / "README.md").read_text() == "A puppet.\n"
    )
    (weight,) = parts.tensors_under("net.").items()
    assert weight[0] == "weight" and torch.equal(weight[1], TENSORS["net.weight"])
    assert not caplog.messages


def pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def edit(file: Path, **changes: Any) -> None:
    values = json.loads(file.read_text()) if file.suffix == ".json" else {"format": 1, **CONFIG}
    file.write_text(json.dumps(values | changes))


@pytest.mark.parametrize(
    ("harm", "says"),
    [
        (lambda f: (f / "config.yaml").unlink(), "model/config.yaml"),
        (lambda f: (f / "model.safetensors").unlink(), "model & model.safetensors"),
        (lambda f: (f / "skeleton.json").write_text("{"), "skeleton.json & line 1"),
        (lambda f: (f / "model.safetensors").write_bytes(b"1"), "model.safetensors"),
        (lambda f: edit(f / "config.yaml", format=2), "format 2 & format 1"),
        (lambda f: edit(f / "config.yaml", kind="x"), "config.yaml & 'x' & puppet"),
        (lambda f: edit(f / "config.yaml", fps=0), r"model & fps & 0\.0"),
        (lambda f: pipe(f / "model.safetensors"), "model.safetensors"),
        (
            lambda f: (f / "model.safetensors").write_bytes((5 << 20).to_bytes(8, "little")),
            "model.safetensors & 5242880",
        ),
    ],
)
def test_damage_is_named(folder, load, harm, says):
    harm(folder)
    with pytest.raises(ModelError) as caught:
        load()
    assert all(re.search(fact, str(caught.value)) for fact in says.split(" & "))


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (af.FeatureError("no kind"), "model/config.yaml & no kind"),
        (ModelError("as it is"), "^as it is$"),
        (KeyError("noise"), "model & noise"),
        (RuntimeError("one\n\ttwo\n\tthree"), "model & one +two"),
        (PermissionError(13, "Permission denied", "/a/b.npz"), "b.npz & Permission"),
        (MemoryError(), "MemoryError"),
        (
            torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to get 2 GiB. GPU 0 has. More"),
            "GPU & 2 GiB",
        ),
    ],
)
def test_what_fails_while_a_model_is_made_is_one_line(load, error, says):
    def fail(parts: ModelParts) -> None:
        raise error

    with pytest.raises((ModelError, af.WeightsError)) as caught:
        load(fail)
    assert all(re.search(fact, str(caught.value)) for fact in says.split(" & "))
    assert "\n" not in str(caught.value)


def test_a_digest_follows_all_that_is_written_but_the_readme():
    known = model_digest(CONFIG, RIG, TENSORS)
    turned = dict(reversed(TENSORS.items()))
    assert model_digest(CONFIG, RIG, turned) == known
    weight = TENSORS["net.weight"]
    others = [
        model_digest(CONFIG | {"fps": 30}, RIG, TENSORS),
        model_digest(CONFIG, RIG | {"height": 1.6}, TENSORS),
        *(
            model_digest(CONFIG, RIG, TENSORS | {"net.weight": changed})
            for changed in (weight + 1, weight.reshape(3, 2), weight.view(torch.int32), weight.T)
        ),
        model_digest(CONFIG, RIG, {"net.bias": weight, "mean": TENSORS["mean"]}),
    ]
    assert len({known, *others}) == len(others) + 1


@pytest.mark.parametrize(
    ("wanted", "fits"),
    [
        ({"styles": ["b", "a"]}, True),
        ({"styles": ["a", "c"]}, False),
        ({"events": []}, True),
        ({"events": ["kick"]}, False),
        ({"path": True}, False),
        ({"features": [{"kind": "mfcc"}]}, False),
    ],
)
def test_a_corpus_may_lack_some_of_a_models_styles_and_events_but_not_all(wanted, fits):
    known = {"styles": ["a", "b"], "events": [], "path": False, "features": None, "more": 1}
    if fits:
        check_conditions(Path("m"), known, wanted)
        return
    (name,) = wanted
    with pytest.raises(ConfigError, match=rf"(?=.*start_from)(?=.*\bm\b)(?=.*{name})"):
        check_conditions(Path("m"), known, wanted)
