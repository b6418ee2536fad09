"""Root path following: move a recording onto a path without moving its feet.

A model whose root follows a path is trained on roots that lie on smooth paths, but real hips sway
about such a path. Moving the whole body onto the path would make the feet slide by the sway, so
inverse kinematics keeps the feet in place.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.ik.two_bone import two_bone_ik
from gesturekit.motion.kinematics import GROUND
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import invert_quaternions, multiply_quaternions, rotate_vectors
from gesturekit.motion.selection.model_joints import first_moving_joint


def follow_path(motion: Motion, path: RootPath, root: int | None = None) -> Motion:
    """Move the root onto a nearby path; feet keep their positions and orientations.

    The root keeps its rotations. A foot that is out of reach moves by as much as its leg is short.

    Args:
        motion: T frames.
        path: T frames at the motion's rate, such as its own `RootPath.smoothed`.
        root: index of the joint to move; by default the first one that moves.

    Raises:
        MotionError: a path of another length or rate.
    """
    if (path.n_frames, path.fps) != (motion.n_frames, motion.fps):
        raise MotionError(
            f"the path has {path.n_frames} frames at {path.fps:g} fps; the motion has "
            f"{motion.n_frames} at {motion.fps:g}"
        )
    root = first_moving_joint([motion]) if root is None else root
    positions, world = motion.positions(), motion.global_rotations()
    shift = np.zeros((motion.n_frames, 3))
    shift[:, GROUND] = path.positions - positions[:, root][:, GROUND]
    moved = _shifted(motion, root, shift, world)
    legs = find_legs(motion.skeleton)
    if legs is None:
        return moved
    parents = motion.skeleton.parents
    rotations = moved.rotations.copy()
    for leg in legs.values():
        hip, knee, ankle = (motion.skeleton.index(name) for name in (leg.hip, leg.knee, leg.ankle))
        rotations[:, [hip, knee]] = two_bone_ik(
            positions[:, [hip, knee, ankle]] + shift[:, None],
            positions[:, ankle],
            rotations[:, [hip, knee]],
            world[:, [parents[hip], parents[knee]]],
        )
    reached = replace(moved, rotations=rotations).global_rotations()
    for leg in legs.values():
        ankle = motion.skeleton.index(leg.ankle)
        back = invert_quaternions(reached[:, parents[ankle]])
        rotations[:, ankle] = multiply_quaternions(back, world[:, ankle])
    return replace(moved, rotations=rotations)


def _shifted(motion: Motion, root: int, shift: np.ndarray, world: np.ndarray) -> Motion:
    """Return the motion with joint `root` and all joints below it moved by `shift` (T, 3), metres.

    `world` (T, J, 4) are the joints' world rotations.
    """
    if root == 0:
        return replace(motion, translation=motion.translation + shift)
    name, parent = motion.skeleton.names[root], motion.skeleton.parents[root]
    still = np.tile(motion.skeleton.offsets[root], (motion.n_frames, 1))
    position = motion.joint_translations.get(name, still)
    position = position + rotate_vectors(invert_quaternions(world[:, parent]), shift)
    return replace(motion, joint_translations={**motion.joint_translations, name: position})
