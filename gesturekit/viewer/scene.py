"""Pictures of one figure: its meshes, its panel of a video (camera, floor, shadow), and stills.

Stills show a skinned body from the front, without perspective, on nothing.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gesturekit.motion.body_model import INFLUENCES, Skin, steady_turns
from gesturekit.motion.rotations import rotate_vectors
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.figure import LEFT, MIDDLE, RIGHT, Figure, Limb
from gesturekit.viewer.human import palette_of
from gesturekit.viewer.raster import (
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

COLOURS = {MIDDLE: (233, 228, 218), LEFT: (232, 138, 98), RIGHT: (93, 151, 191)}
"""Colours of the sides of the body, RGB, as in the page."""
_EYES = (43, 52, 64)
_THICK = 0.012
"""Limbs thicker than this share of the body's height are drawn round, thinner ones with corners."""
# Head: radii and centre of each ellipsoid in units of the head's height, its joint at the origin
# and its face towards +Z, as in player/body.js.
_BALLS = (
    ((0.34, 0.46, 0.41), (0.0, 0.4, 0.06), COLOURS[MIDDLE]),
    ((0.235, 0.27, 0.26), (0.0, 0.16, 0.11), COLOURS[MIDDLE]),
    ((0.045, 0.1, 0.07), (0.0, 0.3, 0.46), COLOURS[MIDDLE]),
    ((0.034, 0.045, 0.02), (-0.125, 0.41, 0.43), _EYES),
    ((0.034, 0.045, 0.02), (0.125, 0.41, 0.43), _EYES),
)


@dataclass(frozen=True)
class Mesh:
    """Triangles that N moving parts carry, by linear blend skinning.

    Attributes:
        vertices: (V, 3) float32, in the frame of the parts that move them.
        normals: (V, 3) float32 unit vectors.
        colours: (V, 3) float32 RGB, 0 to 255.
        parts: (V, 4) int32, indices of the parts that move a vertex.
        weights: (V, 4) float32, their weights; the sum is 1, and those that are 0 come last.
        faces: (F, 3) int32, counter-clockwise from outside.
    """

    vertices: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    parts: np.ndarray
    weights: np.ndarray
    faces: np.ndarray


class Mannequin:
    """Mesh of a figure's limbs and head, and its transforms.

    Attributes:
        mesh: part k is limb k; the head is the last part.
    """

    def __init__(self, figure: Figure) -> None:
        self._figure = figure
        limbs = figure.limbs
        self._ends = np.array([limb.ends for limb in limbs], dtype=np.intp).reshape(-1, 2)
        self._across = np.array([limb.across or (0, 0) for limb in limbs], dtype=np.intp)
        self._across = self._across.reshape(-1, 2)
        self._is_flat = np.array([limb.across is not None for limb in limbs], dtype=bool)
        self._widths = np.array([limb.width for limb in limbs])
        self._lengths = np.array([limb.length for limb in limbs])
        pieces = [_limb(limb, figure.height) for limb in limbs]
        owners = list(range(len(pieces)))
        if figure.head:
            balls = [_ball(*ball, figure.head_size) for ball in _BALLS]
            owners += [len(limbs)] * len(balls)
            pieces += balls
        self.mesh = _joined(pieces, owners)

    def transforms(self, time: float) -> np.ndarray:
        """Return (N, 3, 4) float32 transforms from each part to the world at `time` seconds."""
        points = _between(self._figure.points, time * self._figure.fps)
        start, end = points[self._ends[:, 0]], points[self._ends[:, 1]]
        along, real = _unit(end - start, (0.0, 1.0, 0.0))
        # Any axis will do around a round limb; a flat one lies along the line `across`.
        aside = np.where(np.abs(along[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
        line = points[self._across[:, 1]] - points[self._across[:, 0]]
        aside = np.where(self._is_flat[:, None], line, aside)
        aside -= (aside * along).sum(axis=1, keepdims=True) * along
        aside, _ = _unit(aside, (1.0, 0.0, 0.0))
        depth = np.cross(aside, along)
        stretch = real / self._lengths
        columns = [aside * self._widths[:, None], along * stretch[:, None], depth, start]
        matrices = np.stack(columns, axis=-1)
        if self._figure.head:
            matrices = np.concatenate([matrices, _head_transform(points, self._figure.head)[None]])
        return matrices.astype(np.float32)


class SkinnedBody:
    """Skin on a motion, with linear blend skinning of four joints a vertex, and the face's morphs.

    Attributes:
        mesh: part k is joint k.
        figure: the body's.
    """

    def __init__(self, drawn: DrawnBody, skin: Skin, index: int = 0) -> None:
        """Prepare one of the skins of `drawn`; clothes have another colour with each `index`."""
        self.figure, self._turns = drawn.figure, steady_turns(drawn.motion)
        self._rest = drawn.scale * skin.rest
        palette, regions = np.array([COLOURS[MIDDLE]]), np.zeros(len(skin.vertices), int)
        if skin.regions is not None:
            palette, regions = palette_of(skin, index), skin.regions
        self.mesh = Mesh(
            (drawn.scale * skin.vertices).astype(np.float32),
            skin.normals().astype(np.float32),
            palette[regions].astype(np.float32),
            skin.joints.astype(np.int32),
            (skin.weights / 255).astype(np.float32),
            skin.faces.astype(np.int32),
        )
        self._face = _morphs(skin, drawn)

    def mesh_at(self, time: float) -> Mesh:
        """Return the mesh at rest with the face at `time` seconds."""
        if self._face is None:
            return self.mesh
        values, moved, moves = self._face
        vertices, normals = self.mesh.vertices.copy(), self.mesh.normals.copy()
        now = _between(values, time * self.figure.fps).astype(np.float32)
        for of_mesh, each in zip((vertices, normals), np.tensordot(now, moves, axes=1)):
            of_mesh[moved] += each
        return replace(self.mesh, vertices=vertices, normals=normals)

    def transforms(self, time: float) -> np.ndarray:
        """Return (J, 3, 4) float32 transforms from the rest pose to the world."""
        frame = time * self.figure.fps
        points = _between(self.figure.points, frame)[: len(self._rest)]
        turns = _between(self._turns, frame)
        turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
        axes = np.broadcast_to(np.eye(3), (len(turns), 3, 3))
        turned = np.swapaxes(rotate_vectors(turns[:, None], axes), 1, 2)
        places = points - np.einsum("jab,jb->ja", turned, self._rest)
        return np.concatenate([turned, places[..., None]], axis=-1).astype(np.float32)


def _morphs(skin: Skin, drawn: DrawnBody) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return what a motion's face does to the finest skin, None if it does nothing.

    Returns:
        values (T, C) of the channels that move anything; the K vertices that they move; (C, 2, K,
        3) displacements of these and of their normals by each channel, in the size of the body.
    """
    if drawn.face is None or skin is not drawn.skins[0]:
        return None
    names, values = drawn.face.names, drawn.face.values
    normals, moves = skin.normals(), np.zeros((len(names), 2, *skin.vertices.shape), np.float32)
    for name, of_channel in zip(names, moves):
        morph = skin.morphs[name]
        of_channel[0, morph.vertices] = morph.offsets
        of_channel[1] = replace(skin, vertices=skin.vertices + of_channel[0]).normals() - normals
    moves[:, 0] *= drawn.scale
    moved = np.flatnonzero(moves.any(axis=(0, 1, 3)))
    return values, moved, moves[:, :, moved]


def _lit(
    body: Mannequin | SkinnedBody, time: float, sun: np.ndarray, camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) in the world and their colours (V, 3) at `time` seconds.

    `sun` (3,) points to the light; `camera` (4, 3) is as in `Camera.at`.
    """
    mesh = body.mesh_at(time) if isinstance(body, SkinnedBody) else body.mesh
    vertices, normals, colours = (np.empty_like(mesh.vertices) for _ in range(3))
    about = mesh.vertices, mesh.normals, mesh.parts, mesh.weights
    place(*about, body.transforms(time), vertices, normals)
    light(normals, mesh.colours, sun, camera[2].astype(np.float32), colours)
    return vertices, colours


def _between(values: np.ndarray, frame: float) -> np.ndarray:
    """Interpolate values (T, ...) at a frame that need not be whole; beyond the ends they stay."""
    at = min(max(frame, 0.0), len(values) - 1.0)
    before = int(at)
    after = min(before + 1, len(values) - 1)
    return values[before] + (at - before) * (values[after] - values[before])


def _unit(vectors: np.ndarray, otherwise: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors (N, 3), `otherwise` for those without a direction, and lengths (N,)."""
    lengths = np.linalg.norm(vectors, axis=-1)
    unit = vectors / np.maximum(lengths, 1e-9)[:, None]
    return np.where(lengths[:, None] > 1e-9, unit, otherwise), lengths


def _head_transform(points: np.ndarray, head: tuple[int, int, int]) -> np.ndarray:
    base, top, face = points[list(head)]
    up, _ = _unit((top - base)[None], (0.0, 1.0, 0.0))
    forward = (face - base)[None]
    forward, _ = _unit(forward - (forward * up).sum() * up, (0.0, 0.0, 1.0))
    return np.stack([np.cross(up, forward)[0], up[0], forward[0], base], axis=-1)


_Piece = tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, int, int]]
"""Vertices, normals, faces and colour."""
_NOTHING: _Piece = (np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), (0, 0, 0))


def _limb(limb: Limb, height: float) -> _Piece:
    """Return a limb along +Y from 0 to its length, round at both ends."""
    start, end = limb.radii
    is_thick = max(start, end) > _THICK * height
    n_arc, n_around = (5, 16) if is_thick else (3, 8)
    # Where the spheres at the ends meet the cone between them without a crease.
    lean = np.arcsin(np.clip((start - end) / max(limb.length, 1e-6 * height), -0.95, 0.95))
    low, high = np.linspace(-np.pi / 2, lean, n_arc + 1), np.linspace(lean, np.pi / 2, n_arc + 1)
    angles = np.concatenate([low, high])
    sizes = np.repeat([start, end], n_arc + 1)
    centres = np.repeat([0.0, limb.length], n_arc + 1)
    profile = np.stack([sizes * np.cos(angles), centres + sizes * np.sin(angles)], axis=1)
    vertices, normals, faces = _turned(profile, angles, n_around)
    return vertices, normals, faces, COLOURS[limb.side]


def _ball(
    radii: tuple[float, ...], centre: tuple[float, ...], colour: tuple[int, int, int], size: float
) -> _Piece:
    angles = np.linspace(-np.pi / 2, np.pi / 2, 13)
    sphere, _, faces = _turned(np.stack([np.cos(angles), np.sin(angles)], axis=1), angles, 20)
    normals = sphere / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (sphere * radii + centre) * size, normals, faces, colour


def _turned(
    profile: np.ndarray, angles: np.ndarray, n_around: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the surface made by turning a profile (radius, height) around +Y."""
    turn = 2 * np.pi * np.arange(n_around) / n_around
    around = np.stack([np.sin(turn), np.zeros(n_around), np.cos(turn)], axis=1)
    up = np.array([0.0, 1.0, 0.0])
    radius, height = profile.T
    vertices = radius[:, None, None] * around + height[:, None, None] * up
    normals = np.cos(angles)[:, None, None] * around + np.sin(angles)[:, None, None] * up
    ring = np.arange(len(profile) - 1)[:, None] * n_around
    here, beside = np.arange(n_around), np.roll(np.arange(n_around), -1)
    a, b, c, d = ring + here, ring + beside, ring + n_around + here, ring + n_around + beside
    faces = np.stack([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)])
    return vertices.reshape(-1, 3), normals.reshape(-1, 3), faces.reshape(-1, 3)


def _joined(pieces: list[_Piece], owners: list[int]) -> Mesh:
    vertices, normals, faces, colours = zip(_NOTHING, *pieces)
    sizes = list(map(len, vertices))
    firsts = np.cumsum([0, *sizes])
    parts = np.zeros((firsts[-1], INFLUENCES), np.int32)
    parts[:, 0] = np.repeat([0, *owners], sizes)
    weights = np.zeros(parts.shape, np.float32)
    weights[:, 0] = 1.0
    return Mesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        np.repeat(np.array(colours, np.float32), sizes, axis=0),
        parts,
        weights,
        np.concatenate([each + first for each, first in zip(faces, firsts)]).astype(np.int32),
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
        if framing == "face" and figure.head:  # hands may leave the view
            points = points[:, list(figure.head)]
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
        place = self.middle(time) + self.distance * self._axes[2]
        return np.concatenate([self._axes, place[None]])

    def middle(self, time: float) -> np.ndarray:
        """Return the point (3,) that is looked at."""
        frames = np.arange(len(self._path))
        return np.array([np.interp(time * self._fps, frames, axis) for axis in self._path.T])

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


_OF_THREAD = threading.local()


def _buffers(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the thread's own memory for a mesh: depths (H, W), all 0 between uses, and colours."""
    size = height, width
    held: dict[Any, tuple[np.ndarray, np.ndarray]] = vars(_OF_THREAD)
    if size not in held:
        held[size] = np.zeros(size, np.float32), np.empty((*size, 3), np.float32)
    return held[size]


class Scene:
    """A figure, its camera and its light."""

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
        self._figure = figure
        self._body: Mannequin | SkinnedBody = Mannequin(figure)
        if drawn.skins:
            skin = drawn.skins[min(level, len(drawn.skins) - 1)]
            self._body = SkinnedBody(drawn, skin, index)
        self._camera = Camera(figure, aspect, framing)
        cos, sin = np.cos(figure.front), np.sin(figure.front)
        turned = np.array(
            [cos * _SUN[0] + sin * _SUN[2], _SUN[1], cos * _SUN[2] - sin * _SUN[0]], np.float32
        )
        self._sun = turned / np.linalg.norm(turned)

    def draw(self, time: float, image: np.ndarray) -> None:
        """Draw the moment `time`, in seconds, into an image (H, W, 3) uint8."""
        height, width = image.shape[:2]
        mesh, camera = self._body.mesh, self._camera.at(time)
        focal = Camera.focal(height)
        vertices, colours = _lit(self._body, time, self._sun, camera)
        corners = np.empty_like(vertices)
        self._draw_floor(time, image, camera, vertices)
        project(vertices, camera, *(SAMPLES * n for n in (focal, width, height)), corners)
        depths, samples = _buffers(SAMPLES * height, SAMPLES * width)
        box = fill(corners, colours, mesh.faces, depths, samples)
        if box[0] < box[1]:
            resolve(depths, samples, box, image)

    def _draw_floor(
        self, time: float, image: np.ndarray, camera: np.ndarray, vertices: np.ndarray
    ) -> None:
        """Draw the floor, and the shadow of the vertices, as seen by a camera."""
        height, width = image.shape[:2]
        focal, floor = Camera.focal(height), self._camera.floor
        fallen, corners = np.empty_like(vertices), np.empty_like(vertices)
        cast(vertices, self._sun, floor, fallen)
        project(fallen, camera, focal / 2, width / 2, height / 2, corners)
        shadow, scratch = _buffers(-(-height // 2), -(-width // 2))
        box = fill(corners, fallen, self._body.mesh.faces, shadow, scratch)
        if box[0] < box[1]:
            radius = max(1, round(_SOFTNESS * height / 2))
            blur(shadow, box, radius, scratch.reshape(3, *shadow.shape)[0])
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


def still(body: SkinnedBody, frame: int, n_pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the body's picture at a frame, drawn with (n_pixels, n_pixels), and its place.

    Returns:
        RGBA (H, W, 4) from 0 to 1, cut to the body; left, right, bottom and top (4,), metres
        from the root's place on the floor.
    """
    mesh, figure, n = body.mesh, body.figure, SAMPLES * n_pixels
    cos, sin = np.cos(figure.front), np.sin(figure.front)
    camera = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos], [0, 0, 0]], float)
    root = figure.points[frame, 0]
    middle = np.array([root[0], figure.floor, root[2]])
    # Skin reaches beyond the points, as the crown of the head does.
    farthest = np.linalg.norm(figure.points[frame] - middle, axis=-1).max()
    reach = max(1.1 * figure.height, farthest + 0.1 * figure.height)
    far = _AWAY * figure.height
    camera[3] = middle + far * camera[2]
    sun = (_LIGHT @ camera[:3]).astype(np.float32)
    vertices, colours = _lit(body, frame / figure.fps, sun, camera)
    corners = np.empty_like(vertices)
    project(vertices, camera, 0.5 * n * far / reach, n, n, corners)
    depths, samples = np.zeros((n, n), np.float32), np.zeros((n, n, 3), np.float32)
    fill(corners, colours, mesh.faces, depths, samples)
    seen = (depths > 0)[..., None]
    blocks = np.concatenate([samples * seen / 255, seen], axis=-1)
    blocks = blocks.reshape(n_pixels, SAMPLES, n_pixels, SAMPLES, 4)
    image = blocks.mean(axis=(1, 3))
    image[..., :3] /= np.maximum(image[..., 3:], 1e-6)
    covered = image[..., 3] > 0
    if not covered.any():  # smaller than a sample
        covered[:] = True
    rows, columns = (np.flatnonzero(covered.any(axis=axis)) for axis in (1, 0))
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    edges = np.array([left, right, n_pixels - bottom, n_pixels - top])
    extent = reach * (2 * edges / n_pixels - 1)
    return np.clip(image[top:bottom, left:right], 0, 1), extent
