"""Recipes of which training takes a second, and a model trained by one."""

from pathlib import Path

import pytest

from gesturekit.cli import main
from gesturekit.training.recipes import recipe_table

RECIPES = Path(__file__).resolve().parents[2] / "recipes"
LIGHT = RECIPES / "multires_speech" / "light.yaml"
SMALL = RECIPES / "diffusion_speech" / "small.yaml"
DEBUG = recipe_table()["debug"]
TINY = (
    *DEBUG["multires"],
    "fps=25",
    "network.levels=6",
    "training.discriminator_steps=1",
)
TINY_DIFFUSION = (*DEBUG["diffusion"], "noise.steps=8", "training.updates=6")
TINY_DIFFUSION += ("features.extractors=[{kind: logmel}]",)


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
        main(["train", str(LIGHT), f"corpus={corpus}", f"out={run}", *TINY])
    assert left.value.code == 0
    return run / "model"
