"""A pyramid of few channels, on the corpus of seconds: a run takes seconds too."""

from __future__ import annotations

import pytest

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


@pytest.fixture
def make_config(corpus, tmp_path):
    """make_config(schedule={"batch": 1}, ...): the small configuration with changes."""

    def make(**changes) -> MultiresConfig:
        values = {**SMALL, "corpus": str(corpus), "out": str(tmp_path / "run")}
        for key, value in changes.items():
            values[key] = {**values.get(key, {}), **value} if isinstance(value, dict) else value
        return build(MultiresConfig, values)

    return make
