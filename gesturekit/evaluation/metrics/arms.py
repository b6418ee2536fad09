"""Distance of each arm's motion to training motion, in joint angles.

A whole body can be new where each arm is copied from another place. A window is 1 s of the local
rotations of one arm's shoulder and elbow, 9 frames of it; the distance of two windows is the root
mean square of the angles between their rotations. Windows of the training motion begin at every
frame, and its mirrored copy counts as training motion.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.evaluation.metrics.diagonals import frame_distances
from gesturekit.evaluation.metrics.frame_rate import at_rate
from gesturekit.evaluation.metrics.hands import FPS, window_starts
from gesturekit.motion import Motion
from gesturekit.motion.parts import SIDES, find_parts

WINDOW, STEP, HOP = 1.0, 3, 0.5
"""Length of windows in seconds, every which frame of 25 fps is compared, and the time between the
starts of generated windows, seconds."""

_BLOCK = 4000  # training windows that are in memory at a time


def arm_windows(
    motions: Sequence[Motion], side: str, *, hop: float = HOP
) -> tuple[np.ndarray, np.ndarray]:
    """Return windows of one arm, and the clip of each.

    Args:
        motions: any frame rate; those shorter than 1 s have no window.
        side: "left" or "right".
        hop: time between the starts of windows, seconds.

    Returns:
        (N, 162) entries of 9 frames of the rotation matrices of shoulder and elbow, and (N,) index
        of the motion.

    Raises:
        MotionError: body parts that cannot be identified, or no motion as long as a window.
    """
    from scipy.spatial.transform import Rotation

    width, rows, clips = round(WINDOW * FPS), [], []
    for at, motion in enumerate(motions):
        arm = find_parts(motion.skeleton).arms[side]
        joints = [motion.skeleton.index(name) for name in (arm.shoulder, arm.elbow)]
        rotations = at_rate(motion, FPS).rotations[:, joints]
        matrices = Rotation.from_quat(rotations.reshape(-1, 4)).as_matrix().reshape(-1, 18)
        starts = window_starts(len(matrices), width, hop * FPS)
        rows.append(matrices[starts[:, None] + np.arange(0, width, STEP)].reshape(len(starts), -1))
        clips.append(np.full(len(starts), at))
    if not sum(map(len, rows)):
        raise MotionError(f"no clip is as long as a window of {WINDOW:g} s")
    return np.concatenate(rows), np.concatenate(clips)


def nearest_arm(windows: np.ndarray, training: Sequence[Motion], side: str) -> np.ndarray:
    """Return the distance (N,) of windows of an arm to the nearest one of training, degrees.

    The angle of a rotation matrix R from the identity I is 2 asin(|R - I| / sqrt(8)), with the
    Frobenius norm.

    Raises:
        MotionError: see `arm_windows`.
    """
    nearest = np.full(len(windows), np.inf)
    for copy in (training, [motion.mirror() for motion in training]):
        kept = arm_windows(copy, side, hop=1.0 / FPS)[0]
        for start in range(0, len(kept), _BLOCK):
            squared = frame_distances(windows, kept[start : start + _BLOCK], squared=True)
            nearest = np.minimum(nearest, squared.min(axis=1))
    mean = nearest / (windows.shape[1] // 9)
    return np.degrees(2.0 * np.arcsin(np.minimum(np.sqrt(mean / 8.0), 1.0)))


ARM_KEYS = {side: f"copying_{side}" for side in SIDES}
"""Keys of `definitions` by side."""
