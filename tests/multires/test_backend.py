"""Choice of the backend: what is asked for, what is refused, what auto falls back to."""

import logging
import re
import sys

import pytest
import torch
from runs import weights

import gesturekit as gk
from gesturekit.diagnosis import diagnose
from gesturekit.errors import ConfigError, ModelError
from gesturekit.multires import (
    LevelDiscriminator,
    MultiresGenerator,
    MultiresRepresentation,
    NetworkConfig,
    choose_backend,
    train,
)
from gesturekit.multires.backend import VARIABLE, requested_backend
from gesturekit.multires.networks import SkeletonConv1d

ENGINE = "gesturekit.multires.cpu.engine"
LAYER = torch.nn.Conv1d(1, 1, 1)


@pytest.fixture
def engine(monkeypatch):
    """The engine, whatever backend these tests run with."""
    monkeypatch.delenv(VARIABLE, raising=False)
    return pytest.importorskip(ENGINE, reason="the CPU engine is absent")


@pytest.fixture
def networks(gesture):
    representation = MultiresRepresentation.fit([gesture(1.0)])
    config = NetworkConfig(levels=2, channels=(2, 2), embedding=4)
    torch.manual_seed(0)
    return MultiresGenerator(representation, 3, config), LevelDiscriminator(representation, config)


class Deeper(LevelDiscriminator):
    """A changed discriminator, which the engine does not know."""


WIDE = torch.ones(1, 1).bool().numpy(), [2], [2], 7


class OtherConv(SkeletonConv1d):
    """A changed convolution."""


def test_the_environment_goes_before_the_configuration(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    assert requested_backend() == "auto" and requested_backend("torch") == "torch"
    monkeypatch.setenv(VARIABLE, "torch")
    assert requested_backend("numba") == "torch"
    monkeypatch.setenv(VARIABLE, "jax")
    with pytest.raises(ConfigError, match=f"(?=.*{VARIABLE})(?=.*'jax')(?=.*numba)"):
        requested_backend()


def test_a_wrong_backend_in_the_environment_stops_before_the_first_file(make_config, monkeypatch):
    demo, config = gk.load("demo"), make_config()
    monkeypatch.setenv(VARIABLE, "jax")
    for begin in (demo.check_controls, lambda: train(config)):
        with pytest.raises(ConfigError, match=f"(?=.*{VARIABLE})(?=.*'jax')"):
            begin()
    assert not (config.out / "config.yaml").exists()
    found = {finding.name: finding for finding in diagnose()}
    assert found["demo model"].state == "broken" and not found["demo model"].advice


def test_auto_takes_numba_for_the_networks_as_they_are(engine, networks):
    assert choose_backend("auto", *networks).name == "numba"
    assert choose_backend("numba", *networks).name == "numba"
    assert choose_backend("torch", *networks).name == "torch"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (
            lambda g, d: g.levels[0].films[0].add_module("extra", LAYER),
            r"(?=.*levels\.0\.films\.0)(?=.*extra)",
        ),
        (
            lambda g, d: setattr(g.levels[1].layers[0], "__class__", OtherConv),
            r"(?=.*OtherConv)(?=.*levels\.1\.layers\.0)",
        ),
        (lambda g, d: setattr(d.layers[0], "forward", abs), r"(?=.*layers\.0)(?=.*forward)"),
        (lambda g, d: d.register_forward_hook(print), "(?=.*LevelDiscriminator)(?=.*hook)"),
        (lambda g, d: g.double(), "float64"),
        (lambda g, d: setattr(d, "__class__", Deeper), "Deeper"),
        (lambda g, d: g.levels[0].layers.append(SkeletonConv1d(*WIDE)), "7 frames"),
    ],
)
def test_numba_refuses_unsupported_modules(engine, networks, change, named):
    change(*networks)
    with pytest.raises(ModelError, match=named):
        choose_backend("numba", *networks)
    for network in networks:
        network.eval()
    backend = choose_backend("auto", *networks)
    assert backend.name == "torch" and re.search(named, backend.reason)


@pytest.mark.parametrize("modes", [("train", "eval"), ("eval", "train")])
def test_networks_that_train_are_examined_each_time(engine, networks, modes):
    before, after = modes
    for network in networks:
        getattr(network, before)()
    assert choose_backend("numba", *networks).name == "numba"
    networks[1].register_forward_hook(print)
    for network in networks:
        getattr(network, after)()
    with pytest.raises(ModelError, match="(?=.*LevelDiscriminator)(?=.*hook)"):
        choose_backend("numba", *networks)


def test_without_the_engine_auto_falls_back_and_numba_is_an_error(networks, monkeypatch):
    monkeypatch.setitem(sys.modules, ENGINE, None)
    backend = choose_backend("auto", *networks)
    assert backend.name == "torch" and ENGINE in backend.reason
    with pytest.raises(ModelError, match=ENGINE):
        choose_backend("numba", *networks)


def test_torch_trains_and_generates_as_numba(engine, make_config, tmp_path, caplog, monkeypatch):
    short = {
        "training": {"first_stage": 1, "learning_rate": 1e-5, "window": 1.0},
        "network": {"levels": 2},
    }
    folders, motions = {}, {}
    for name in ("numba", "torch"):
        with caplog.at_level(logging.INFO):
            folders[name] = train(make_config(**short, backend=name, out=str(tmp_path / name)))
        assert re.search(rf"(?i)backend\W+{name}\b", caplog.text)
        caplog.clear()
        model = gk.load(folders["numba"])
        monkeypatch.setenv(VARIABLE, name)
        motions[name] = model.generate(seconds=2.0, seed=3)
        monkeypatch.delenv(VARIABLE)
    made, other = (weights(folder) for folder in folders.values())
    # Adam's first steps have the sign of the gradient: a weight whose gradient is about zero may
    # move the other way, by a learning rate each step.
    for key in made:
        torch.testing.assert_close(made[key], other[key], rtol=0, atol=1e-4)
    one, two = (torch.from_numpy(motion.rotations) for motion in motions.values())
    torch.testing.assert_close(one, two, rtol=0, atol=1e-5)
