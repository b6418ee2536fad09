"""Heading: the direction a body faces on the ground."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gesturekit.motion.kinematics import GROUND
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import heading_joints
from gesturekit.motion.rotations import invert_quaternions, rotate_vectors

_TOO_STEEP = 0.05
"""Horizontal share of the side axis below which it gives no heading."""


def heading(motion: Motion) -> float:
    """Return the mean direction the body faces, radians about Y; 0 is +Z, positive towards +X.

    A body that faces +Z has its left hip at +X of its right one. Shoulders count where there are
    no legs; a rig without either faces +Z.
    """
    across = _across(motion)
    if across is None:
        return 0.0
    across = across.mean(axis=0)
    return float(np.arctan2(-across[2], across[0]))


def side_axis(motions: Sequence[Motion], root: int) -> np.ndarray:
    """(3,) unit vector towards the body's left in the frame of joint `root`.

    It is the mean direction from the right hip to the left one in that frame, or between the
    shoulders of a rig without legs. A rig without either is assumed to face the joint's
    +Z; if that points up or down, the most horizontal axis is the side.

    Args:
        motions: motions of one rig.
        root: index of the joint that turns with the body.
    """
    # Copies, because a view would keep the rotations of all joints in memory.
    world = np.concatenate([motion.global_rotations()[:, root].copy() for motion in motions])
    hips = [vectors for motion in motions if (vectors := _across(motion)) is not None]
    if len(hips) < len(motions):
        flat = [np.hypot(*rotate_vectors(world, axis)[:, GROUND].T).mean() for axis in np.eye(3)]
        # If z points forward, the side is x.
        return np.eye(3)[0 if flat[2] > 0.5 and flat[0] > 0.5 else int(np.argmax(flat))]
    side = rotate_vectors(invert_quaternions(world), np.concatenate(hips)).mean(axis=0)
    length = np.linalg.norm(side)
    return side / length if length > 1e-9 else np.eye(3)[0]


def headings(world: np.ndarray, side: np.ndarray) -> np.ndarray:
    """(T,) direction the body faces in each frame, radians about Y, unwrapped.

    Forward is perpendicular to the side axis and to the world's Y. Frames whose side axis points
    up or down (the body lies on one side) are interpolated linearly.

    Args:
        world: (T, 4) world rotations of the root.
        side: (3,) from `side_axis`.
    """
    return headings_of_sides(rotate_vectors(world, np.broadcast_to(side, (len(world), 3))))


def headings_of_sides(across: np.ndarray) -> np.ndarray:
    """(T,) direction the body faces in each frame, radians about Y, unwrapped; see `headings`.

    Args:
        across: (T, 3) world vectors towards the body's left, of any length.
    """
    level, length = np.hypot(across[:, 0], across[:, 2]), np.linalg.norm(across, axis=1)
    defined = np.flatnonzero(level > _TOO_STEEP * length)
    if not len(defined):
        return np.zeros(len(across))
    angles = np.unwrap(np.arctan2(-across[defined, 2], across[defined, 0]))
    return np.interp(np.arange(len(across)), defined, angles)


def _across(motion: Motion) -> np.ndarray | None:
    """(T, 3) world vectors from the right of `heading_joints` to the left one, metres; or None."""
    joints = heading_joints(motion.skeleton)
    if joints is None:
        return None
    positions = motion.positions()
    left, right = (motion.skeleton.index(name) for name in joints)
    return positions[:, left] - positions[:, right]
