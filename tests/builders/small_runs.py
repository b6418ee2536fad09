"""Settings of trainings of both systems that take seconds."""

from pathlib import Path
from typing import Any

from gesturekit.diffusion import DiffusionConfig
from gesturekit.multires import MultiresConfig
from gesturekit.training.config import build

SMALL: dict[str, dict[str, Any]] = {
    "multires": {
        "system": "multires",
        "threads": 1,
        "measure": False,
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
    },
    "diffusion": {
        "system": "diffusion",
        "threads": 1,
        "measure": False,
        "network": {
            "blocks": 2,
            "layers": 1,
            "channels": 16,
            "heads": 2,
            "feedforward": 16,
            "embedding": 16,
        },
        "noise": {"steps": 8, "last_beta": 0.5},
        "training": {"updates": 6, "batch": 4, "window": 2.0, "warm_up": 2, "learning_rate": 1e-3},
        "checkpoint_every": 3,
        "log_every": 2,
    },
}


def small_values(
    system: str, corpus: Path | str, out: Path | str, *changes: dict[str, Any]
) -> dict[str, Any]:
    """Return the settings of a small run; later changes go before earlier ones, key by key."""
    values: dict[str, Any] = {}
    for layer in (SMALL[system], {"corpus": str(corpus), "out": str(out)}, *changes):
        for key, value in layer.items():
            both = isinstance(value, dict)
            values[key] = {**(values.get(key) or {}), **value} if both else value
    return values


def small_config(corpus: Path | str, out: Path | str, *changes: dict[str, Any]) -> MultiresConfig:
    """Return the configuration of a small run of the multires system."""
    return build(MultiresConfig, small_values("multires", corpus, out, *changes))


def small_diffusion(
    corpus: Path | str, out: Path | str, *changes: dict[str, Any]
) -> DiffusionConfig:
    """Return the configuration of a small run of the diffusion system."""
    return build(DiffusionConfig, small_values("diffusion", corpus, out, *changes))
