"""One figure in a panel of the picture: floor, shadow, body."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.human.body import TOPS
from gesturekit.viewer.video import raster
from gesturekit.viewer.video.camera import Camera
from gesturekit.viewer.video.mesh import Mannequin, SkinnedBody

_SUN = np.array([1.0, 2.6, 1.0])
"""Direction to the sun from a body that faces +Z."""
_SHADE = 0.30
_SOFTNESS = 0.008
"""Radius of the shadow's blur as a share of the panel's height."""
_GROUND = 5.0
"""Radius of the floor in body heights."""


@dataclass
class Buffers:
    """Memory for drawing one frame of a panel; threads do not share it."""

    height: int
    width: int
    depths: np.ndarray = field(init=False)
    samples: np.ndarray = field(init=False)
    shadow: np.ndarray = field(init=False)
    scratch: np.ndarray = field(init=False)
    scratch_colours: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        fine = (raster.SAMPLES * self.height, raster.SAMPLES * self.width)
        coarse = (-(-self.height // 2), -(-self.width // 2))
        self.depths, self.samples = np.zeros(fine, np.float32), np.empty((*fine, 3), np.float32)
        self.shadow, self.scratch = np.zeros(coarse, np.float32), np.empty(coarse, np.float32)
        self.scratch_colours = np.empty((*coarse, 3), np.float32)


class Scene:
    """A figure, its camera and its light.

    Attributes:
        duration: seconds of its motion.
    """

    def __init__(self, drawn: DrawnBody, aspect: float, level: int = 0, index: int = 0) -> None:
        """Prepare a motion on its body.

        Args:
            drawn: the motion.
            aspect: width by height of the panel.
            level: of the skin, the last one if there are fewer.
            index: of the panel; clothes have another colour in each.
        """
        figure = drawn.figure
        self.duration = drawn.motion.duration
        self._figure = figure
        self._body: Mannequin | SkinnedBody = Mannequin(figure)
        if drawn.skins:
            skin = drawn.skins[min(level, len(drawn.skins) - 1)]
            self._body = SkinnedBody(drawn, skin, TOPS[index % len(TOPS)])
        self._camera = Camera(figure, aspect)
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
        raster.place(
            *(mesh.vertices, mesh.normals, mesh.parts, mesh.weights),
            *(self._body.transforms(time), vertices, normals),
        )
        raster.light(normals, mesh.colours, self._sun, camera[2].astype(np.float32), colours)
        self._draw_floor(time, image, (camera, vertices), buffers)
        samples = raster.SAMPLES
        raster.project(vertices, camera, *(samples * n for n in (focal, width, height)), corners)
        box = raster.fill(corners, colours, mesh.faces, buffers.depths, buffers.samples)
        if box[0] < box[1]:
            raster.resolve(buffers.depths, buffers.samples, box, image)

    def _draw_floor(
        self, time: float, image: np.ndarray, seen: tuple[np.ndarray, np.ndarray], buffers: Buffers
    ) -> None:
        """Draw the floor, and the shadow of the vertices, as seen by a camera."""
        (camera, vertices), faces = seen, self._body.mesh.faces
        height, width = image.shape[:2]
        focal, floor = Camera.focal(height), self._camera.floor
        fallen, corners = np.empty_like(vertices), np.empty_like(vertices)
        raster.cast(vertices, self._sun, floor, fallen)
        raster.project(fallen, camera, focal / 2, width / 2, height / 2, corners)
        shadow = buffers.shadow
        box = raster.fill(corners, fallen, faces, shadow, buffers.scratch_colours)
        if box[0] < box[1]:
            raster.blur(shadow, box, max(1, round(_SOFTNESS * height / 2)), buffers.scratch)
        body = self._figure.height
        metre = 10.0 ** round(np.log10(body / 1.7))
        x, _, z = self._camera.middle(time)
        size = max(_GROUND * body, 0.8 * self._camera.distance)
        ground = np.array([floor, x, z, size, metre])
        raster.paint_floor(image, camera, focal, ground, shadow, np.float32(_SHADE))
        shadow[box[0] : box[1], box[2] : box[3]] = 0
