"""A recording put onto a path, its feet where they were.

A model whose root follows a path learns from roots on smooth paths, and real hips sway about
them. Moved as a whole onto its path, a recorded body would slide over the floor by what its hips
sway; so its legs reach back to where its feet stood.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.ik.two_bone import two_bone_ik
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import invert_quaternions, multiply_quaternions, rotate_vectors
from gesturekit.motion.selection.model_joints import first_moving_joint


def follow_path(motion: Motion, path: RootPath, root: int | None = None) -> Motion:
    """Move the root onto a path near its own way; feet stay where they are, turned as they are.

    Rotations of the root stay what they are. A foot that is out of reach comes along as far as its
    leg is too short.

    Args:
        motion: T frames.
        path: T frames at the motion's rate, such as its own `RootPath.smoothed`.
        root: index of the joint to put there; by default the first one that moves.

    Raises:
        MotionError: a path of another length or rate.
    """
    if (path.n_frames, path.fps) != (motion.n_frames, motion.fps):
        raise MotionError(
            f"the path has {path.n_frames} frames at {path.fps:g} fps; the motion has "
            f"{motion.n_frames} at {motion.fps:g}"
        )
    root = first_moving_joint([motion]) if root is None else root
    positions, turned = motion.positions(), motion.global_rotations()
    shift = np.zeros((motion.n_frames, 3))
    shift[:, [0, 2]] = path.positions - positions[:, root][:, [0, 2]]
    moved = _shifted(motion, root, shift, turned)
    legs = find_legs(motion.skeleton)
    if legs is None:
        return moved  # nothing that stands on the floor
    parents = motion.skeleton.parents
    rotations = moved.rotations.copy()
    for leg in legs.values():
        hip, knee, ankle = (motion.skeleton.index(name) for name in (leg.hip, leg.knee, leg.ankle))
        rotations[:, [hip, knee]] = two_bone_ik(
            positions[:, [hip, knee, ankle]] + shift[:, None],
            positions[:, ankle],
            rotations[:, [hip, knee]],
            turned[:, [parents[hip], parents[knee]]],
        )
    reached = replace(moved, rotations=rotations).global_rotations()
    for leg in legs.values():
        ankle = motion.skeleton.index(leg.ankle)
        back = invert_quaternions(reached[:, parents[ankle]])
        rotations[:, ankle] = multiply_quaternions(back, turned[:, ankle])
    return replace(moved, rotations=rotations)


def _shifted(motion: Motion, root: int, shift: np.ndarray, turned: np.ndarray) -> Motion:
    """With joint `root`, and all that hangs on it, moved by (T, 3) in the world."""
    if root == 0:
        return replace(motion, translation=motion.translation + shift)
    name, parent = motion.skeleton.names[root], motion.skeleton.parents[root]
    still = np.tile(motion.skeleton.offsets[root], (motion.n_frames, 1))
    place = motion.joint_translations.get(name, still)
    place = place + rotate_vectors(invert_quaternions(turned[:, parent]), shift)
    return replace(motion, joint_translations={**motion.joint_translations, name: place})
