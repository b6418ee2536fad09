"""Defects of captured and generated motion: jumps, pops, jitter and frozen runs.

Thresholds in metres and m/s are for the reference body and are multiplied by `body_scale`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gesturekit.motion.motion import Motion
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import rotation_angles, slerp

MAX_SPEED = 10.0
"""m/s; a joint that moves faster between two frames has jumped. A boxer's fist reaches 10."""

MIN_FROZEN = 1.0
"""Shortest frozen run that is reported, seconds: a living person always moves a little."""

POP_ACCELERATION = 630.0
"""rad/s²; a joint that rotates there and back with more has popped: 20 degrees for one frame at 30
fps. A hand shaken at 5 Hz by 30 degrees reaches 520."""
POP_ANGLE = np.deg2rad(5.0)
"""Least angle of a pop, at high frame rates."""
POP_GRAVITIES = 10.0 * 9.81
"""m/s²; acceleration of a pop of the translation or of a joint translation."""

JITTER = 3e-3
"""Least difference of successive steps in alternating directions, metres: noise of 0.75 mm."""
JITTER_FPS = 15.0
"""Lowest frame rate at which jitter is measured. It alternates at half the frame rate, and a hand
can be shaken at up to 7 Hz."""

# Rounding steps of poses in text files.
_STILL_ANGLE = 1e-5  # radians
_STILL_DISTANCE = 1e-6  # metres


@dataclass(frozen=True)
class Jumps:
    """Frames at which some joint has moved faster than a person can."""

    frames: tuple[int, ...]
    joint: str
    speed: float
    """Speed of the fastest jump, in m/s; `joint` is the joint that makes it."""
    limit: float
    """m/s; the speed above which a joint of this body jumps."""


@dataclass(frozen=True)
class Pops:
    """Frames in which a joint deviates from both its neighbouring frames."""

    frames: tuple[int, ...]
    joint: str
    angle: float
    """Largest pop, in radians from the mean of the neighbouring frames (0 if the joint pops in
    position, not in rotation); `joint` is the joint that makes it."""


def find_jumps(motion: Motion) -> Jumps | None:
    """Return the frames at which a joint has moved faster than `MAX_SPEED` in world space, or
    None."""
    steps = np.linalg.norm(np.diff(motion.positions(), axis=0), axis=2) * motion.fps
    limit = MAX_SPEED * body_scale(motion.skeleton)
    frames = np.flatnonzero((steps > limit).any(axis=1)) + 1
    if len(frames) == 0:
        return None
    joint = int(np.unravel_index(steps.argmax(), steps.shape)[1])
    return Jumps(tuple(map(int, frames)), motion.skeleton.names[joint], float(steps.max()), limit)


def speed_limit(limit: float) -> str:
    """Return a text for a speed limit that was scaled from `MAX_SPEED` to a body."""
    here, usual = format_speed(limit), format_speed(MAX_SPEED)
    return f"over {here}" if here == usual else f"over {here}, {usual} on a body of 1.7 m"


def format_speed(speed: float) -> str:
    """Return a speed with at least two digits: "0.91 m/s", "24 m/s"."""
    return f"{speed:.0f} m/s" if speed >= 9.95 else f"{speed:.2g} m/s"


def find_pops(motion: Motion, jumps: Jumps | None = None) -> Pops | None:
    """Return the frames in which a joint pops, or None.

    A pop deviates from the mean of the frames before and after by more than a person can move, and
    by more than these two differ.

    Args:
        motion: any rig.
        jumps: result of `find_jumps`; pops next to a jump are not counted.
    """
    popping, off, limit = _popping(motion)
    if jumps is not None:
        beside = np.array([frame + near for frame in jumps.frames for near in (-1, 0)]) - 1
        popping[beside[(beside >= 0) & (beside < len(popping))]] = False
    frames = np.flatnonzero(popping.any(axis=1)) + 1
    if len(frames) == 0:
        return None
    largest = np.where(popping, off, -1.0)
    joint = int(np.unravel_index(largest.argmax(), largest.shape)[1])
    angle = float(largest.max()) if largest.max() > limit else 0.0
    return Pops(tuple(map(int, frames)), motion.skeleton.names[joint], angle)


def _popping(motion: Motion) -> tuple[np.ndarray, np.ndarray, float]:
    """Return where joints pop between the first and the last frame, (max(T - 2, 0), J) bool.

    Also the angles (T - 2, J) between a rotation and the mean of its neighbours, and the least
    angle of a pop, in radians.
    """
    q, frame = motion.rotations, 1 / motion.fps
    off = rotation_angles(slerp(q[:-2], q[2:], np.array(0.5)), q[1:-1])
    limit = max(POP_ANGLE, POP_ACCELERATION / 2 * frame**2)
    popping = (off > limit) & (off > rotation_angles(q[:-2], q[2:]))
    pull = POP_GRAVITIES * body_scale(motion.skeleton)
    names = {motion.skeleton.names[0]: motion.translation, **motion.joint_translations}
    for name, places in names.items():
        away = np.linalg.norm(places[1:-1] - (places[:-2] + places[2:]) / 2, axis=1)
        through = np.linalg.norm(places[2:] - places[:-2], axis=1)
        popping[:, motion.skeleton.index(name)] |= (away > pull / 2 * frame**2) & (away > through)
    return popping, off, limit


def jitter_share(motion: Motion) -> float:
    """Share of the frames in which some joint trembles: its steps in world space get shorter and
    longer in turns, three times running and each time by more than `JITTER`, which is faster than
    anything a frame rate can hold. 0 for fewer than 5 frames, or fewer than `JITTER_FPS` a second.
    """
    if motion.fps < JITTER_FPS:
        return 0.0
    bend = np.diff(motion.positions(), n=2, axis=0)
    length = np.linalg.norm(bend, axis=2)
    back = (bend[1:] * bend[:-1]).sum(axis=2) < -0.5 * length[1:] * length[:-1]
    back &= np.minimum(length[1:], length[:-1]) > JITTER * body_scale(motion.skeleton)
    return float((back[1:] & back[:-1]).any(axis=1).sum() / motion.n_frames)


def frozen_runs(motion: Motion) -> list[tuple[int, int]]:
    """Return runs of frames [first, stop) of at least `MIN_FROZEN` in which no joint moves."""
    angle = rotation_angles(motion.rotations[1:], motion.rotations[:-1]).max(axis=1)
    distance = np.abs(np.diff(motion.translation, axis=0)).max(axis=1)
    for values in motion.joint_translations.values():
        distance = np.maximum(distance, np.abs(np.diff(values, axis=0)).max(axis=1))
    distance /= body_scale(motion.skeleton)
    still = (angle < _STILL_ANGLE) & (distance < _STILL_DISTANCE)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    # A run of n still steps is n + 1 equal frames.
    runs = [(int(first), int(stop) + 1) for first, stop in edges.reshape(-1, 2)]
    return [(first, stop) for first, stop in runs if stop - first >= MIN_FROZEN * motion.fps]
