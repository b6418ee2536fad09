"""A model whose motion is of no use, but is motion."""

import pytest
from small_runs import small_config

import gesturekit as gk
from gesturekit.corpus import prepare
from gesturekit.multires import train


@pytest.fixture(scope="session")
def model(tmp_path_factory, write_pair):
    """Two iterations for each of two pairs of levels, at 25 fps."""
    folder = tmp_path_factory.mktemp("rendering")
    write_pair(folder / "paired", "a", 3.0, fps=25.0)
    prepare([folder / "paired"], folder / "corpus.jsonl", holdout=0.0)
    short = {"fps": 25, "training": {"first_stage": 2, "further_stages": 2, "window": 2.0}}
    return gk.load(train(small_config(folder / "corpus.jsonl", folder / "run", short)))
