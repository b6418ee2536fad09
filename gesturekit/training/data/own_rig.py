"""Retargeting of input motions to a model's rig."""

from __future__ import annotations

import numpy as np

from gesturekit.errors import ModelError, MotionError
from gesturekit.motion.model_joints import ModelJoints
from gesturekit.motion.motion import Motion
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.standing_pose import standing_pose


def on_rig(model: ModelJoints, motion: Motion) -> Motion:
    """Return the motion on the model's rig, retargeted if its own rig is different.

    Raises:
        ModelError: the motion cannot be retargeted.
    """
    rig = model.skeleton
    if (motion.skeleton.names, motion.skeleton.parents) == (rig.names, rig.parents):
        return motion
    try:
        return retarget(motion, rig, pose=_upright(model))
    except MotionError as error:
        raise ModelError(f"the motion cannot be retargeted to the model's rig: {error}") from None


def _upright(model: ModelJoints) -> np.ndarray | None:
    """Return the standing pose (J, 4) of the mean training pose; None if that does not stand."""
    mean = Motion(model.skeleton, model.fixed_rotations[None], np.zeros((1, 3)), 1.0)
    try:
        return standing_pose(mean)
    except MotionError:
        return None
