"""Retargeting of input motions to a model's rig."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gesturekit.errors import ModelError, MotionError
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.model_joints import ModelJoints
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.body_frames import standing_pose
from gesturekit.motion.skeleton import GROUND

_AROUND_SECONDS = 60.0
"""Seconds before and after a pose that are retargeted with it."""


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


def pose_on_rig(
    model: ModelJoints, read: Callable[[int], tuple[Motion, int]], default: int
) -> Motion:
    """Return a frame of a motion as a pose of the model's rig; arguments as for `Placement.of`.

    Of a motion on another rig, joints without a counterpart keep the pose that the model gives
    them, and `info["floor"]` is the height of its floor on the model's rig, metres.

    Raises:
        ModelError: the motion cannot be retargeted.
    """
    whole, frame = read(default)
    # Retargeting finds out how a rig stands, for which a minute before and after is enough.
    around = math.ceil(_AROUND_SECONDS * whole.fps)
    first = max(0, frame - around)
    motion, frame = whole[first : frame + around], frame - first
    retargeted = on_rig(model, motion)
    pose, given = (m[frame : frame + 1] for m in (retargeted, motion))
    if retargeted is motion:
        return pose
    source, target = (find_parts(m.skeleton) for m in (given, pose))
    rotations, translation = pose.rotations.copy(), pose.translation.copy()
    if not source.fingers:
        others = [j for j in range(model.skeleton.n_joints) if j not in model.indices]
        rotations[:, others] = model.fixed_rotations[others]
    # Retargeting scales the way from the first frame; a place in a scene has no scale.
    places = [
        m.positions()[:, m.skeleton.index(parts.pelvis)]
        for m, parts in ((given, source), (pose, target))
    ]
    translation[:, GROUND] += (places[0] - places[1])[:, GROUND]
    return replace(
        pose,
        rotations=rotations,
        translation=translation,
        info={"floor": floor_height(retargeted)},
    )


def _upright(model: ModelJoints) -> np.ndarray | None:
    """Return the standing pose (J, 4) of the mean training pose; None if that does not stand."""
    mean = Motion(model.skeleton, model.fixed_rotations[None], np.zeros((1, 3)), 1.0)
    try:
        return standing_pose(mean)
    except MotionError:
        return None
