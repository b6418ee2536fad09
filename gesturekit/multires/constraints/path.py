"""Path constraint: the root follows a path over the ground."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from gesturekit.motion.heading import headings, side_axis
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import quaternion_from_sixd
from gesturekit.multires.constraints.constraint import (
    clamped_steps,
    turned,
    turned_plane,
)
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.network.resampling import resample

_SWAY = 0.03
"""Largest sway of the hips to either side of a path, metres of the reference body."""
_SWAY_SECONDS = 0.3
"""Standard deviation of the Gaussian that separates sway from progress along the path, and fast
turns of the body from its heading."""


class PathConstraint:
    """Constrain the root to a path, and turn the body to the path's headings.

    The network was trained on headings within the recordings' range. So each level gets the path's
    steps relative to the heading that it generated, and the finished motion is turned to face along
    the path. The hips keep the fast part of their sway, 3 cm at most.

    Args:
        path: T frames at the full rate, in metres of the reference body.
        representation: of the vectors.
        normaliser: of the vectors.
        lengths: frames of each level, margins included; the last is T + 2 `margin`.
        margin: frames before and after the path, with the steps of its first and last frame.
    """

    def __init__(
        self,
        path: RootPath,
        representation: MultiresRepresentation,
        normaliser: Normaliser,
        lengths: Sequence[int],
        margin: int = 0,
    ) -> None:
        path = path.smoothed()
        self.layout, self.normaliser, self.lengths = representation.layout, normaliser, lengths
        self.fps = path.fps
        mean = representation.decode(normaliser.mean[None].double().numpy(), self.fps)
        self.side = side_axis([mean], representation.root)
        steps = np.diff(path.positions, axis=0, prepend=path.positions[:1])
        steps[0] = steps[min(1, len(steps) - 1)]
        steps_and_heading = np.concatenate([steps, path.headings[:, None]], axis=1)
        padded = np.pad(steps_and_heading, ((margin, margin), (0, 0)), mode="edge")
        self._steps_and_heading = torch.from_numpy(padded.T)

    def __call__(self, level: int, output: Tensor) -> Tensor:
        """Return the output of a level, (1, D, T_i), with steps that follow the path."""
        values = self.normaliser.to_values(output)
        turn, steps = self._turn_and_steps(values)
        values[:, self.layout.root_xz] = turned_plane(steps, -turn)
        vectors = self.normaliser.from_values(values)
        is_finest = level + 1 == len(self.lengths)
        return vectors if is_finest else clamped_steps(vectors, self.layout)

    def placed(self, values: np.ndarray) -> np.ndarray:
        """Return the constrained output of the last level, (T, D), turned to lie along the path."""
        turn, _ = self._turn_and_steps(values)
        return turned(values, turn, self.layout)

    def _turn_and_steps(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return turns (T_i,) from the network's world to the path's, and its steps (T_i, 2) there.

        Radians, and metres per frame of the full rate; `values` (T_i, D) are in their own units.
        """
        n_frames = len(values)
        stride = self.lengths[-1] / n_frames
        spread = _SWAY_SECONDS * self.fps / stride
        wanted = resample(self._steps_and_heading, n_frames).T.numpy()
        root = quaternion_from_sixd(values[:, self.layout.root_rotation])
        heading = headings(root, self.side)
        turn = wanted[:, 2] - gaussian_filter1d(heading, spread, mode="nearest")
        position = np.cumsum(values[:, self.layout.root_xz] * stride, axis=0)
        sway = position - gaussian_filter1d(position, spread, axis=0, mode="nearest")
        distance = np.linalg.norm(sway, axis=1, keepdims=True)
        sway *= _SWAY * np.tanh(distance / _SWAY) / np.maximum(distance, 1e-9)
        sway = turned_plane(sway, turn)
        sway_steps = np.diff(sway, axis=0, prepend=sway[:1])
        return turn, wanted[:, :2] + sway_steps / stride
