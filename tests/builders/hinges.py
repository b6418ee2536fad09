"""Joint limits: knees that bend forward, elbows that bend backward."""

import numpy as np

from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES
from gesturekit.motion.retarget.body_frames import FORWARD, BodyFrames, standing_pose
from gesturekit.motion.rotations import rotate_vectors

TOLERANCE = np.deg2rad(5.0)
"""Hyperextension of straight limbs that is normal in people and in captured motion."""

_HINGES = (("shoulder", "elbow", "wrist", -1), ("hip", "knee", "ankle", 1))


def bent_backwards(motion: Motion) -> dict[str, np.ndarray]:
    """Find the frames in which a hinge bends the wrong way by more than `TOLERANCE`.

    A knee does if the shank points ahead of the thigh, an elbow if the forearm points behind the
    upper arm. Ahead is the forward axis of the upper bone's anatomical frame (`BodyFrames`).

    Returns:
        "left_elbow", "right_elbow", "left_knee", "right_knee" to (T,) bool; without a wrist joint
        there is no elbow, and without legs no knee.

    Raises:
        MotionError: parts that cannot be identified, or a body that never stands.
    """
    frames = BodyFrames(motion.skeleton, standing_pose(motion))
    world, positions = frames.world(motion.global_rotations()), motion.positions()
    found = {}
    for upper, hinge, end, sign in _HINGES:
        for side in SIDES:
            if f"{side}_{end}" not in frames.joints:
                continue
            above = world[f"{side}_{upper}"]
            ahead = rotate_vectors(above, np.broadcast_to(FORWARD, (motion.n_frames, 3)))
            joints = [frames.joints[f"{side}_{part}"] for part in (hinge, end)]
            bone = positions[:, joints[1]] - positions[:, joints[0]]
            bone /= np.maximum(np.linalg.norm(bone, axis=-1, keepdims=True), 1e-9)
            found[f"{side}_{hinge}"] = sign * (bone * ahead).sum(axis=-1) > np.sin(TOLERANCE)
    return found
