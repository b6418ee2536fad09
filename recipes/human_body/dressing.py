"""Meshes of the human body at set-up: clothes, hair and lips as colours with straight hems."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.linalg import norm

REGIONS = ("skin", "hair", "top", "trousers", "shoes", "eye", "iris", "lips", "mouth", "teeth")
"""Parts of the surface that have a colour each; "mouth" is its inside."""

_FACE = [REGIONS.index(name) for name in ("eye", "iris", "lips", "mouth", "teeth")]
_SMOOTHING = {"top": 25, "trousers": 8}
"""Steps of Taubin smoothing that turn skin into cloth."""
_IN, _OUT = 0.5, -0.48
_HEM = 0.04
"""Metres of the top below the lowest joint of the spine."""
_SLEEVE, _CUFF = 0.97, 0.035
"""End of the sleeves along the forearms, and metres of the shoes above the ankles."""
_COLLAR_TILT = 0.35
"""Metres by which the collar is lower for each metre to the front."""

_LIPS, _LIPS_WIDTH = np.array([-0.0015, 0.0215, 0.108]), 0.024
"""Middle between the lips and 15 mm behind, from the head's joint, and half their width; metres."""
_MOUTH, _RADII = np.array([-0.0015, 0.032, 0.0662]), np.array([0.0399, 0.0542, 0.0574])
"""Middle from the head's joint, and radii, of an ellipsoid with the inside of the mouth; metres."""

_Hem = tuple[Callable[[np.ndarray], np.ndarray], set[str], str, str]
"""A field of places (N, 3) that is zero at the hem; bones whose faces it cuts; region where the
field is positive, and region of faces that have none yet where it is not."""


@dataclass
class Mesh:
    """A triangle mesh: vertices (V, 3), weights of all bones (V, B), faces (F, 3), regions (F,).

    `morphs` (V, C, 3) are what C face channels add to the vertices.
    """

    vertices: np.ndarray
    weights: np.ndarray
    faces: np.ndarray
    regions: np.ndarray
    morphs: np.ndarray


def dressed(mesh: Mesh, bones: list[str], heads: np.ndarray) -> Mesh:
    """Return the mesh cut along hems and hairline, each face with its region."""
    has_face = np.isin(mesh.regions, _FACE).any()
    for hem, kinds, inside, outside in _hems(bones, heads, has_face):
        at = [k for k, bone in enumerate(bones) if bone in kinds]
        faces = np.isin(_dominant(mesh), at) & ~np.isin(mesh.regions, _FACE)
        mesh = _cut(mesh, hem(mesh.vertices), faces)
        faces = np.isin(_dominant(mesh), at) & ~np.isin(mesh.regions, _FACE)
        is_inside = hem(mesh.vertices[mesh.faces].mean(axis=1)) > 0
        region = np.where(is_inside, REGIONS.index(inside), REGIONS.index(outside))
        mesh.regions = np.where(faces & (is_inside | (mesh.regions < 0)), region, mesh.regions)
    return mesh


def _dominant(mesh: Mesh) -> np.ndarray:
    """Return the bone (F,) that moves each face most."""
    return mesh.weights[mesh.faces].sum(axis=1).argmax(axis=1)


def _hems(bones: list[str], heads: np.ndarray, has_face: bool) -> Iterator[_Hem]:
    """Yield the borders between regions; later ones cover earlier ones."""

    def at(bone: str) -> np.ndarray:
        return heads[bones.index(bone)]

    waist, neck, head = at("Spine")[1] - _HEM, at("Neck"), at("Head")
    trunk = {"Hips", "Spine", "Spine1", "Spine2", "LeftShoulder", "RightShoulder", "Neck", "Head"}
    yield lambda p: p[:, 1] - waist, trunk, "top", "trousers"
    yield (
        lambda p: (p - neck)[:, 1] + _COLLAR_TILT * (p - neck)[:, 2] - np.abs(p - neck)[:, 0] ** 2,
        {"Spine2", "Neck", "Head"},
        "skin",
        "top",
    )
    yield lambda p: _hair(p - head), {"Head"}, "hair", "skin"
    if has_face:
        yield lambda p: _lips(p - head), {"Head"}, "lips", "skin"
        yield lambda p: 1 - norm((p - head - _MOUTH) / _RADII, axis=1), {"Head"}, "mouth", "skin"

    def of_side(side: str) -> Iterator[_Hem]:
        elbow, wrist = at(f"{side}ForeArm"), at(f"{side}Hand")
        arm = {f"{side}Arm", f"{side}ForeArm", *(b for b in bones if b.startswith(f"{side}Hand"))}
        along = (wrist - elbow) / ((wrist - elbow) @ (wrist - elbow))
        yield lambda p: (p - elbow) @ along - _SLEEVE, arm, "skin", "top"
        foot = {f"{side}{bone}" for bone in ("UpLeg", "Leg", "Foot", "ToeBase")}
        ankle = at(f"{side}Foot")[1] + _CUFF
        yield lambda p: ankle - p[:, 1], foot, "shoes", "trousers"

    yield from of_side("Left")
    yield from of_side("Right")


def _hair(places: np.ndarray) -> np.ndarray:
    """Return a field that is positive where the head has hair; metres from its joint."""
    x, y, z = places.T
    front = y - 0.152 - 0.25 * np.maximum(np.abs(x) - 0.03, 0)
    back = np.minimum(np.minimum(0.02 + 0.25 * y - z, y - 0.01), 0.076 - np.abs(x))
    return np.maximum(front, back)


def _lips(places: np.ndarray) -> np.ndarray:
    """Return a field that is positive on the lips; metres from the head's joint."""
    x, y, z = (places - _LIPS).T
    arch = 1 - (x / _LIPS_WIDTH) ** 2
    bow = 0.0012 * np.exp(-((x / 0.004) ** 2))
    return np.minimum(np.minimum(0.0118 * arch - bow - y, y + 0.0115 * arch), z)


def _cut(mesh: Mesh, field: np.ndarray, among: np.ndarray) -> Mesh:
    """Return the mesh with the faces `among` (F,) cut where a field (V,) is zero."""
    above = field[mesh.faces] > 0
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), above.argmin(axis=1))
    crossed = among & above.any(axis=1) & ~above.all(axis=1)
    rows = np.flatnonzero(crossed)
    if not len(rows):
        return mesh
    a, b, c = (mesh.faces[rows, (lone[rows] + k) % 3] for k in range(3))
    edges = np.sort(np.concatenate([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=1)
    edges, of_edges = np.unique(edges, axis=0, return_inverse=True)
    first, second = edges.T
    share = field[first] / (field[first] - field[second])
    vertices, weights, morphs = (
        np.concatenate([x, x[first] + (share * (x[second] - x[first]).T).T])
        for x in (mesh.vertices, mesh.weights, mesh.morphs)
    )
    p, q = np.split(of_edges.reshape(-1) + len(field), 2)
    pieces = [np.stack(corners, axis=1) for corners in ((a, p, q), (p, b, c), (p, c, q))]
    return Mesh(
        vertices,
        weights,
        np.concatenate([mesh.faces[~crossed], *pieces]),
        np.concatenate([mesh.regions[~crossed], *[mesh.regions[rows]] * 3]),
        morphs,
    )


def clothed(mesh: Mesh) -> np.ndarray:
    """Return the vertices (V, 3) of the full body, smooth where they are covered.

    Hems stay where they are.
    """
    n_vertices, corners = len(mesh.vertices), mesh.faces.shape[1]
    starts = mesh.faces.ravel()
    ends = np.roll(mesh.faces, -1, axis=1).ravel()
    count = np.bincount(starts, minlength=n_vertices)
    vertices = mesh.vertices.copy()
    for name, steps in _SMOOTHING.items():
        inside = np.bincount(
            starts, np.repeat(mesh.regions == REGIONS.index(name), corners), minlength=n_vertices
        )
        moves = inside == count
        for step in range(2 * steps):
            mean = (
                np.stack(
                    [np.bincount(starts, vertices[ends, axis], n_vertices) for axis in range(3)],
                    axis=1,
                )
                / np.maximum(count, 1)[:, None]
            )
            vertices[moves] += (_IN, _OUT)[step % 2] * (mean - vertices)[moves]
    return vertices


def split(mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """Return the mesh with a vertex for each region at it, and the vertices' regions (V,)."""
    corners = mesh.faces * len(REGIONS) + mesh.regions[:, None]
    used, faces = np.unique(corners, return_inverse=True)
    vertices, regions = np.divmod(used, len(REGIONS))
    faces = faces.reshape(-1, 3)
    at = mesh.vertices[vertices], mesh.weights[vertices], faces, regions, mesh.morphs[vertices]
    return Mesh(*at), regions
