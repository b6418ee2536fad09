"""A motion at another frame rate."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.motion import Motion, checked_fps
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
    slerp,
)

_MOST_ROTATIONS = 250_000_000  # 8 GB of them; ten hours of 75 joints at 60 fps are 162 million


def resample_motion(
    motion: Motion, fps: float, n_frames: int | None = None, antialias: bool = False
) -> Motion:
    """Frame k of the result is the motion at k / fps seconds; past its last frame it stands still.

    Rotations go along the shorter arc, places along straight lines.

    Args:
        motion: what to resample.
        fps: frames per second of the result.
        n_frames: how many; by default as many as the duration holds, floor(duration fps + 1/2).
        antialias: take out what is faster than the new rate can hold, half of it in Hz, instead of
            folding it down. Does nothing where the rate rises.

    Raises:
        MotionError: a rate that no motion can have, no frame asked for, or more than 8 GB of them.
    """
    fps = checked_fps(fps)
    if n_frames is None:
        exact = motion.n_frames * Fraction(fps) / Fraction(motion.fps)
        n_frames = max(1, math.floor(exact + Fraction(1, 2)))
    if n_frames < 1:
        raise MotionError(f"n_frames is {n_frames}; a motion needs at least one frame")
    if n_frames * motion.skeleton.n_joints > _MOST_ROTATIONS:
        raise MotionError(
            f"{motion.duration:.6g} s at {fps:g} fps are {n_frames} frames, too many to hold; is "
            f"the motion's own rate, {motion.fps:g} fps, right?"
        )
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

    rotations = slerp(motion.rotations[low], motion.rotations[high], weight[:, None])
    places = between
    if antialias and fps < motion.fps:
        lowpass = _LowPass(low + weight, motion.fps / fps, motion.n_frames)
        rotations = lowpass.rotations(motion.rotations, rotations)
        places = lowpass.places
    return replace(
        motion,
        rotations=rotations,
        translation=places(motion.translation),
        fps=fps,
        joint_translations={k: places(v) for k, v in motion.joint_translations.items()},
        expressions=None if motion.expressions is None else places(motion.expressions),
        info=dict(motion.info),
    )


class _LowPass:
    """A Lanczos filter of three lobes at any times between frames; the end frames are held, up to
    the length of the motion.

    Rotations are averaged as rotation vectors about the unfiltered result (Lee and Shin 2002,
    "General construction of time-domain filters for orientation data"): no bias by the sign of a
    quaternion or by its chord.

    Args:
        times: (T,) in frames of the source.
        ratio: frames of the source for one of the result, above 1.
        n_frames: of the source.
    """

    def __init__(self, times: np.ndarray, ratio: float, n_frames: int) -> None:
        reach = min(math.ceil(3 * ratio), n_frames)
        taps = np.floor(times).astype(np.int64)[:, None] + np.arange(-reach, reach + 2)
        away = (taps - times[:, None]) / ratio
        weights = np.sinc(away) * np.sinc(away / 3) * (np.abs(away) < 3)
        self._weights = weights / weights.sum(axis=1, keepdims=True)
        self._taps = np.clip(taps, 0, n_frames - 1)

    def places(self, values: np.ndarray) -> np.ndarray:
        """(T, D) of (T', D)."""
        # Tap by tap: all at once they would be six times the frames of the source.
        return sum(w[:, None] * values[tap] for tap, w in zip(self._taps.T, self._weights.T))

    def rotations(self, source: np.ndarray, unfiltered: np.ndarray) -> np.ndarray:
        """(T, J, 4) of (T', J, 4) and the result without a filter (T, J, 4)."""
        back = invert_quaternions(unfiltered)
        vector = np.zeros((*unfiltered.shape[:-1], 3))
        for tap, weight in zip(self._taps.T, self._weights.T):
            away = rotation_vector_from_quaternion(multiply_quaternions(back, source[tap]))
            vector += weight[:, None, None] * away
        return multiply_quaternions(unfiltered, quaternion_from_rotation_vector(vector))
