"""Which axis of a file points up, and turning what has Z up to Y up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.motion.rotations import invert_quaternions, multiply_quaternions, rotate_vectors

Z_TO_Y = np.array([-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""A quarter turn about x: (x, y, z) becomes (x, z, -y)."""


def find_up_axis(motion: Motion) -> str:
    """ "z" where the body stands along the world's z axis in most frames, else "y"."""
    try:
        parts = find_parts(motion.skeleton)
    except MotionError:
        return "y"
    positions = motion.positions()
    place = {name: positions[:, j] for j, name in enumerate(motion.skeleton.names)}
    ankles = (place[parts.legs["left"].ankle] + place[parts.legs["right"].ankle]) / 2
    body = place[parts.spine[-1]] - ankles
    along_z = body[:, 2] > 2 * np.abs(body[:, :2]).max(axis=1)
    return "z" if along_z.mean() > 0.5 else "y"


def z_up_to_y_up(motion: Motion) -> Motion:
    """The same motion with all axes, those of the joints too, turned from Z up to Y up."""

    def turned(vectors: np.ndarray) -> np.ndarray:
        return rotate_vectors(Z_TO_Y, vectors)

    skeleton = motion.skeleton
    ends = {name: tuple(turned(s) for s in sites) for name, sites in skeleton.end_sites.items()}
    rotations = multiply_quaternions(Z_TO_Y, motion.rotations)
    return replace(
        motion,
        skeleton=replace(skeleton, offsets=turned(skeleton.offsets), end_sites=ends),
        rotations=multiply_quaternions(rotations, invert_quaternions(Z_TO_Y)),
        translation=turned(motion.translation),
        joint_translations={k: turned(v) for k, v in motion.joint_translations.items()},
    )
