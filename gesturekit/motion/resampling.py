"""Resampling to another frame rate, with linear interpolation and an optional low-pass filter."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import TypeVar

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
    slerp,
)

Share = TypeVar("Share", float, np.ndarray)
LOWEST_FPS, HIGHEST_FPS = 1e-5, 1e5
"""Frame rates outside this range are treated as errors in the file."""
COMMON_RATES = (24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 240)
_MOST_ROTATIONS = 250_000_000  # 8 GB of them; ten hours of 75 joints at 60 fps are 162 million
_BLOCK = 4096  # frames that are interpolated at a time, to save memory


def checked_fps(fps: float) -> float:
    """Return the frame rate as a float.

    Raises:
        MotionError: it is outside `LOWEST_FPS` to `HIGHEST_FPS`.
    """
    if isinstance(fps, str) or not LOWEST_FPS <= float(fps) <= HIGHEST_FPS:
        raise MotionError(f"fps is {fps!r}; expected {LOWEST_FPS:g} to {HIGHEST_FPS:g}")
    return float(fps)


class Resampler:
    """Interpolation of the arrays of one motion at another frame rate; see `Motion.resample`.

    The low-pass is a Lanczos filter of three lobes, evaluated at any times; the end frames are
    repeated.

    Args:
        n_source: frames T' of the motion.
        n_joints: J; limits the number of frames that fit in memory.
        source_fps: frames per second of the motion.
        fps: frames per second of the result.
        n_frames: frames T of the result; by default floor(duration fps + 1/2).
        antialias: filter out frequencies above fps / 2 if the rate falls.

    Raises:
        MotionError: a rate outside the allowed range, or a number of frames below 1 or too large.
    """

    def __init__(
        self,
        n_source: int,
        n_joints: int,
        source_fps: float,
        fps: float,
        n_frames: int | None = None,
        antialias: bool = False,
    ) -> None:
        self.fps = fps = checked_fps(fps)
        if n_frames is None:
            exact = n_source * Fraction(fps) / Fraction(source_fps)
            n_frames = max(1, math.floor(exact + Fraction(1, 2)))
        if n_frames < 1:
            raise MotionError(f"n_frames is {n_frames}; a motion needs at least one frame")
        if n_frames * n_joints > _MOST_ROTATIONS:
            long = f"{n_source / source_fps:.6g} s at {fps:g} fps are {n_frames} frames"
            raise MotionError(f"{long}, too many; is the motion at {source_fps:g} fps?")
        last, ratio = n_source - 1, source_fps / fps
        place = np.minimum(np.arange(n_frames) * ratio, last)
        self._low = np.floor(place).astype(np.int64)
        self._high = np.minimum(self._low + (ratio != 1), last)
        self._weight = place - self._low
        # (tap, its weight) in each frame: all taps at once would take six times the memory.
        self._taps: list[tuple[np.ndarray, np.ndarray]] = []
        if antialias and ratio > 1:
            reach = min(math.ceil(3 * ratio), n_source)
            taps = self._low[:, None] + np.arange(-reach, reach + 2)
            away = (taps - place[:, None]) / ratio
            weights = np.sinc(away) * np.sinc(away / 3) * (np.abs(away) < 3)
            weights /= weights.sum(axis=1, keepdims=True)
            self._taps = list(zip(np.clip(taps, 0, last).T, weights.T))

    def values(self, source: np.ndarray) -> np.ndarray:
        """(T, D) values, linearly interpolated from (T', D)."""
        if self._taps:
            return sum(weight[:, None] * source[tap] for tap, weight in self._taps)
        low, high = source[self._low], source[self._high]
        return low + self._weight[:, None] * (high - low)

    def rotations(self, source: np.ndarray) -> np.ndarray:
        """(T, J, 4) unit quaternions, interpolated by slerp from (T', J, 4).

        To filter, rotations are averaged as rotation vectors about these (Lee and Shin 2002,
        "General construction of time-domain filters for orientation data"), which does not depend
        on the signs of the quaternions.
        """
        between = np.empty((len(self._low), *source.shape[1:]))
        for at in range(0, len(between), _BLOCK):
            low, high, weight = (
                values[at : at + _BLOCK] for values in (self._low, self._high, self._weight)
            )
            between[at : at + _BLOCK] = slerp(source[low], source[high], weight[:, None])
        if not self._taps:
            return between
        back, vector = invert_quaternions(between), np.zeros((*between.shape[:-1], 3))
        for tap, weight in self._taps:
            away = rotation_vector_from_quaternion(multiply_quaternions(back, source[tap]))
            vector += weight[:, None, None] * away
        return multiply_quaternions(between, quaternion_from_rotation_vector(vector))


def smoothstep(share: Share) -> Share:
    """Return 3 x^2 - 2 x^3 of shares x in [0, 1]."""
    return share * share * (3 - 2 * share)
