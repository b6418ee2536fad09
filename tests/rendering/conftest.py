"""A model whose motion is of no use, but is motion."""

from __future__ import annotations

import pytest

import gesturekit as gk
from gesturekit.corpus import prepare
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.training.trainer import train
from gesturekit.training.config import build


@pytest.fixture(scope="session")
def model(tmp_path_factory, write_pair):
    """Two iterations for each of two pairs of levels, at 25 fps."""
    folder = tmp_path_factory.mktemp("rendering")
    write_pair(folder / "paired", "a", 3.0, fps=25.0)
    prepare([folder / "paired"], folder / "corpus.jsonl", holdout=0.0)
    values = {
        "system": "multires",
        "corpus": str(folder / "corpus.jsonl"),
        "out": str(folder / "run"),
        "fps": 25,
        "threads": 1,
        "network": {"levels": 4, "channels": [2, 2, 2], "embedding": 4},
        "training": {
            "first_stage": 2,
            "further_stages": 2,
            "batch": 2,
            "window": 2.0,
            "window_cache": 2,
        },
    }
    return gk.load(train(build(MultiresConfig, values)))
