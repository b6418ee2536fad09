"""Levels of the pyramid as motion: to edit a coarse one and make its detail anew.

Keyframe editing and style transfer are one thing (Li et al. 2022, section 4): a given motion takes
the place of a coarse level's, and the finer levels give it the detail that they learnt. For the
first the motion is a coarse level that was edited, for the second it is anything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from gesturekit.motion.motion import Motion
from gesturekit.motion.representation import MultiresRepresentation
from gesturekit.motion.rotations import rotate_vectors, slerp
from gesturekit.multires.interpolation import resample
from gesturekit.postprocess import lock_feet
from gesturekit.training.own_rig import on_rig

_EASE = 0.1
"""Seconds; how softly a motion sets out for an edited place."""
_UNTOUCHED = 0.01
"""Vectors nearer than this (6D entries, labels, m) differ by the rounding of a file alone."""
_UNMOVED = 1e-4
"""So do steps of the root, m per frame, that are nearer than this: they add up."""


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
    motion = on_rig(representation, motion)
    if motion.n_frames == lengths[level] and motion.n_frames < n_frames:
        values = representation.encode(motion)
        values[:, [-3, -1]] *= lengths[level] / n_frames
        return values
    values = representation.encode(motion.resample(fps, n_frames))
    return resample(torch.from_numpy(values.T), lengths[level]).T.numpy()


def keep_unedited(
    edited: np.ndarray, made: np.ndarray, read: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vectors (T_i, D) of an edited level, with all that nobody touched as it was made.

    A file holds rotations and no labels: contacts between yes and no, and rotation columns
    shortened by interpolation, are lost in it, and the finer levels would tell.

    Args:
        edited: vectors read from the edited motion.
        made: what the network made; `edited` comes back where no frame of it is to be found.
        read: the same, read from the motion that was edited.

    Returns:
        the vectors, and (T_i, D) bool, what of them was edited.
    """
    near = np.full(edited.shape[1], _UNTOUCHED)
    near[[-3, -1]] = _UNMOVED
    same = np.abs(edited - read) < near
    if not same.all(axis=1).any():
        return edited, np.ones(edited.shape, bool)
    return np.where(same, made, edited), ~same


def lock_feet_but(
    motion: Motion, contacts: np.ndarray, given: np.ndarray | None, *, keep_path: bool
) -> Motion:
    """`lock_feet`, coming and going where feet are to stay as they were given.

    Args:
        motion: T frames.
        contacts: (T, C) labels.
        given: (T,) 1 where the motion stays as it is, 0 where feet are locked; None locks them
            everywhere.
        keep_path: see `lock_feet`.
    """
    locked = lock_feet(motion, contacts, keep_path=keep_path)
    if given is None or not given.any():
        return locked
    given = given[:, None]

    def mixed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
        between = before + (1 - given) * (after - before)
        return np.where(given == 0, after, np.where(given == 1, before, between))

    turns = slerp(
        motion.rotations, locked.rotations, np.broadcast_to(1 - given, motion.rotations.shape[:2])
    )
    turns = np.where(given[..., None] == 1, motion.rotations, turns)
    return replace(
        locked,
        rotations=np.where(given[..., None] == 0, locked.rotations, turns),
        translation=mixed(motion.translation, locked.translation),
        joint_translations={
            name: mixed(motion.joint_translations[name], places)
            for name, places in locked.joint_translations.items()
        },
    )


def over_keyframes(
    representation: MultiresRepresentation,
    motion: Motion,
    led: Motion,
    wanted: Motion,
    edited: np.ndarray,
) -> Motion:
    """A motion whose root is over the ground where it was put in edited frames.

    Finer levels and foot locking lead the root elsewhere, little by little. The whole motion is
    moved to meet what was edited: as much before the first such frame as at it, as much after the
    last one, and in between from one to the next.

    Args:
        representation: its root is the one that moves.
        motion: T frames.
        led: T frames, its root where it would be without keyframes.
        wanted: T_k frames, its root where it was put.
        edited: (T_k,) bool, in which of them; in one at least.
    """
    path, goals = ground_places(representation, led), ground_places(representation, wanted)
    frames = np.arange(len(path))
    at = ((np.arange(len(goals)) + 0.5) * len(path) / len(goals) - 0.5)[edited]
    missing = [goals[edited, i] - np.interp(at, frames, path[:, i]) for i in range(path.shape[1])]
    offset = path - ground_places(representation, motion)
    offset += gaussian_filter1d(
        np.stack([_through(frames, at, values) for values in missing], axis=-1),
        _EASE * motion.fps,
        axis=0,
        mode="nearest",
    )
    return moved(representation, motion, offset)


def _through(frames: np.ndarray, at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A curve through values at certain frames that never overshoots; level before and after."""
    if len(at) == 1:
        return np.full(len(frames), values[0])
    return PchipInterpolator(at, values)(frames.clip(at[0], at[-1]))


def ground_places(representation: MultiresRepresentation, motion: Motion) -> np.ndarray:
    """(T, 2) where the model's root is over the ground, x and z, m."""
    return motion.positions()[:, representation.root][:, [0, 2]]


def moved(representation: MultiresRepresentation, motion: Motion, offset: np.ndarray) -> Motion:
    """A decoded motion with its root moved over the ground by (2,) or (T, 2) metres."""
    offset = np.stack([offset[..., 0], np.zeros(offset.shape[:-1]), offset[..., 1]], axis=-1)
    if representation.root == 0:
        return replace(motion, translation=motion.translation + offset)
    above = motion.skeleton.parents[representation.root]
    local = rotate_vectors(motion.global_rotations()[:, above] * [-1, -1, -1, 1], offset)
    name = representation.joints[0]
    places = motion.joint_translations[name] + local
    return replace(motion, joint_translations={**motion.joint_translations, name: places})


def full_frames(motion: Motion, fps: float) -> int:
    """How many frames a motion has at the full rate."""
    return max(1, int(np.floor(motion.n_frames / motion.fps * fps + 0.5)))
