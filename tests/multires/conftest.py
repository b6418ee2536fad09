"""A corpus of seconds and a pyramid of few channels: a run takes seconds too."""

from __future__ import annotations

from pathlib import Path

import pytest

from gesturekit.corpus import prepare
from gesturekit.multires.config import MultiresConfig
from gesturekit.training.config import build

SMALL = {
    "system": "multires",
    "threads": 1,
    "network": {"levels": 4, "channels": [2, 2, 2], "embedding": 8},
    "schedule": {
        "first_pair": 6,
        "further_pairs": 4,
        "discriminator_steps": 1,
        "batch": 2,
        "window": 3.0,
        "bank": 4,
        "renew": 3,
        "learning_rate": 1e-3,
    },
    "checkpoint_every": 5,
    "log_every": 2,
}


@pytest.fixture(scope="session")
def corpus(tmp_path_factory, write_pair, write_speech) -> Path:
    """Two recordings of different lengths, and unpaired speech."""
    folder = tmp_path_factory.mktemp("corpus")
    write_pair(folder / "paired", "a", 6.0, seed=1)
    write_pair(folder / "paired", "b", 2.5, seed=2)
    write_speech(folder / "more" / "c.wav", 5.0, level=0.1)
    manifest = folder / "corpus.jsonl"
    prepare([folder / "paired"], manifest, unpaired=[folder / "more"], holdout=0.0)
    return manifest


@pytest.fixture
def make_config(corpus, tmp_path):
    """make_config(schedule={"batch": 1}, ...): the small configuration with changes."""

    def make(**changes) -> MultiresConfig:
        values = {**SMALL, "corpus": str(corpus), "out": str(tmp_path / "run")}
        for key, value in changes.items():
            values[key] = {**values.get(key, {}), **value} if isinstance(value, dict) else value
        return build(MultiresConfig, values)

    return make
