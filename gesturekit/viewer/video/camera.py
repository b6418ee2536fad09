"""Camera that follows a figure of any size and shape, and frames it."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gesturekit.viewer.figure import Figure

_FIELD = np.tan(np.radians(15.0))
"""Half the height of the view at distance 1."""
_TURN, _LOOK_DOWN = 0.32, 0.16
"""Angles from the figure's front and from the horizontal, radians."""
_CALM = 0.5
"""Standard deviation of the Gaussian that the camera's path is smoothed with, seconds."""
_FILLED = 0.86
"""Largest share of the view that the figure fills."""
_USUAL = 0.98
"""Share of frames that is framed whole; the others may be a broken recording's."""
_MOST_FRAMES = 600
"""Largest number of frames that the view is fitted to."""


class Camera:
    """Path and direction of the camera of one figure.

    Attributes:
        distance: from the figure's middle, metres.
        floor: height of the ground, metres.
    """

    def __init__(self, figure: Figure, aspect: float) -> None:
        """Fit the view; `aspect` is its width by its height."""
        points = figure.points
        middle = np.median(points, axis=1)  # a joint that is left behind does not count
        self._path = gaussian_filter1d(middle, _CALM * figure.fps, axis=0, mode="nearest")
        self._fps, self.floor = figure.fps, figure.floor
        yaw = figure.front + _TURN
        level = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
        back = np.cos(_LOOK_DOWN) * level + [0.0, np.sin(_LOOK_DOWN), 0.0]
        right = np.array([level[2], 0.0, -level[0]])
        self._axes = np.stack([right, np.cross(back, right), back])
        self._choose_heights(figure, middle[:, 1])
        self.distance = self._distance(figure, aspect)

    def at(self, time: float) -> np.ndarray:
        """Return (4, 3) at `time` seconds: right, up and backward axes, and the position."""
        target = self._target(np.array([time * self._fps]))[0]
        return np.concatenate([self._axes, (target + self.distance * self._axes[2])[None]])

    def middle(self, time: float) -> np.ndarray:
        """Return the point (3,) that is looked at."""
        return self._target(np.array([time * self._fps]))[0]

    @staticmethod
    def focal(height: float) -> float:
        """Return pixels for a slope of 1 in an image of this height."""
        return 0.5 * height / _FIELD

    def _choose_heights(self, figure: Figure, middle: np.ndarray) -> None:
        """Look at a fixed height, unless the figure climbs or falls by more than its height."""
        if np.ptp(self._path[:, 1]) < figure.height:
            top = float(np.quantile(figure.points[:, :, 1].max(axis=1), _USUAL))
            low = min(figure.floor, float(np.median(figure.points[:, :, 1].min(axis=1))))
            self._path[:, 1] = 0.5 * (low + max(top, low + 0.2 * figure.height))

    def _target(self, frames: np.ndarray) -> np.ndarray:
        """Return the points (N, 3) looked at in fractional frames (N,)."""
        at = np.arange(len(self._path))
        return np.stack([np.interp(frames, at, self._path[:, axis]) for axis in range(3)], axis=1)

    def _distance(self, figure: Figure, aspect: float) -> float:
        """Return the distance from which all points are within the view, in nearly all frames."""
        n_frames = len(figure.points)
        frames = np.unique(np.linspace(0, n_frames - 1, min(n_frames, _MOST_FRAMES)).astype(int))
        offset = figure.points[frames] - self._path[frames, None]
        across, up, towards = np.moveaxis(offset @ self._axes.T, -1, 0)
        thick = max((max(limb.radii) * limb.width for limb in figure.limbs), default=0.0)
        needed = np.maximum((np.abs(up) + thick), (np.abs(across) + thick) / aspect)
        needed = (towards + thick + needed / (_FILLED * _FIELD)).max(axis=1)
        return max(float(np.quantile(needed, _USUAL)), 1e-3 * figure.height)
