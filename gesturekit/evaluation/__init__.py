"""How good a motion is, in numbers. Knows motions and sounds, never models."""

from __future__ import annotations

import importlib
from typing import Any

# No module may be called like a public function: importing it would hide the function.
_HOMES = {
    "FeatureModel": "feature_model",
    "FrechetResult": "frechet",
    "PatchScores": "patches",
    "PoseWindows": "poses",
    "SyncResult": "listening",
    "arm_speed": "physical",
    "arm_speed_ratio": "physical",
    "coverage": "patches",
    "div_g": "frechet",
    "div_k": "frechet",
    "fgd": "frechet",
    "fid_g": "frechet",
    "fid_k": "frechet",
    "frechet_distance": "frechet",
    "frechet_result": "frechet",
    "geometric_features": "clip_features",
    "global_diversity": "patches",
    "inter_diversity": "patches",
    "intra_diversity": "patches",
    "jerk": "physical",
    "jerk_ratio": "physical",
    "kinetic_features": "clip_features",
    "local_diversity": "patches",
    "max_speed": "physical",
    "patch_features": "patches",
    "patch_scores": "patches",
    "raw_fgd": "frechet",
    "speech_envelope": "listening",
    "sync": "listening",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
