"""Meshes of a figure: the mannequin's limbs and head, or the skin of a body model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gesturekit.formats.gltf.skin import INFLUENCES, Skin, steady_turns
from gesturekit.motion.rotations import rotate_vectors
from gesturekit.viewer.anatomy import LEFT, MIDDLE, RIGHT
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.figure import Figure, Head, Limb
from gesturekit.viewer.human.body import palette_of

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
            balls = [_ball(*ball, figure.head.size) for ball in _BALLS]
            owners += [len(limbs)] * len(balls)
            pieces += balls
        self.mesh = _joined(pieces, owners)

    def transforms(self, time: float) -> np.ndarray:
        """Return (N, 3, 4) float32 transforms from each part to the world at `time` seconds."""
        points = points_at(self._figure, time)
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
    """Skin on a motion, with linear blend skinning of four joints a vertex.

    Attributes:
        mesh: part k is joint k.
    """

    def __init__(
        self, drawn: DrawnBody, skin: Skin, top: tuple[int, int, int] | None = None
    ) -> None:
        """Prepare one of the skins of `drawn`; `top` is the colour of its clothes."""
        self._figure, self._turns = drawn.figure, steady_turns(drawn.motion)
        self._rest = drawn.scale * skin.rest
        palette = np.array([COLOURS[MIDDLE]])
        if skin.palette is not None:
            palette = skin.palette
        elif skin.regions is not None:
            palette = np.array(list(palette_of(top).values()))
        regions = np.zeros(len(skin.vertices), int) if skin.regions is None else skin.regions
        self.mesh = Mesh(
            (drawn.scale * skin.vertices).astype(np.float32),
            skin.normals().astype(np.float32),
            palette[regions].astype(np.float32),
            skin.joints.astype(np.int32),
            (skin.weights / 255).astype(np.float32),
            skin.faces.astype(np.int32),
        )

    def transforms(self, time: float) -> np.ndarray:
        """Return (J, 3, 4) float32 transforms from the rest pose to the world."""
        points = points_at(self._figure, time)[: len(self._rest)]
        turns = _between(self._turns, time * self._figure.fps)
        turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
        axes = np.broadcast_to(np.eye(3), (len(turns), 3, 3))
        turned = np.swapaxes(rotate_vectors(turns[:, None], axes), 1, 2)
        places = points - np.einsum("jab,jb->ja", turned, self._rest)
        return np.concatenate([turned, places[..., None]], axis=-1).astype(np.float32)


def points_at(figure: Figure, time: float) -> np.ndarray:
    """Return the figure's points (P, 3) at `time` seconds, interpolated between its frames."""
    return _between(figure.points, time * figure.fps)


def _between(values: np.ndarray, frame: float) -> np.ndarray:
    at = min(max(frame, 0.0), len(values) - 1.0)
    before = int(at)
    after = min(before + 1, len(values) - 1)
    return values[before] + (at - before) * (values[after] - values[before])


def _unit(vectors: np.ndarray, otherwise: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors (N, 3), `otherwise` for those without a direction, and lengths (N,)."""
    lengths = np.linalg.norm(vectors, axis=-1)
    unit = vectors / np.maximum(lengths, 1e-9)[:, None]
    return np.where(lengths[:, None] > 1e-9, unit, otherwise), lengths


def _head_transform(points: np.ndarray, head: Head) -> np.ndarray:
    base = points[head.base]
    up, _ = _unit((points[head.up] - base)[None], (0.0, 1.0, 0.0))
    forward = (points[head.face] - base)[None]
    forward, _ = _unit(forward - (forward * up).sum() * up, (0.0, 0.0, 1.0))
    return np.stack([np.cross(up, forward)[0], up[0], forward[0], base], axis=-1)


_Piece = tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, int, int]]
"""Vertices, normals, faces and colour."""


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
    sizes = [len(piece[0]) for piece in pieces]
    firsts = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    parts = np.zeros((firsts[-1], INFLUENCES), np.int32)
    parts[:, 0] = np.repeat(owners, sizes)
    weights = np.zeros(parts.shape, np.float32)
    weights[:, 0] = 1.0
    faces = [piece[2] + first for piece, first in zip(pieces, firsts)]
    nothing = np.empty((0, 3))
    return Mesh(
        np.concatenate([nothing, *(piece[0] for piece in pieces)]).astype(np.float32),
        np.concatenate([nothing, *(piece[1] for piece in pieces)]).astype(np.float32),
        np.repeat(np.array([piece[3] for piece in pieces]).reshape(-1, 3), sizes, axis=0).astype(
            np.float32
        ),
        parts,
        weights,
        np.concatenate([nothing, *faces]).astype(np.int32),
    )
