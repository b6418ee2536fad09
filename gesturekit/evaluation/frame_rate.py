"""Motions brought to the frame rate they are compared at: one rule for every measure."""

from __future__ import annotations

from gesturekit.motion import Motion

RULE = "Lanczos low-pass at half the lower frame rate, then resampled; higher rates interpolated"
"""What `at_rate` does, in words: part of every evaluation's settings."""

_SAME = 1e-3  # rates that differ by less, relative, are one rate written with few digits


def at_rate(motion: Motion, fps: float) -> Motion:
    """A motion at `fps`, without what that rate cannot hold.

    Frames that are merely dropped fold fast movement and capture noise down into slow movement,
    and a recording at 120 fps would look rougher than one at 30. So the motion is low-passed first
    where the rate falls. A motion of that rate (to a thousandth) is returned as it is.
    """
    if abs(motion.fps - fps) <= _SAME * fps:
        return motion
    return motion.resample(fps, antialias=True)
