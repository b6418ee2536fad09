"""Avatars of VRM files as bodies of pages, videos and pictures: smaller meshes, and a cache."""

from __future__ import annotations

import os
from bisect import bisect_left
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from gesturekit.formats.gltf.skin import Skin, unique_rows
from gesturekit.formats.gltf.vrm import Avatar, read_avatar
from gesturekit.viewer.human.body import Human

_FINEST, _COARSE = 65_535, 5_000
"""Most vertices of the mesh in pages and videos, and of the one for slow machines."""


def load_avatar(path: str | os.PathLike[str]) -> tuple[Human, Avatar]:
    """Read an avatar, as a body with a fine and a coarse skin; the last ones are cached.

    Warns:
        UserWarning: a texture that cannot be read.

    Raises:
        FormatError: as `read_avatar` does.
    """
    path = Path(path)
    try:
        status = path.stat()
        version = status.st_mtime_ns, status.st_size
    except OSError:
        version = 0, 0  # the reader says what is wrong
    return _loaded(path.resolve(), version)


@lru_cache(maxsize=2)
def _loaded(path: Path, version: tuple[int, int]) -> tuple[Human, Avatar]:
    avatar, mesh = read_avatar(path)
    height = avatar.height
    finest = simplified(welded(mesh, height), _FINEST, height)
    return Human(avatar.skeleton, (finest, simplified(finest, _COARSE, height))), avatar


_FIRST, _GROWTH = 1 / 800, 1.25
"""Size of the first grid's cells by the body's height, and by which each next one is larger."""
_ROUNDS = 100
_SAME = 1e-5
"""Distance of vertices at one place, by the body's height."""


def welded(skin: Skin, height: float) -> Skin:
    """Return the mesh with vertices of one place and colour made one, so that no seam is seen."""
    assert skin.regions is not None
    return _clustered(skin, _SAME * height, skin.regions[:, None])


def simplified(skin: Skin, most: int, height: float) -> Skin:
    """Return a mesh of at most `most` vertices, of a body of this height in metres.

    Vertices of one cell of a grid that move with the same joint become one, so that fingers stay
    apart. The last of the grids has one cell a joint at most.
    """
    if len(skin.vertices) <= most:
        return skin
    cells = _FIRST * height * _GROWTH ** np.arange(_ROUNDS)
    apart = skin.joints[:, :1]
    k = bisect_left(cells[:-1], True, key=lambda cell: len(_groups(skin, cell, apart)[0]) <= most)
    return _clustered(skin, cells[k], apart)


def _groups(skin: Skin, cell: float, apart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first vertex of each cell with the same numbers `apart`, and groups (V,)."""
    keys = np.floor(skin.vertices / cell).astype(np.int64)
    return unique_rows(np.concatenate([keys, apart], axis=1))


def _clustered(skin: Skin, cell: float, apart: np.ndarray) -> Skin:
    """Return the mesh with one vertex for those of a cell with the same numbers `apart` (V, N)."""
    first, groups = _groups(skin, cell, apart)
    counts = np.bincount(groups)
    vertices = np.stack(
        [np.bincount(groups, skin.vertices[:, axis]) / counts for axis in range(3)], axis=1
    )
    faces = groups[skin.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return replace(
        skin,
        vertices=vertices,
        faces=faces[whole].astype(np.uint32),
        joints=skin.joints[first],
        weights=skin.weights[first],
        regions=None if skin.regions is None else skin.regions[first],
    )
