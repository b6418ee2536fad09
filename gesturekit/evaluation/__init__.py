"""Evaluation of motion: metrics and the report. Independent of models."""

from __future__ import annotations

import importlib
from typing import Any

# No module may be called like a public function: importing it would hide the function.
_MODULES = {
    "BeatResult": "metrics.rhythm",
    "Evaluation": "results",
    "FeatureModel": "metrics.frechet.feature_model",
    "FrechetResult": "metrics.frechet.frechet",
    "Items": "pairs",
    "JointLimits": "metrics.joint_limits",
    "PatchOptions": "definitions",
    "PatchScores": "metrics.patches",
    "PoseWindows": "metrics.frechet.poses",
    "SpeedHistogram": "metrics.distributions",
    "SyncResult": "metrics.sync",
    "acceleration": "metrics.physical",
    "arm_speed": "metrics.physical",
    "arm_speed_ratio": "metrics.physical",
    "beat_alignment": "metrics.rhythm",
    "beat_consistency": "metrics.rhythm",
    "cca": "metrics.similarity",
    "coverage": "metrics.patches",
    "div_g": "metrics.frechet.frechet",
    "div_k": "metrics.frechet.frechet",
    "evaluate": "comparison",
    "fgd": "metrics.frechet.frechet",
    "fid_g": "metrics.frechet.frechet",
    "fid_k": "metrics.frechet.frechet",
    "floor_penetration": "metrics.feet",
    "foot_skate": "metrics.feet",
    "frechet_distance": "metrics.frechet.frechet",
    "frechet_result": "metrics.frechet.frechet",
    "geometric_features": "metrics.frechet.clip_features",
    "global_diversity": "metrics.patches",
    "hellinger": "metrics.distributions",
    "inter_diversity": "metrics.patches",
    "intra_diversity": "metrics.patches",
    "jerk": "metrics.physical",
    "jerk_ratio": "metrics.physical",
    "joint_limit_share": "metrics.joint_limits",
    "joint_speed": "metrics.physical",
    "kinetic_features": "metrics.frechet.clip_features",
    "l1_diversity": "metrics.similarity",
    "local_diversity": "metrics.patches",
    "max_speed": "metrics.physical",
    "motion_beats": "metrics.rhythm",
    "music_beats": "metrics.rhythm",
    "patch_features": "metrics.patches",
    "patch_scores": "metrics.patches",
    "raw_fgd": "metrics.frechet.frechet",
    "root_relative": "metrics.similarity",
    "speech_envelope": "metrics.sync",
    "speech_onsets": "metrics.rhythm",
    "srgr": "metrics.similarity",
    "standing_heights": "metrics.feet",
    "sync": "metrics.sync",
    "wrist_speed": "metrics.physical",
    "write_report": "report.page",
}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
