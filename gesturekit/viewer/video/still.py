"""Still pictures of a skinned body from the front, without perspective, on nothing."""

from __future__ import annotations

import numpy as np

from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.video import raster
from gesturekit.viewer.video.mesh import SkinnedBody
from gesturekit.viewer.video.scene import TOPS

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
        mesh, figure, n = self._body.mesh, self._figure, raster.SAMPLES * self._size
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
        raster.place(
            *(mesh.vertices, mesh.normals, mesh.parts, mesh.weights),
            *(self._body.transforms(frame / figure.fps), vertices, normals),
        )
        sun, towards = (_LIGHT @ camera[:3]).astype(np.float32), camera[2].astype(np.float32)
        raster.light(normals, mesh.colours, sun, towards, colours)
        raster.project(vertices, camera, 0.5 * n * far / reach, n, n, corners)
        depths, samples = np.zeros((n, n), np.float32), np.zeros((n, n, 3), np.float32)
        raster.fill(corners, colours, mesh.faces, depths, samples)
        seen = (depths > 0)[..., None]
        blocks = np.concatenate([samples * seen / 255, seen], axis=-1)
        blocks = blocks.reshape(self._size, raster.SAMPLES, self._size, raster.SAMPLES, 4)
        image = blocks.mean(axis=(1, 3))
        image[..., :3] /= np.maximum(image[..., 3:], 1e-6)
        body = image[..., 3] > 0
        if not body.any():  # smaller than a sample
            body[:] = True
        rows, columns = (np.flatnonzero(body.any(axis=axis)) for axis in (1, 0))
        top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
        edges = np.array([left, right, self._size - bottom, self._size - top])
        place = reach * (2 * edges / self._size - 1)
        return np.clip(image[top:bottom, left:right], 0, 1), place
