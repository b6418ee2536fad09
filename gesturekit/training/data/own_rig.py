"""Motions that a user gives a model, on the model's own rig."""

from __future__ import annotations

import numpy as np

from gesturekit.errors import ModelError, MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.standing_pose import standing_pose
from gesturekit.motion.selection.model_joints import ModelJoints


def on_rig(model: ModelJoints, motion: Motion) -> Motion:
    """The motion, moved to the model's rig where it has another one.

    Raises:
        ModelError: that cannot be done.
    """
    rig = model.skeleton
    if (motion.skeleton.names, motion.skeleton.parents) == (rig.names, rig.parents):
        return motion
    try:
        return retarget(motion, rig, pose=_upright(model))
    except MotionError as error:
        raise ModelError(f"the motion cannot be put on the model's rig: {error}") from None


def _upright(model: ModelJoints) -> np.ndarray | None:
    """(J, 4) how the rig stands: at rest, else as its recordings do on average, if that stands."""
    mean = Motion(model.skeleton, model.fixed_rotations[None], np.zeros((1, 3)), 1.0)
    try:
        return standing_pose(mean)
    except MotionError:
        return None
