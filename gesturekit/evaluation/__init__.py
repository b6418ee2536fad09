"""How good a motion is, in numbers. Knows motions and sounds, never models."""

from __future__ import annotations

import importlib
from typing import Any

# No module may be called like a public function: importing it would hide the function.
_HOMES = {
    "BeatResult": "rhythm",
    "Evaluation": "results",
    "FeatureModel": "feature_model",
    "FrechetResult": "frechet",
    "Items": "pairs",
    "JointLimits": "limits",
    "PatchOptions": "definitions",
    "PatchScores": "patches",
    "PoseWindows": "poses",
    "SpeedHistogram": "distributions",
    "SyncResult": "listening",
    "acceleration": "physical",
    "arm_speed": "physical",
    "arm_speed_ratio": "physical",
    "beat_alignment": "rhythm",
    "beat_consistency": "rhythm",
    "cca": "likeness",
    "coverage": "patches",
    "div_g": "frechet",
    "div_k": "frechet",
    "evaluate": "comparison",
    "fgd": "frechet",
    "fid_g": "frechet",
    "fid_k": "frechet",
    "floor_penetration": "feet",
    "foot_skate": "feet",
    "frechet_distance": "frechet",
    "frechet_result": "frechet",
    "geometric_features": "clip_features",
    "global_diversity": "patches",
    "hellinger": "distributions",
    "inter_diversity": "patches",
    "intra_diversity": "patches",
    "jerk": "physical",
    "jerk_ratio": "physical",
    "joint_limit_share": "limits",
    "joint_speed": "physical",
    "kinetic_features": "clip_features",
    "l1_diversity": "likeness",
    "local_diversity": "patches",
    "max_speed": "physical",
    "motion_beats": "rhythm",
    "music_beats": "rhythm",
    "patch_features": "patches",
    "patch_scores": "patches",
    "raw_fgd": "frechet",
    "root_relative": "likeness",
    "speech_envelope": "listening",
    "speech_onsets": "rhythm",
    "srgr": "likeness",
    "standing_heights": "feet",
    "sync": "listening",
    "wrist_speed": "physical",
    "write_report": "report",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
