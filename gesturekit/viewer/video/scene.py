"""Pictures of one figure: its panel of a video (camera, floor, shadow, body), and stills.

Stills show a skinned body from the front, without perspective, on nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.figure import Figure
from gesturekit.viewer.human.body import TOPS
from gesturekit.viewer.video.mesh import Mannequin, SkinnedBody
from gesturekit.viewer.video.raster import (
    SAMPLES,
    blur,
    cast,
    fill,
    light,
    paint_floor,
    place,
    project,
    resolve,
)

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

    def __init__(self, figure: Figure, aspect: float, framing: str = "whole") -> None:
        """Fit the view; `aspect` is its width by its height, `framing` one of FRAMINGS."""
        points, lowest = figure.points, figure.floor + figure.below(framing)
        middle = np.median(points, axis=1)  # a joint that is left behind does not count
        self._path = gaussian_filter1d(middle, _CALM * figure.fps, axis=0, mode="nearest")
        self._fps, self.floor = figure.fps, figure.floor
        if lowest > figure.floor:
            points = np.maximum(points, [-np.inf, lowest, -np.inf])
            # Near the body's middle its thickness needs no room: the view is cut there.
            figure = replace(figure, points=points, floor=lowest, limbs=())
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


_SUN = np.array([1.0, 2.6, 1.0])
"""Direction to the sun from a body that faces +Z."""
_SHADE = 0.30
_SOFTNESS = 0.008
"""Radius of the shadow's blur as a share of the panel's height."""
_GROUND = 5.0
"""Radius of the floor in body heights."""


class Buffers:
    """Memory for drawing one frame of a panel; threads do not share it."""

    def __init__(self, height: int, width: int) -> None:
        fine = (SAMPLES * height, SAMPLES * width)
        coarse = (-(-height // 2), -(-width // 2))
        self.depths, self.samples = np.zeros(fine, np.float32), np.empty((*fine, 3), np.float32)
        self.shadow, self.scratch = np.zeros(coarse, np.float32), np.empty(coarse, np.float32)
        self.scratch_colours = np.empty((*coarse, 3), np.float32)


class Scene:
    """A figure, its camera and its light.

    Attributes:
        duration: seconds of its motion.
    """

    def __init__(
        self,
        drawn: DrawnBody,
        aspect: float,
        level: int = 0,
        index: int = 0,
        framing: str = "whole",
    ) -> None:
        """Prepare a motion on its body.

        Args:
            drawn: the motion.
            aspect: width by height of the panel.
            level: of the skin, the last one if there are fewer.
            index: of the panel; clothes have another colour in each.
            framing: one of FRAMINGS of `gesturekit.viewer.figure`.
        """
        figure = drawn.figure
        self.duration = drawn.motion.duration
        self._figure = figure
        self._body: Mannequin | SkinnedBody = Mannequin(figure)
        if drawn.skins:
            skin = drawn.skins[min(level, len(drawn.skins) - 1)]
            self._body = SkinnedBody(drawn, skin, TOPS[index % len(TOPS)])
        self._camera = Camera(figure, aspect, framing)
        cos, sin = np.cos(figure.front), np.sin(figure.front)
        turned = np.array(
            [cos * _SUN[0] + sin * _SUN[2], _SUN[1], cos * _SUN[2] - sin * _SUN[0]], np.float32
        )
        self._sun = turned / np.linalg.norm(turned)

    def draw(self, time: float, image: np.ndarray, buffers: Buffers) -> None:
        """Draw the moment `time`, in seconds, into an image (H, W, 3) uint8."""
        height, width = image.shape[:2]
        mesh, camera = self._body.mesh, self._camera.at(time)
        focal = Camera.focal(height)
        vertices, normals, colours, corners = (np.empty_like(mesh.vertices) for _ in range(4))
        place(
            *(mesh.vertices, mesh.normals, mesh.parts, mesh.weights),
            *(self._body.transforms(time), vertices, normals),
        )
        light(normals, mesh.colours, self._sun, camera[2].astype(np.float32), colours)
        self._draw_floor(time, image, (camera, vertices), buffers)
        project(vertices, camera, *(SAMPLES * n for n in (focal, width, height)), corners)
        box = fill(corners, colours, mesh.faces, buffers.depths, buffers.samples)
        if box[0] < box[1]:
            resolve(buffers.depths, buffers.samples, box, image)

    def _draw_floor(
        self, time: float, image: np.ndarray, seen: tuple[np.ndarray, np.ndarray], buffers: Buffers
    ) -> None:
        """Draw the floor, and the shadow of the vertices, as seen by a camera."""
        (camera, vertices), faces = seen, self._body.mesh.faces
        height, width = image.shape[:2]
        focal, floor = Camera.focal(height), self._camera.floor
        fallen, corners = np.empty_like(vertices), np.empty_like(vertices)
        cast(vertices, self._sun, floor, fallen)
        project(fallen, camera, focal / 2, width / 2, height / 2, corners)
        shadow = buffers.shadow
        box = fill(corners, fallen, faces, shadow, buffers.scratch_colours)
        if box[0] < box[1]:
            blur(shadow, box, max(1, round(_SOFTNESS * height / 2)), buffers.scratch)
        body = self._figure.height
        metre = 10.0 ** round(np.log10(body / 1.7))
        x, _, z = self._camera.middle(time)
        size = max(_GROUND * body, 0.8 * self._camera.distance)
        ground = np.array([floor, x, z, size, metre])
        paint_floor(image, camera, focal, ground, shadow, np.float32(_SHADE))
        shadow[box[0] : box[1], box[2] : box[3]] = 0


_AWAY = 200.0
"""Distance of the camera in body heights, from where there is next to no perspective."""
_LIGHT = np.array([0.34, 0.87, 0.34])
"""Direction to the light: x to the viewer's right, y up, z towards the viewer."""


class Stills:
    """Pictures of one motion."""

    def __init__(self, drawn: DrawnBody, n_pixels: int, index: int = 0) -> None:
        """Prepare pictures of up to (n_pixels, n_pixels); `index` chooses the clothes' colour."""
        self._body = SkinnedBody(drawn, drawn.skins[0], TOPS[index % len(TOPS)])
        self._figure, self._size = drawn.figure, n_pixels

    def at(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the body's picture at a frame, and its place.

        Returns:
            RGBA (H, W, 4) from 0 to 1, cut to the body; left, right, bottom and top (4,), metres
            from the root's place on the floor.
        """
        mesh, figure, n = self._body.mesh, self._figure, SAMPLES * self._size
        cos, sin = np.cos(figure.front), np.sin(figure.front)
        camera = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos], [0, 0, 0]], float)
        root = figure.points[frame, 0]
        middle = np.array([root[0], figure.floor, root[2]])
        # Skin reaches beyond the points, as the crown of the head does.
        farthest = np.linalg.norm(figure.points[frame] - middle, axis=-1).max()
        reach = max(1.1 * figure.height, farthest + 0.1 * figure.height)
        far = _AWAY * figure.height
        camera[3] = middle + far * camera[2]
        vertices, normals, colours, corners = (np.empty_like(mesh.vertices) for _ in range(4))
        place(
            *(mesh.vertices, mesh.normals, mesh.parts, mesh.weights),
            *(self._body.transforms(frame / figure.fps), vertices, normals),
        )
        sun, towards = (_LIGHT @ camera[:3]).astype(np.float32), camera[2].astype(np.float32)
        light(normals, mesh.colours, sun, towards, colours)
        project(vertices, camera, 0.5 * n * far / reach, n, n, corners)
        depths, samples = np.zeros((n, n), np.float32), np.zeros((n, n, 3), np.float32)
        fill(corners, colours, mesh.faces, depths, samples)
        seen = (depths > 0)[..., None]
        blocks = np.concatenate([samples * seen / 255, seen], axis=-1)
        blocks = blocks.reshape(self._size, SAMPLES, self._size, SAMPLES, 4)
        image = blocks.mean(axis=(1, 3))
        image[..., :3] /= np.maximum(image[..., 3:], 1e-6)
        body = image[..., 3] > 0
        if not body.any():  # smaller than a sample
            body[:] = True
        rows, columns = (np.flatnonzero(body.any(axis=axis)) for axis in (1, 0))
        top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
        edges = np.array([left, right, self._size - bottom, self._size - top])
        extent = reach * (2 * edges / self._size - 1)
        return np.clip(image[top:bottom, left:right], 0, 1), extent
