"""A motion at another frame rate."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import slerp


def resample_motion(motion: Motion, fps: float, n_frames: int | None = None) -> Motion:
    """Frame k of the result is the motion at k / fps seconds; past its last frame it stands still.

    Rotations go along the shorter arc, places along straight lines. Nothing is filtered.

    Args:
        motion: what to resample.
        fps: frames per second of the result.
        n_frames: how many; by default as many as the duration holds, floor(duration fps + 1/2).

    Raises:
        MotionError: fps is not positive, or no frame is asked for.
    """
    if not (math.isfinite(fps) and fps > 0):
        raise MotionError(f"fps is {fps!r}; expected a positive number")
    if n_frames is None:
        exact = motion.n_frames * Fraction(fps) / Fraction(motion.fps)
        n_frames = max(1, math.floor(exact + Fraction(1, 2)))
    if n_frames < 1:
        raise MotionError(f"n_frames is {n_frames}; a motion needs at least one frame")
    last = motion.n_frames - 1
    if fps == motion.fps:
        low = high = np.minimum(np.arange(n_frames), last)
        weight = np.zeros(n_frames)
    else:
        place = np.minimum(np.arange(n_frames) * (motion.fps / fps), last)
        low = np.floor(place).astype(np.int64)
        high = np.minimum(low + 1, last)
        weight = place - low

    def between(values: np.ndarray) -> np.ndarray:
        return values[low] + weight[:, None] * (values[high] - values[low])

    return replace(
        motion,
        rotations=slerp(motion.rotations[low], motion.rotations[high], weight[:, None]),
        translation=between(motion.translation),
        fps=fps,
        joint_translations={k: between(v) for k, v in motion.joint_translations.items()},
        expressions=None if motion.expressions is None else between(motion.expressions),
        info=dict(motion.info),
    )
