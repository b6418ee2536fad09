"""When a walker makes a step: the feet pass one another."""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, sosfiltfilt

from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.motion.root_path import RootPath

HIGHEST = 5.0
"""Hz; strides are slower, and what is left of noise above it is no step."""
SHARE = 0.5
"""Of the typical distance between the feet: nearer to each other than this they are passing."""


def step_times(motion: Motion, path: RootPath) -> np.ndarray:
    """(S,) seconds at which one foot passes the other on its way forward.

    Ankles are seen along the heading, the one relative to the other, so that neither where the
    body is nor its speed matters. A pass counts once the feet were well apart on both sides of it.

    Args:
        motion: T frames.
        path: T frames at the motion's rate, for its headings.
    """
    legs = find_parts(motion.skeleton).legs
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
    """(S-1,) steps per second from each step to the next, and the path's mean speed there (m/s)."""
    times = step_times(motion, path)
    way = np.concatenate([[0.0], np.cumsum(path.speeds[:-1])]) / path.fps
    gone = np.interp(times, np.arange(path.n_frames) / path.fps, way)
    return 1 / np.diff(times), np.diff(gone) / np.diff(times)
