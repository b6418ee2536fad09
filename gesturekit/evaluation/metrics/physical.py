"""Speed, acceleration and jerk of a motion, in physical units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.evaluation.metrics.derivatives import derivative
from gesturekit.motion import Motion
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.parts import SIDES, arm_joints, body_joints, find_parts


def arm_speed(motion: Motion) -> np.ndarray:
    """Return the summed local angular speed of both shoulder and elbow joints for each frame.

    The value of a frame is the mean of the steps before and after it, so that the speed is not
    delayed by half a frame. The first and last frames have only one step.

    Returns:
        (T,) radians per second.

    Raises:
        MotionError: fewer than 2 frames, or no shoulders and elbows in the skeleton.
    """
    _require_frames(motion, 2)
    joints = [motion.skeleton.index(name) for name in arm_joints(motion.skeleton)]
    q = motion.rotations[:, joints]
    # |q1 - q0| = 2 sin(angle / 4) for unit quaternions of one hemisphere: exact near zero,
    # where the arc cosine of a dot product loses half of its digits.
    chord = np.minimum(
        np.linalg.norm(q[1:] - q[:-1], axis=-1), np.linalg.norm(q[1:] + q[:-1], axis=-1)
    )
    steps = (4.0 * np.arcsin(chord / 2.0)).sum(axis=1) * motion.fps
    padded = np.concatenate([steps[:1], steps, steps[-1:]])
    return 0.5 * (padded[:-1] + padded[1:])


def wrist_speed(motion: Motion) -> np.ndarray:
    """Return the mean speed of both wrists in the world, from each frame to the next.

    Alexanderson et al. 2023 (section 5.3) plot its distribution.

    Returns:
        (T - 1,) metres per second.

    Raises:
        MotionError: fewer than 2 frames, or wrists that cannot be identified.
    """
    arms = find_parts(motion.skeleton).arms
    wrists = [arms[side].wrist for side in SIDES]
    if None in wrists:
        raise MotionError("the rig has no wrist joints whose speed could be taken")
    return joint_speed(motion, wrists).mean(axis=1)


def joint_speed(motion: Motion, joints: Sequence[str] | None = None) -> np.ndarray:
    """Return the speed of joints in the world, from each frame to the next.

    Args:
        motion: any frame rate.
        joints: names; None for the body joints (no fingers, no end joints).

    Returns:
        (T - 1, J) metres per second.

    Raises:
        MotionError: fewer than 2 frames, or joints that cannot be identified.
    """
    steps = derivative(joint_paths(motion, joints), motion.fps, 1, None)
    return np.linalg.norm(steps, axis=-1)


def relative_speed(motion: Motion, joints: Sequence[str] | None = None) -> np.ndarray:
    """Return (T - 1, J) `joint_speed` divided by `body_scale`: m/s on the reference body."""
    return joint_speed(motion, joints) / body_scale(motion.skeleton)


def acceleration(
    motion: Motion, *, cutoff: float | None = None, joints: Sequence[str] | None = None
) -> float:
    """Return the mean acceleration of the body joints (no fingers, no end joints), m/s².

    Without a cutoff: |Δ²p|·fps² in world space, averaged over frames and joints, the average
    acceleration of the GENEA challenges (genea_numerical_evaluations) in metres. It depends on the
    frame rate. With a cutoff (Hz): that of the low-passed motion (`derivatives`), which can be
    compared across frame rates.

    Raises:
        MotionError: fewer than 3 frames (6 with a cutoff), or joints that cannot be identified.
    """
    return _mean_derivative(motion, 2, cutoff, joints)


def jerk(
    motion: Motion, *, cutoff: float | None = None, joints: Sequence[str] | None = None
) -> float:
    """Return the mean jerk of the body joints (no fingers, no end joints), m/s³.

    Without a cutoff: |Δ³p|·fps³ in world space, averaged over frames and joints, the average jerk
    of the GENEA challenges (genea_numerical_evaluations) in metres. It also measures the noise of
    captured motion and grows with the frame rate: compare at one frame rate, or give a cutoff (Hz)
    to take the jerk of the low-passed motion (`derivatives`).

    Raises:
        MotionError: fewer than 4 frames (6 with a cutoff), or joints that cannot be identified.
    """
    return _mean_derivative(motion, 3, cutoff, joints)


def max_speed(motion: Motion) -> float:
    """Return the largest speed of any body joint between two neighbouring frames, m/s.

    People of 1.7 m stay below about 10 m/s; more is a jump.

    Raises:
        MotionError: fewer than 2 frames, or body parts that cannot be identified.
    """
    return float(joint_speed(motion).max())


HARDLY_MOVING = 0.05
"""Below this fraction of the recording's arm speed, sync is not informative."""


def arm_speed_ratio(motion: Motion, recording: Motion) -> float:
    """Return the mean arm speed of a motion divided by that of a recording.

    Raises:
        MotionError: the recording's arms do not move.
    """
    return _ratio(float(arm_speed(motion).mean()), float(arm_speed(recording).mean()), "arm speed")


def jerk_ratio(motion: Motion, recording: Motion) -> float:
    """Return the jerk of a motion divided by that of a recording, both at one frame rate.

    Raises:
        MotionError: the frame rates differ, or the recording does not move.
    """
    if abs(motion.fps - recording.fps) > 1e-3 * recording.fps:
        raise MotionError(
            f"jerk at {motion.fps:g} fps cannot be compared with jerk at {recording.fps:g} fps; "
            "resample one of them"
        )
    return _ratio(jerk(motion), jerk(recording), "jerk")


def _ratio(value: float, reference: float, what: str) -> float:
    if reference == 0.0:
        raise MotionError(f"the recording's {what} is zero; there is nothing to compare with")
    return value / reference


def joint_paths(motion: Motion, joints: Sequence[str] | None = None) -> np.ndarray:
    """Return (T, J, 3) world positions of joints, metres; None takes the body joints.

    Raises:
        MotionError: a missing joint, or body parts that cannot be identified.
    """
    names = body_joints(motion.skeleton) if joints is None else joints
    return motion.positions()[:, [motion.skeleton.index(name) for name in names]]


def _mean_derivative(
    motion: Motion, order: int, cutoff: float | None, joints: Sequence[str] | None
) -> float:
    values = derivative(joint_paths(motion, joints), motion.fps, order, cutoff)
    return float(np.linalg.norm(values, axis=-1).mean())


def _require_frames(motion: Motion, n: int) -> None:
    if motion.n_frames < n:
        raise MotionError(f"the motion has {motion.n_frames} frames; at least {n} are needed")
