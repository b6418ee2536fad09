"""Which way a body faces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs
from gesturekit.motion.rotations import invert_quaternions, rotate_vectors

_TOO_STEEP = 0.05
"""Share of its length that a side axis needs along the ground to say where a body faces."""


def heading(motion: Motion) -> float:
    """Mean direction the body faces, radians about Y; 0 is +Z, positive towards +X.

    A body that faces +Z has its left hip at +X of its right one. A rig without legs is taken to
    face +Z.
    """
    across = _across(motion)
    if across is None:
        return 0.0
    across = across.mean(axis=0)
    return float(np.arctan2(-across[2], across[0]))


def side_axis(motions: Sequence[Motion], root: int) -> np.ndarray:
    """(3,) unit vector towards the body's left in the frame of joint `root`.

    It is the mean direction from the right hip to the left one as that joint sees it. On a rig
    without legs the joint's own +Z is taken to look forward; where that points up or down, its
    axis that lies flattest is taken for the side.

    Args:
        motions: motions of one rig.
        root: index of the joint whose turns are the body's.
    """
    turned = np.concatenate([motion.global_rotations()[:, root] for motion in motions])
    ways = [_across(motion) for motion in motions]
    if any(way is None for way in ways):
        flat = [np.hypot(*rotate_vectors(turned, axis)[:, [0, 2]].T).mean() for axis in np.eye(3)]
        # Forward along z means that the side is x.
        return np.eye(3)[0 if flat[2] > 0.5 and flat[0] > 0.5 else int(np.argmax(flat))]
    side = rotate_vectors(invert_quaternions(turned), np.concatenate(ways)).mean(axis=0)
    length = np.linalg.norm(side)
    return side / length if length > 1e-9 else np.eye(3)[0]


def headings(turned: np.ndarray, side: np.ndarray) -> np.ndarray:
    """(T,) where a body faces in each frame, radians about Y, without jumps by whole turns.

    Forward is what lies square to the side axis and to the world's Y. While the side axis points
    up or down (somebody lies on one side) the heading goes straight between its neighbours.

    Args:
        turned: (T, 4) world rotations of the root.
        side: (3,) from `side_axis`.
    """
    across = rotate_vectors(turned, np.broadcast_to(side, (len(turned), 3)))
    told = np.flatnonzero(np.hypot(across[:, 0], across[:, 2]) > _TOO_STEEP)
    if not len(told):
        return np.zeros(len(turned))
    angles = np.unwrap(np.arctan2(-across[told, 2], across[told, 0]))
    return np.interp(np.arange(len(turned)), told, angles)


def _across(motion: Motion) -> np.ndarray | None:
    """(T, 3) from the right hip to the left one, world, metres; None without legs."""
    legs = find_legs(motion.skeleton)
    if legs is None:
        return None
    positions = motion.positions()
    left, right = (motion.skeleton.index(legs[side].hip) for side in ("left", "right"))
    return positions[:, left] - positions[:, right]
