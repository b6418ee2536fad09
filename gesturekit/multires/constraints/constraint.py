"""What a motion is held to while it is made: after each level, before the next one adds detail.

As inpainting in a coarse-to-fine pyramid: finer levels see what is held, and fit the rest to it.
A hold is called with the number of a level and all that it made, (1, D, T_i) normalised, and gives
back what goes on to the next level.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from gesturekit.motion.heading import headings, side_axis
from gesturekit.motion.parts import unidentified, upper_body
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    quaternion_from_sixd,
    sixd_from_quaternion,
)
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.training.data import Normaliser

Hold = Callable[[int, Tensor], Tensor]

_SWAY = 0.03
"""Metres (of the reference body) by which the hips sway about a path, at most."""
_SWAY_SECONDS = 0.3
"""Spread of the average that tells the sway from the way, and a body's turns from its facing."""
_BELIEVABLE = 3.0
"""Spreads from their mean that steps have, at most, for networks that go on from them."""


class PathHold:
    """Holds the root to a path over the ground, and turns the body to where the path looks.

    A network knows the ways that its recordings faced, and no others. So it is told the path's
    steps as the body sees them, in its own facing of the moment, and the whole is turned to face
    along the path when it is made. The hips keep the fast part of their sway, 3 cm at most.

    Args:
        path: T frames at the full rate, in metres of the reference body.
        representation: of the vectors.
        normaliser: of the vectors.
        lengths: frames of each level; the last is T or, with margins, 2 `margin` more.
        margin: frames before the path and after it, where it goes on as it begins and ends.
    """

    def __init__(
        self,
        path: RootPath,
        representation: MultiresRepresentation,
        normaliser: Normaliser,
        lengths: Sequence[int],
        margin: int = 0,
    ) -> None:
        self.path = path.smoothed()
        self.representation, self.normaliser, self.lengths = representation, normaliser, lengths
        self.fps = path.fps
        mean = representation.decode(normaliser.mean[None].double().numpy(), self.fps)
        self.side = side_axis([mean], representation.root)
        steps = np.diff(self.path.positions, axis=0, prepend=self.path.positions[:1])
        steps[0] = steps[min(1, len(steps) - 1)]
        around = np.concatenate([steps, self.path.headings[:, None]], axis=1)
        self._told = torch.from_numpy(np.pad(around, ((margin, margin), (0, 0)), mode="edge").T)

    def __call__(self, level: int, made: Tensor) -> Tensor:
        """Steps of a level's own facing that lead along the path."""
        values = plain_values(self.normaliser, made)
        turn, steps = self._turn_and_steps(values)
        values[:, [-3, -1]] = turned_plane(steps, -turn)
        held = normalised(self.normaliser, values)
        return held if level + 1 == len(self.lengths) else believable_steps(held)

    def placed(self, values: np.ndarray) -> np.ndarray:
        """(T, D) what the last level made and was held, turned to lie along the path."""
        turn, _ = self._turn_and_steps(values)
        return turned(values, turn)

    def _turn_and_steps(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(T_i,) radians from the network's world to the path's, and (T_i, 2) steps in the latter,
        in metres per frame of the full rate."""
        n_frames = len(values)
        stride = self.lengths[-1] / n_frames
        slow = _SWAY_SECONDS * self.fps / stride
        told = resample(self._told, n_frames).T.numpy()
        facing = headings(quaternion_from_sixd(values[:, :6]), self.side)
        turn = told[:, 2] - gaussian_filter1d(facing, slow, mode="nearest")
        way = np.cumsum(values[:, [-3, -1]] * stride, axis=0)
        sway = way - gaussian_filter1d(way, slow, axis=0, mode="nearest")
        far = np.linalg.norm(sway, axis=1, keepdims=True)
        sway *= _SWAY * np.tanh(far / _SWAY) / np.maximum(far, 1e-9)
        sway = turned_plane(sway, turn)
        moved = np.diff(sway, axis=0, prepend=sway[:1])
        return turn, told[:, :2] + moved / stride


class KeyframeHold:
    """Holds what is slow in a motion to keyframes, and leaves to finer levels what is fast.

    Args:
        given: (T_k, D) vectors of the coarse level that was edited.
        edited: (T_k, D) bool, what of it was edited; see `editing.keep_unedited`.
        representation: of the vectors; contact labels are not held, as edited files have none.
        normaliser: of the vectors.
    """

    def __init__(
        self,
        given: np.ndarray,
        edited: np.ndarray,
        representation: MultiresRepresentation,
        normaliser: Normaliser,
    ) -> None:
        self.given = normalised(normaliser, given)
        self.weight = _spread(edited.any(axis=1)).to(self.given.dtype)
        self.channels = torch.ones(given.shape[1], 1)
        self.channels[representation.layout.contacts] = 0
        free = np.ones(given.shape[1], bool)
        free[representation.layout.contacts] = False
        rig = representation.skeleton
        upper = () if unidentified(rig) else upper_body(rig)
        for name in set(representation.joints) & set(upper):
            free[representation.joint_columns(name)] = False
        # Where all was given, nobody moved the feet to where they are.
        feet = edited[:, free].any(axis=1)
        self._stepped = _spread(feet & ~feet.all())

    def __call__(self, level: int, made: Tensor) -> Tensor:
        """What a level made, drawn to the keyframes where they were edited."""
        n_frames = made.shape[-1]
        wanted = (resample(self.given, n_frames) - made).numpy()
        # Half a frame of the edited level: slower than this is what the level can hold. Taken
        # twice, for a filter that leaves less of what is slow.
        slow = 0.5 * n_frames / self.given.shape[-1]
        missing = _average(wanted, slow)
        missing += _average(wanted - missing, slow)
        return made + resample(self.weight, n_frames) * self.channels * torch.from_numpy(missing)

    def stepped(self, n_frames: int) -> np.ndarray:
        """(T,) 1 where the legs or the root were edited, 0 away from there: feet stand as given."""
        return resample(self._stepped, n_frames).numpy()


def turned(values: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Motion vectors (T, D) turned about the world's Y, frame by frame or all alike (radians)."""
    values = values.copy()
    angle = np.broadcast_to(angle, len(values))
    about_y = quaternion_from_rotation_vector(angle[:, None] * np.array([0.0, 1.0, 0.0]))
    root = multiply_quaternions(about_y, quaternion_from_sixd(values[:, :6]))
    values[:, :6] = sixd_from_quaternion(root)
    values[:, [-3, -1]] = turned_plane(values[:, [-3, -1]], angle)
    return values


def believable_steps(held: Tensor) -> Tensor:
    """Normalised vectors (1, D, T) for a next level, none of their steps beyond what it knows.

    Of a body that always stood it would make anything, told that it walks.
    """
    held = held.clone()
    held[:, [-3, -1]] = held[:, [-3, -1]].clamp(-_BELIEVABLE, _BELIEVABLE)
    return held


def fastest_second(steps: np.ndarray, fps: float) -> float:
    """m/s of the fastest second (or of all that there is) of steps over the ground, (T, 2)."""
    window = max(1, min(len(steps), round(fps)))
    way = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    far = np.linalg.norm(way[window:] - way[:-window], axis=1)
    return float(far.max(initial=0.0) * fps / window)  # a single frame has no steps


def turned_plane(plane: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """(T, 2) x and z turned about Y; a quarter turn leads from +Z to +X."""
    x, z = plane.T
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.stack([x * cosine + z * sine, z * cosine - x * sine], axis=-1)


def _average(values: np.ndarray, spread: float) -> np.ndarray:
    return gaussian_filter1d(values, spread, axis=-1, mode="nearest")


def _spread(where: np.ndarray) -> Tensor:
    """(T,) 1 where it is true, falling to 0 beside it."""
    where = where.astype(np.float64)
    return torch.from_numpy(np.maximum(where, _average(where, 1.0)))


def plain_values(normaliser: Normaliser, vectors: Tensor) -> np.ndarray:
    """(T, D) float64 in their own units, from (1, D, T) normalised."""
    return normaliser.inverse(vectors)[0].T.double().numpy().copy()


def normalised(normaliser: Normaliser, values: np.ndarray) -> Tensor:
    """Inverse of `plain_values`."""
    return normaliser.forward(torch.from_numpy(values.T).float()[None])
