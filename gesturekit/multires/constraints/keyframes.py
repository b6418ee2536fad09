"""Levels of the pyramid as motion: to edit a coarse one and make its detail anew.

Keyframe editing and style transfer are one thing (Li et al. 2022, section 4): a given motion takes
the place of a coarse level's, and the finer levels give it the detail that they learnt. For the
first the motion is a coarse level that was edited, for the second it is anything else.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

import audio_features as af
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import rotate_vectors, slerp
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.resampling import resample
from gesturekit.postprocess import lock_feet
from gesturekit.training.data.own_rig import on_rig

_EASE = 0.1
"""Seconds; how softly a motion sets out for an edited place."""
_UNTOUCHED = 0.01
"""Vectors nearer than this (6D entries, labels, m) differ by the rounding of a file alone."""
_UNMOVED = 1e-4
"""So do steps of the root, m per frame, that are nearer than this: they add up."""
_RATE_TOLERANCE = 0.01
"""Share by which a file's frame rate may miss its level's, as rounding of the file makes it."""
_HELD_FRAMES = 3
"""From so many equal frames at its end a motion is taken to go on past the end of the clip, as
Blender writes it, whose default range is 250 frames."""
_EQUAL = 1e-6

log = logging.getLogger(__name__)


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


def fit_keyframes(
    representation: MultiresRepresentation,
    motion: Motion,
    fps: float,
    levels: int,
    level: int,
    n_frames: int | None,
) -> Motion:
    """Return keyframes on the model's rig and without frames past the end; warn of misfits.

    Args:
        representation: of the model.
        motion: what was edited.
        fps: frames per second of the finest level.
        levels: how many levels the model has.
        level: in whose place the motion is put, from 0.
        n_frames: of the result at `fps`; None where the keyframes give it its length.

    Raises:
        ModelError: another rig that cannot be put in the place of the model's.
    """
    moves = np.diff(motion.rotations, axis=0), np.diff(motion.translation, axis=0)
    changes = np.flatnonzero(
        [max(np.abs(m[k]).max() for m in moves) > _EQUAL for k in range(motion.n_frames - 1)]
    )
    last = int(changes[-1]) + 2 if len(changes) else motion.n_frames
    end = last if n_frames is None else af.level_lengths(n_frames, levels)[level]
    if last <= end < motion.n_frames and motion.n_frames - last >= _HELD_FRAMES - 1:
        log.warning(
            "keyframes: %d equal frames at the end are left out, %d remain (Blender exports 250 "
            "frames unless told the clip's length); to keep them give the length in seconds",
            motion.n_frames - end,
            end,
        )
        motion = motion.slice(0, end)
    own = on_rig(representation, motion)
    if own is not motion:
        log.warning(
            "keyframes: another rig than the model's (%d joints, %d of them): retargeted",
            motion.skeleton.n_joints,
            representation.skeleton.n_joints,
        )
    wanted = full_frames(motion, fps) if n_frames is None else n_frames
    lengths = af.level_lengths(wanted, levels)
    rates = [fps * length / wanted for length in lengths]
    if abs(motion.fps - rates[level]) > _RATE_TOLERANCE * rates[level]:
        nearest = int(np.argmin([abs(motion.fps - rate) for rate in rates]))
        fits = abs(motion.fps - rates[nearest]) <= _RATE_TOLERANCE * rates[nearest]
        log.warning(
            "keyframes: %.4g fps, but level %d has %.4g fps: %s",
            motion.fps,
            level + 1,
            rates[level],
            f"it would fit level {nearest + 1}; resampled"
            if fits
            else f"no level has; resampled, as {motion.duration:.2f} s of motion",
        )
    elif n_frames is not None and motion.n_frames != lengths[level]:
        log.warning(
            "keyframes: %d frames, but level %d has %d for this length: %s",
            motion.n_frames,
            level + 1,
            lengths[level],
            "the rest is left out"
            if motion.n_frames > lengths[level]
            else "the last pose is held to the end",
        )
    return own


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
