"""The cheap measures, for motion in memory: what a training looks at now and then."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gesturekit.evaluation.clip_metrics import Known, Measurer
from gesturekit.evaluation.clips import Clip
from gesturekit.evaluation.definitions import DEFINITIONS, MOVEMENT, PatchOptions
from gesturekit.evaluation.pairs import Pair
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints

_NAMELESS = Pair("clip", "clip", None, Path("clip"), Path("clip"))


def quick_metrics(generated: Sequence[Motion], recordings: Sequence[Motion]) -> dict[str, float]:
    """Means of the cheap measures (`cheap` in `definitions`), to be read beside a loss.

    Measures whose goal is the recording's own figure are given as a ratio to it, `KEY_ratio`; 1 is
    as the recording. A measure that cannot be taken of any clip is left out.

    Args:
        generated: motions of one rig.
        recordings: as many, of the same rig and frame rate.
    """
    measurer = Measurer(Known(), (MOVEMENT,), PatchOptions())
    every: dict[str, list[float]] = {}
    for motion, recording in zip(generated, recordings, strict=True):
        clip = Clip(_NAMELESS, motion, recording, body_joints(recording.skeleton), None, ())
        own = measurer.recording(clip)[0]
        for key, value in measurer.figures(clip)[0].items():
            if not DEFINITIONS[key].cheap:
                continue
            if DEFINITIONS[key].better != "reference":
                every.setdefault(key, []).append(value)
            elif own.get(key):
                every.setdefault(f"{key}_ratio", []).append(value / own[key])
    return {key: float(np.mean(values)) for key, values in every.items()}
