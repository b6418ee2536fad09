"""Keyframe constraint, and conversion of pyramid levels to motions that can be edited.

Keyframe editing and style transfer are the same operation (Li et al. 2022): a motion
replaces the output of a coarse level, and the finer levels add learned detail. For
keyframe editing the motion is an edited coarse level, for style transfer any other motion.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import unidentified, upper_body
from gesturekit.motion.rotations import invert_quaternions, rotate_vectors
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.resampling import resample
from gesturekit.training.clips import ground_positions, on_rig

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel

_EASE_SECONDS = 0.1
"""Standard deviation of the Gaussian that smooths the correction of the root's path."""
_SAME = 0.01
"""Largest difference between motion vectors (6D entries, labels, m) that counts as rounding."""
_SAME_STEP = 1e-4
"""The same for root displacements, m per frame; smaller, because their errors accumulate."""
_RATE_TOLERANCE = 0.01
"""Largest relative difference between the frame rates of file and level that counts as rounding."""
_HELD_FRAMES = 3
"""Least number of equal frames at the end of a motion that is treated as padding. Blender pads a
shorter clip to its default range of 250 frames."""
_EQUAL = 1e-6

log = logging.getLogger(__name__)


class KeyframeConstraint:
    """Constrain slow movement to keyframes, and leave fast movement to the finer levels.

    Contact labels are not constrained, because edited files have none.

    Args:
        given: (T_k, D) vectors of the edited coarse level, not normalised.
        edited: (T_k, D) bool, true where they were edited; see `keep_unedited`.
        representation: of the vectors.
        normaliser: of the vectors.
    """

    def __init__(
        self,
        given: np.ndarray,
        edited: np.ndarray,
        representation: MultiresRepresentation,
        normaliser: Normaliser,
    ) -> None:
        self.given = normaliser.from_values(given)
        self.weight = _widened(np.asarray(edited.any(axis=1))).to(self.given.dtype)
        self.channels = torch.ones(given.shape[1], 1)
        self.channels[representation.layout.contacts] = 0
        legs, rig = np.ones(given.shape[1], bool), representation.skeleton
        legs[representation.layout.contacts] = False
        upper = () if unidentified(rig) else upper_body(rig)
        for name in set(representation.joints) & set(upper):
            legs[representation.joint_columns(name)] = False
        # If every frame was edited, the foot positions were not chosen on purpose: lock them.
        feet = np.asarray(edited[:, legs].any(axis=1))
        self._feet = _widened(feet & ~feet.all())

    def __call__(self, level: int, output: Tensor) -> Tensor:
        """Return the output of a level, (1, D, T_i), moved to the keyframes where edited."""
        n_frames = output.shape[-1]
        wanted = (resample(self.given, n_frames) - output).numpy()
        # Half a frame of the edited level, which represents only slower movement. Filtering twice
        # leaves less of the slow difference.
        spread = 0.5 * n_frames / self.given.shape[-1]
        smooth = partial(gaussian_filter1d, sigma=spread, mode="nearest")
        missing = smooth(wanted)
        missing += smooth(wanted - missing)
        return output + resample(self.weight, n_frames) * self.channels * torch.from_numpy(missing)

    def edited_feet(self, n_frames: int) -> np.ndarray:
        """Return weights (T,): 1 where legs or root were edited, and feet must not be locked."""
        return resample(self._feet, n_frames).numpy()


def level_motion(model: MultiresModel, values: np.ndarray, n_frames: int) -> Motion:
    """Return a level's vectors (T_i, D), in their own units, as a motion at that level's own rate.

    `n_frames` is the number of frames of the finest level.
    """
    stride, values = n_frames / len(values), values.copy()
    # Displacements are per full-rate frame at every level.
    values[:, model.representation.layout.root_xz] *= stride
    return model.representation.decode(values, model.fps / stride)


def motion_level(
    model: MultiresModel, motion: Motion, lengths: Sequence[int], level: int
) -> np.ndarray:
    """Return the vectors (T_i, D) of a level, from a motion of the same duration.

    The inverse of `level_motion`: a motion at the level's own rate is converted frame by frame. Any
    other motion is resampled to the full rate and then to the level, as in training.

    Args:
        model: of the vectors.
        motion: on any rig; retargeted if it is not the model's.
        lengths: frames of each level.
        level: index of the level.

    Raises:
        ModelError: a rig that cannot be retargeted to the model's.
    """
    representation, n_frames = model.representation, lengths[-1]
    motion = on_rig(representation, motion)
    if motion.n_frames == lengths[level] and motion.n_frames < n_frames:
        values = representation.encode(motion)
        values[:, representation.layout.root_xz] *= lengths[level] / n_frames
        return values
    values = representation.encode(motion.resample(model.fps, n_frames))
    return resample(torch.from_numpy(values.T), lengths[level]).T.numpy()


def fit_keyframes(model: MultiresModel, motion: Motion, level: int, n_frames: int | None) -> Motion:
    """Return keyframes on the model's rig and without frames past the end; warn of misfits.

    Args:
        model: the trained model.
        motion: the edited motion.
        level: index of the level that the motion replaces.
        n_frames: frames of the result at the model's rate; None if the keyframes determine the
            length.

    Raises:
        ModelError: a rig that cannot be retargeted to the model's.
    """
    lengths_of = model.network_config.lengths
    motion = _without_held_frames(motion, None if n_frames is None else lengths_of(n_frames)[level])
    retargeted = on_rig(model.representation, motion)
    if retargeted is not motion:
        log.warning(
            "keyframes: the rig (%d joints) is not the model's (%d joints): retargeted",
            *(motion.skeleton.n_joints, model.skeleton.n_joints),
        )
    wanted = full_frames(motion, model.fps) if n_frames is None else n_frames
    _warn_of_misfit(motion, model.fps, lengths_of(wanted), level, n_frames is not None)
    return retargeted


def _without_held_frames(motion: Motion, end: int | None) -> Motion:
    """Return a motion without equal frames after `end`, or after the last change if it is None."""
    moves = np.diff(motion.rotations, axis=0), np.diff(motion.translation, axis=0)
    changes = np.any([np.abs(m).max(axis=tuple(range(1, m.ndim))) > _EQUAL for m in moves], axis=0)
    changes = np.flatnonzero(changes)
    last = int(changes[-1]) + 2 if len(changes) else motion.n_frames
    end = last if end is None else end
    if last <= end < motion.n_frames and motion.n_frames - last >= _HELD_FRAMES - 1:
        log.warning(
            "keyframes: %d equal frames at the end are left out, %d remain (Blender exports 250 "
            "frames unless the clip's length is set); to keep them, give the length in seconds",
            *(motion.n_frames - end, end),
        )
        return motion[:end]
    return motion


def _warn_of_misfit(
    motion: Motion, fps: float, lengths: Sequence[int], level: int, length_given: bool
) -> None:
    """Warn if the keyframes have another rate, or not as many frames, as the level they replace."""
    rates = fps * np.array(lengths) / lengths[-1]
    if abs(motion.fps - rates[level]) > _RATE_TOLERANCE * rates[level]:
        nearest = int(np.abs(motion.fps - rates).argmin())
        what = f"no level has this rate; resampled as {motion.duration:.2f} s of motion"
        if abs(motion.fps - rates[nearest]) <= _RATE_TOLERANCE * rates[nearest]:
            what = f"it fits level {nearest + 1}; resampled"
        log.warning(
            "keyframes: %.4g fps, but level %d has %.4g fps: %s",
            *(motion.fps, level + 1, rates[level], what),
        )
    elif length_given and motion.n_frames != lengths[level]:
        is_long = motion.n_frames > lengths[level]
        log.warning(
            "keyframes: %d frames, but level %d has %d for this length: %s",
            *(motion.n_frames, level + 1, lengths[level]),
            "the rest is left out" if is_long else "the last pose is held to the end",
        )


def keep_unedited(
    edited: np.ndarray,
    generated: np.ndarray,
    read: np.ndarray,
    representation: MultiresRepresentation,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the vectors of an edited level, with unedited values restored to the network's output.

    A motion file stores rotations only, and loses two things that the finer levels respond to:
    contact labels between 0 and 1, and the length of rotation columns, which interpolation reduces.

    Args:
        edited: (T_i, D) vectors read from the edited motion.
        generated: (T_i, D) output of the network.
        read: (T_i, D) `generated`, decoded to a motion and encoded again, without edits.
        representation: of the vectors.

    Returns:
        (T_i, D) vectors, and (T_i, D) bool, true where they were edited. If every frame was
        edited, the vectors are `edited`.
    """
    tolerance = np.full(edited.shape[1], _SAME)
    tolerance[representation.layout.root_xz] = _SAME_STEP
    same = np.abs(edited - read) < tolerance
    if not same.all(axis=1).any():
        return edited, np.ones(edited.shape, bool)
    return np.where(same, generated, edited), ~same


def root_through_keyframes(
    representation: MultiresRepresentation,
    motion: Motion,
    free: Motion,
    wanted: Motion,
    edited: np.ndarray,
) -> Motion:
    """Move a motion so that its root passes through the ground positions of the edited frames.

    Finer levels and foot locking let the root drift. The offset that corrects the drift is
    interpolated between edited frames, and constant before the first and after the last one.

    Args:
        representation: defines the root.
        motion: T frames to move.
        free: T frames of the same motion before foot locking.
        wanted: T_k frames with the root at the edited positions.
        edited: (T_k,) bool, true at edited frames; at least one.
    """
    path, goals = ground_positions(representation, free), ground_positions(representation, wanted)
    frames = np.arange(len(path))
    at = ((np.arange(len(goals)) + 0.5) * len(path) / len(goals) - 0.5)[edited]
    missing = [goals[edited, i] - np.interp(at, frames, path[:, i]) for i in range(path.shape[1])]
    if len(at) == 1:
        correction = np.tile(np.transpose(missing), (len(frames), 1))
    else:  # without overshoot, and constant outside
        correction = PchipInterpolator(at, missing, axis=1)(frames.clip(at[0], at[-1])).T
    spread = _EASE_SECONDS * motion.fps
    offset = path - ground_positions(representation, motion)
    offset += gaussian_filter1d(correction, spread, axis=0, mode="nearest")
    return moved(representation, motion, offset)


def moved(representation: MultiresRepresentation, motion: Motion, offset: np.ndarray) -> Motion:
    """Return a decoded motion with its root displaced by (2,) or (T, 2) metres of x and z."""
    offset = np.stack([offset[..., 0], np.zeros(offset.shape[:-1]), offset[..., 1]], axis=-1)
    if representation.root == 0:
        return replace(motion, translation=motion.translation + offset)
    above = motion.skeleton.parents[representation.root]
    local = rotate_vectors(invert_quaternions(motion.global_rotations()[:, above]), offset)
    name = representation.joints[0]
    places = motion.joint_translations[name] + local
    return replace(motion, joint_translations={**motion.joint_translations, name: places})


def full_frames(motion: Motion, fps: float) -> int:
    """Return the number of frames of a motion at the full rate."""
    return max(1, int(np.floor(motion.n_frames / motion.fps * fps + 0.5)))


def _widened(where: np.ndarray) -> Tensor:
    """Return weights (T,): 1 where `where` is true, falling smoothly to 0 around it."""
    where = where.astype(np.float64)
    return torch.from_numpy(np.maximum(where, gaussian_filter1d(where, 1.0, mode="nearest")))
