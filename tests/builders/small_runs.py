"""Settings of trainings of the multires system that take seconds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gesturekit.multires.config import MultiresConfig
from gesturekit.training.config import build

SMALL: dict[str, Any] = {
    "system": "multires",
    "threads": 1,
    "network": {"levels": 4, "channels": [2, 2, 2], "embedding": 8},
    "training": {
        "first_stage": 6,
        "further_stages": 4,
        "discriminator_steps": 1,
        "batch": 2,
        "window": 3.0,
        "window_cache": 4,
        "renew_every": 3,
        "learning_rate": 1e-3,
    },
    "checkpoint_every": 5,
    "log_every": 2,
}


def small_config(corpus: Path | str, out: Path | str, *changes: dict[str, Any]) -> MultiresConfig:
    """Return the settings of a small run; later changes go before earlier ones, key by key."""
    values: dict[str, Any] = {}
    for layer in (SMALL, {"corpus": str(corpus), "out": str(out)}, *changes):
        for key, value in layer.items():
            both = isinstance(value, dict)
            values[key] = {**(values.get(key) or {}), **value} if both else value
    return build(MultiresConfig, values)
