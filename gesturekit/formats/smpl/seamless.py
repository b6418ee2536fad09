"""Motion in the keys of Seamless Interaction: SMPL-H in the axes of the camera, 30 fps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from audio_features.archive import Archive
from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.smpl.amass import to_y_up
from gesturekit.formats.smpl.skeleton import model_pelvis, smpl_skeleton
from gesturekit.motion.body_shape import BodyShape
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import quaternion_from_rotation_vector

FPS = 30.0
_JOINTS = {"global_orient": 1, "body_pose": 21, "left_hand_pose": 15, "right_hand_pose": 15}


def from_seamless(archive: Archive) -> Motion:
    """Return the motion in the keys `smplh:…`; a body upside down, as in camera axes, is turned.

    Raises:
        FormatError: a key is missing or of a wrong shape.
    """
    parts = []
    for name, n_joints in _JOINTS.items():
        values = _values(archive, name)
        n_frames = len(values)
        if values.size != n_frames * n_joints * 3:
            raise FormatError(
                f"key 'smplh:{name}' has shape {values.shape}; expected (frames, {n_joints}, 3)"
            )
        parts.append(values.reshape(n_frames, n_joints, 3))
    trans = _values(archive, "translation")
    if len({len(part) for part in parts}) > 1 or trans.shape != (len(parts[0]), 3):
        raise FormatError("keys 'smplh:…' differ in their numbers of frames")
    rotations = quaternion_from_rotation_vector(np.concatenate(parts, axis=1))
    n_joints = rotations.shape[1]
    rest = model_pelvis(n_joints)
    rotations, pelvis, up = to_y_up(rotations, trans + rest, "auto")
    skeleton = replace(smpl_skeleton(n_joints), body_shape=BodyShape(pelvis=tuple(rest)))
    try:
        return Motion(skeleton, rotations, pelvis, FPS, info={"up": up})
    except MotionError as error:
        raise FormatError(f"keys 'smplh:…': {error}") from None


def _values(archive: Archive, name: str) -> np.ndarray:
    key = f"smplh:{name}"
    if key not in archive:
        raise FormatError(f"no key {key!r} in the archive")
    return archive.numbers(key)
