"""Levels of the pyramid as motion: to edit a coarse one and make its detail anew.

Keyframe editing and style transfer are one thing (Li et al. 2022, section 4): a given motion takes
the place of a coarse level's, and the finer levels give it the detail that they learnt. For the
first the motion is a coarse level that was edited, for the second it is anything else.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gesturekit.errors import ModelError, MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.representation import MultiresRepresentation
from gesturekit.motion.retarget import retarget
from gesturekit.multires.interpolation import resample

_UNTOUCHED = 0.01
"""Vectors nearer than this (6D entries, labels, m) differ by the rounding of a file alone."""


def level_motion(
    representation: MultiresRepresentation, values: np.ndarray, fps: float, n_frames: int
) -> Motion:
    """A level's vectors (T_i, D) as a motion at that level's own rate.

    Args:
        representation: of the vectors.
        values: in their own units.
        fps: frames per second of the finest level.
        n_frames: its frames.
    """
    stride = n_frames / len(values)
    values = values.copy()
    # Displacements count per full-rate frame at every level.
    values[:, [-3, -1]] *= stride
    return representation.decode(values, fps / stride)


def motion_level(
    representation: MultiresRepresentation,
    motion: Motion,
    fps: float,
    lengths: Sequence[int],
    level: int,
) -> np.ndarray:
    """(T_i, D) vectors of a level, from a motion that lasts as long; inverse of `level_motion`.

    A motion at the level's own rate is taken frame by frame. Any other is brought to the full
    rate, and from there to the level as training motion is.

    Args:
        representation: of the vectors.
        motion: a motion of the same rig, or of another one that moves like it.
        fps: frames per second of the finest level.
        lengths: frames of each level.
        level: which, from 0.

    Raises:
        ModelError: another rig that cannot be put in the place of the model's.
    """
    n_frames = lengths[-1]
    rig = representation.skeleton
    if (motion.skeleton.names, motion.skeleton.parents) != (rig.names, rig.parents):
        try:
            motion = retarget(motion, rig)
        except MotionError as error:
            raise ModelError(f"the motion cannot be put on the model's rig: {error}") from None
    if motion.n_frames == lengths[level] and motion.n_frames < n_frames:
        values = representation.encode(motion)
        values[:, [-3, -1]] *= lengths[level] / n_frames
        return values
    values = representation.encode(motion.resample(fps, n_frames))
    return resample(torch.from_numpy(values.T), lengths[level]).T.numpy()


def keep_unedited(edited: np.ndarray, made: np.ndarray, read: np.ndarray) -> np.ndarray:
    """Vectors (T_i, D) of an edited level, with all that nobody touched as it was made.

    A file holds rotations and no labels: contacts between yes and no, and rotation columns
    shortened by interpolation, are lost in it, and the finer levels would tell.

    Args:
        edited: vectors read from the edited motion.
        made: what the network made; `edited` comes back where no frame of it is to be found.
        read: the same, read from the motion that was edited.
    """
    same = np.abs(edited - read) < _UNTOUCHED
    return np.where(same, made, edited) if same.all(axis=1).any() else edited


def full_frames(motion: Motion, fps: float) -> int:
    """How many frames a motion has at the full rate."""
    return max(1, int(np.floor(motion.n_frames / motion.fps * fps + 0.5)))
