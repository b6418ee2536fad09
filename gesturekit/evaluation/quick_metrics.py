"""Cheap metrics of motion in memory, computed at intervals during training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gesturekit.evaluation.clip_metrics import ClipMetrics, ReferenceStatistics
from gesturekit.evaluation.clips import Clip
from gesturekit.evaluation.definitions import DEFINITIONS, MOVEMENT, Variants
from gesturekit.evaluation.pairs import Pair
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints

_NAMELESS = Pair("clip", "clip", None, Path("clip"), Path("clip"))


def quick_metrics(generated: Sequence[Motion], recordings: Sequence[Motion]) -> dict[str, float]:
    """Return means over clips of the cheap metrics (`cheap` in `definitions`).

    A metric whose goal is the recording's value is given as its ratio to that value, `KEY_ratio`;
    1 equals the recording. A metric that fails for all clips is left out.

    Args:
        generated: motions of one rig.
        recordings: the same number of motions, of the same rig and frame rate.
    """
    measure = ClipMetrics(ReferenceStatistics(), (MOVEMENT,), Variants())
    every: dict[str, list[float]] = {}
    for motion, recording in zip(generated, recordings, strict=True):
        clip = Clip(_NAMELESS, motion, recording, body_joints(recording.skeleton), None, ())
        own = measure.recording(clip)[0]
        for key, value in measure.generated(clip)[0].items():
            if not DEFINITIONS[key].cheap:
                continue
            if DEFINITIONS[key].better != "reference":
                every.setdefault(key, []).append(value)
            elif own.get(key):
                every.setdefault(f"{key}_ratio", []).append(value / own[key])
    return {key: float(np.mean(values)) for key, values in every.items()}
