"""Detection of steps: the times when the feet pass each other."""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, sosfiltfilt

from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import require_legs
from gesturekit.motion.root_path import RootPath

HIGHEST = 5.0
"""Cut-off frequency in Hz, above that of strides; higher frequencies are noise."""
SHARE = 0.5
"""Share of the typical distance of the feet, below which they are passing each other."""


def step_times(motion: Motion, path: RootPath) -> np.ndarray:
    """Return the times (S,) in seconds at which one foot passes the other.

    The distance between the ankles is projected on the heading, so that position and speed of the
    body do not matter. A step counts if the feet are well apart before and after it.

    Args:
        motion: T frames.
        path: T frames at the motion's rate, for its headings.
    """
    legs = require_legs(motion.skeleton)
    left, right = (motion.skeleton.index(legs[side].ankle) for side in ("left", "right"))
    places = motion.positions()
    apart = (places[:, left] - places[:, right])[:, [0, 2]]
    ahead = apart[:, 0] * np.sin(path.headings) + apart[:, 1] * np.cos(path.headings)
    ahead = sosfiltfilt(butter(2, HIGHEST, fs=motion.fps, output="sos"), ahead)
    wide = np.flatnonzero(np.abs(ahead) > SHARE * np.sqrt(np.mean(ahead**2)))
    passed = np.flatnonzero(np.diff(np.sign(ahead[wide])))
    times = []
    for before, after in zip(wide[passed], wide[passed + 1], strict=True):
        part = ahead[before : after + 1]
        k = int(np.flatnonzero(np.sign(part[1:]) != np.sign(part[0]))[0])
        times.append(before + k + part[k] / (part[k] - part[k + 1]))
    return np.array(times) / motion.fps


def stepping_rates(motion: Motion, path: RootPath) -> tuple[np.ndarray, np.ndarray]:
    """Return steps per second between steps (S-1,), and the path's mean speed there (m/s)."""
    times = step_times(motion, path)
    way = np.concatenate([[0.0], np.cumsum(path.speeds[:-1])]) / path.fps
    gone = np.interp(times, np.arange(path.n_frames) / path.fps, way)
    return 1 / np.diff(times), np.diff(gone) / np.diff(times)
