"""Smoothing: a low-pass filter on hips and upper body that keeps gesture beats.

A plain low-pass filter flattens peaks of speed together with jitter, and these peaks coincide with
stressed words. Two zero-phase Butterworth filters are therefore blended: one with the requested
cutoff, and one at 6 Hz, above which gestures have almost no energy. The second is used around each
peak of the summed angular speed, the first elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, find_peaks, sosfiltfilt

from gesturekit.errors import MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import unidentified, upper_body
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    normalize_quaternions,
    rotation_angles,
    steady_signs,
)
from gesturekit.motion.skeleton import Skeleton

_GESTURE = 6.0
"""Hz; higher frequencies are jitter."""
_PROMINENT = 0.05
"""Least prominence of a beat, as a share of the 95th percentile of the speed."""
_AROUND = 0.1
"""Seconds before and after its peak in which a beat is kept."""


def smooth_motion(motion: Motion, seconds: float) -> Motion:
    """Smooth the hips and the upper body except for its beats; the root path does not change.

    The hips are smoothed too, because trembling hips shake the head most. Legs keep their
    orientation in the world, so that feet move with the hip joints alone, by millimetres.

    Args:
        motion: T frames of any rig; one whose upper body cannot be identified does not change.
        seconds: shorter movements are removed, except around peaks of speed; the cutoff is
            1 / (2 seconds) Hz. From 1/12 s down only the 6 Hz filter remains.

    Returns:
        The motion with smoothed rotations of the hips, the spine and all joints above it, without
        delay.

    Raises:
        MotionError: seconds is not positive and finite.
    """
    if isinstance(seconds, str) or not (np.isfinite(seconds) and seconds > 0):
        raise MotionError(f"smooth {seconds}: expected a positive number of seconds")
    if unidentified(motion.skeleton):
        return motion
    skeleton = motion.skeleton
    upper = [skeleton.index(name) for name in upper_body(skeleton)]
    hips = list(skeleton.ancestors(upper[0]))
    joints = [*upper, *hips]
    turns = steady_signs(motion.rotations[:, joints])
    gesture = _low_pass(turns, _GESTURE, motion.fps)
    calm = _low_pass(turns, min(0.5 / seconds, _GESTURE), motion.fps)
    keep = _beats(gesture[:, : len(upper)], motion.fps)[:, None, None]
    rotations = motion.rotations.copy()
    rotations[:, joints] = normalize_quaternions(calm + keep * (gesture - calm))
    before, after = (_world_of(hips, own, skeleton) for own in (motion.rotations, rotations))
    for joint, parent in enumerate(skeleton.parents):
        if parent in hips and joint not in joints:
            world = multiply_quaternions(before[parent], rotations[:, joint])
            rotations[:, joint] = multiply_quaternions(invert_quaternions(after[parent]), world)
    return replace(motion, rotations=rotations)


def _world_of(
    ancestors: Sequence[int], rotations: np.ndarray, skeleton: Skeleton
) -> dict[int, np.ndarray]:
    """Return the world rotations (T, 4) of a joint's ancestors, the nearest first, by joint."""
    world: dict[int, np.ndarray] = {}
    for joint in reversed(ancestors):
        own, parent = rotations[:, joint], skeleton.parents[joint]
        world[joint] = own if parent < 0 else multiply_quaternions(world[parent], own)
    return world


def _beats(turns: np.ndarray, fps: float) -> np.ndarray:
    """(T,) weight 1 around peaks of the summed angular speed of (T, J, 4), 0 between them."""
    keep = np.zeros(len(turns))
    if len(turns) < 2:
        return keep
    turns = normalize_quaternions(turns)
    speed = rotation_angles(turns[1:], turns[:-1]).sum(axis=1) * fps
    peaks, _ = find_peaks(speed, prominence=_PROMINENT * np.quantile(speed, 0.95) + 1e-9)
    around = round(_AROUND * fps)
    for peak in peaks + 1:  # speed k is that from frame k to k + 1
        keep[max(peak - around, 0) : peak + around + 1] = 1
    return gaussian_filter1d(keep, _AROUND / 2 * fps)


def _low_pass(turns: np.ndarray, cutoff: float, fps: float) -> np.ndarray:
    """(T, J, 4) low-pass filtered quaternions, not normalised; `cutoff` is in Hz."""
    if cutoff >= 0.45 * fps or len(turns) < 4:
        return turns
    sections = butter(2, cutoff, fs=fps, output="sos")
    return sosfiltfilt(sections, turns, axis=0, padlen=min(round(fps / cutoff), len(turns) - 1))
