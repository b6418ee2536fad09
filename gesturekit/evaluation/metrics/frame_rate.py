"""Resampling of motions to a common frame rate, the same for every metric."""

from __future__ import annotations

from gesturekit.motion import Motion

RULE = "Lanczos low-pass at half the lower frame rate, then resampled; higher rates interpolated"
"""Description of `at_rate`, part of every evaluation's settings."""

_SAME = 1e-3  # relative difference below which rates differ only by rounding


def at_rate(motion: Motion, fps: float) -> Motion:
    """Resample a motion to `fps` without aliasing.

    The motion is low-passed first if the rate falls: dropping frames alone would alias fast
    movement and capture noise, and a recording at 120 fps would look rougher than one at 30. A
    motion that has this rate (to a thousandth) is returned as it is.
    """
    if abs(motion.fps - fps) <= _SAME * fps:
        return motion
    return motion.resample(fps, antialias=True)
