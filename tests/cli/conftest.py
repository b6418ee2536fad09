"""The command line run within the test, and a model trained by it."""

from __future__ import annotations

from pathlib import Path

import pytest

from gesturekit.cli import main

LIGHT = Path(__file__).resolve().parents[2] / "recipes" / "multires_speech" / "light.yaml"
TINY = (
    "fps=25",
    "threads=1",
    "network.levels=6",
    "network.channels=[2,2,2]",
    "network.embedding=4",
    "training.first_stage=2",
    "training.further_stages=2",
    "training.discriminator_steps=1",
    "training.reconstruction_steps=1",
    "training.batch=2",
    "training.window=2",
    "training.window_cache=2",
)

SMALL = LIGHT.parents[1] / "diffusion_speech" / "small.yaml"
TINY_DIFFUSION = (
    "threads=1",
    "network.blocks=1",
    "network.layers=1",
    "network.channels=8",
    "network.heads=2",
    "network.feedforward=8",
    "network.embedding=8",
    "noise.steps=8",
    "training.updates=6",
    "training.batch=2",
    "training.window=2",
    "features.extractors=[{kind: logmel}]",
)


@pytest.fixture(scope="session")
def tiny() -> tuple[str, ...]:
    """Overrides that make any multires recipe a matter of a second."""
    return TINY


@pytest.fixture(scope="session")
def light() -> Path:
    """The recipe that asks for no weights."""
    return LIGHT


@pytest.fixture(params=["multires", "diffusion"])
def recipe(request) -> tuple[object, ...]:
    """A recipe of each system that asks for no weights, and overrides that make it tiny."""
    return (LIGHT, *TINY) if request.param == "multires" else (SMALL, *TINY_DIFFUSION)


@pytest.fixture(scope="session")
def model(corpus, tmp_path_factory) -> Path:
    """A model folder, by `gesturekit train`; its motion is of no use, but it is motion."""
    run = tmp_path_factory.mktemp("runs") / "tiny"
    with pytest.raises(SystemExit) as left:
        # Its finest level is the sixth, which the recipe would recall.
        main(["train", str(LIGHT), f"corpus={corpus}", f"out={run}", *TINY, "recall.level=2"])
    assert left.value.code == 0
    return run / "model"
