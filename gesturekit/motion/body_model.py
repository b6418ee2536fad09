"""Body models of the SMPL family, read from the user's files: joints, skin, foot vertices.

Loper et al. 2015. The skin at rest is `template + shapes . betas`; the joints at rest are a fixed
mixture of its vertices; a pose adds small corrections to the skin and then carries each vertex
with the joints it is weighted to (linear blend skinning). A `Skin` is such a mesh, for the player.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from audio_features.archive import Archive, open_archive
from gesturekit.errors import FormatError, MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import matrix_from_quaternion, steady_signs
from gesturekit.motion.skeleton import Skeleton, forward_kinematics, global_rotations, has_shape

FOOT_VERTICES = {
    6890: (3216, 3226, 3387, 6617, 6624, 6787),
    10475: (5770, 5780, 8846, 8463, 8474, 8635),
}
"""Left big toe, left small toe, left heel and the same of the right foot, by the number of vertices
of the mesh: SMPL and SMPL-H share one, SMPL-X has another (as in the package smplx, vertex_ids)."""

_FAMILIES = {22: "smpl", 24: "smpl", 52: "smplh"}
"""Names of models and of their folders by number of joints; that of all others is smplx."""
_MAX_VERTICES, _MAX_JOINTS = 200_000, 256
_OFF_ONE = 0.01  # that weights in single precision may sum to
_CHUNK = 1 << 20  # numbers of one step of skinning


@dataclass(frozen=True, eq=False)
class BodyModel:
    """Skin and joints at rest, as functions of the body shape. Metres, Y up.

    Attributes:
        template: (V, 3) vertices of the mean body.
        faces: (F, 3) indices of vertices, counter-clockwise from outside.
        shapes: (V, 3, B) what each of the B betas adds to them.
        pose_corrections: (V, 3, 9 (J - 1)) what each entry of the joints' rotation matrices less
            the identity adds, the root's left out; or None.
        regressor: (J, V) joints at rest as mixtures of vertices.
        weights: (V, J) how much each vertex goes with each joint; rows sum to 1.
        parents: of the joints, -1 for the root.
        feet: six vertices: big toe, small toe and heel of the left foot, then of the right.
        source: the file.
    """

    template: np.ndarray
    faces: np.ndarray
    shapes: np.ndarray
    pose_corrections: np.ndarray | None
    regressor: np.ndarray
    weights: np.ndarray
    parents: tuple[int, ...]
    feet: tuple[int, ...] | None = None
    source: str = ""

    def __repr__(self) -> str:
        return f"BodyModel({self.source!r}, {self.n_vertices} vertices, {self.n_joints} joints)"

    @property
    def n_joints(self) -> int:
        """Number of joints J."""
        return len(self.parents)

    @property
    def n_vertices(self) -> int:
        """Number of vertices V."""
        return len(self.template)

    @classmethod
    def of(cls, model: BodyModel | str | os.PathLike[str], skeleton: Skeleton) -> BodyModel:
        """Return the model itself, that of a file, or one of a folder; files are cached.

        A folder, or its subfolder smplx, smplh or smpl, holds files such as SMPLX_FEMALE.npz. The
        number of joints and the gender of the skeleton choose one: SMPL-X for a rig of another
        family, neutral for an unknown gender.

        Raises:
            FormatError: no such file, or a folder without the one that is needed.
        """
        if isinstance(model, BodyModel):
            return model
        path = Path(model)
        if path.is_dir():
            path = _file_for(path, skeleton)
        try:
            stamp = path.stat().st_mtime_ns
        except OSError as error:
            raise FormatError(f"{path}: no such body model: {error.strerror}") from None
        return _remembered(str(path), stamp)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, feet: Sequence[int] | None = None) -> BodyModel:
        """Read the npz file of an SMPL, SMPL-H or SMPL-X model.

        Arrays of SMPL-X that are pickled (`joint2num`, ...) are not needed and not loaded.
        `J_regressor` may stand in the parts of a sparse matrix: `J_regressor_data`,
        `J_regressor_indices` and `J_regressor_indptr`.

        Args:
            path: the .npz file.
            feet: the six foot vertices, where the mesh is none of those of `FOOT_VERTICES`.

        Raises:
            FormatError: missing, damaged, pickled, or arrays that do not fit one another.
        """
        path = Path(path)
        if path.suffix.lower() == ".pkl":
            raise FormatError(f"{path}: a pickle can run code; use the model's .npz file")
        with open_archive(path, FormatError) as archive:
            return _read(archive, feet)

    def vertices_at_rest(
        self, betas: ArrayLike = (), indices: Sequence[int] | np.ndarray | None = None
    ) -> np.ndarray:
        """(N, 3) vertices of the unmoved body, all of them or those named, metres."""
        at = slice(None) if indices is None else list(indices)
        betas = self._betas(betas)
        shaped = self.template[at] + self.shapes[at][..., : len(betas)] @ betas
        return shaped.astype(np.float64)

    @cached_property
    def _shaped_joints(self) -> np.ndarray:
        """(J, 3, B) what each of the betas adds to the joints at rest."""
        by_shape = self.regressor @ self.shapes.reshape(self.n_vertices, -1)
        return by_shape.reshape(self.n_joints, 3, -1).astype(float)

    def joints_at_rest(self, betas: ArrayLike = ()) -> np.ndarray:
        """(J, 3) joints of the unmoved body, metres."""
        betas = self._betas(betas)
        mean = (self.regressor @ self.template).astype(float)
        return mean + self._shaped_joints[..., : len(betas)] @ betas

    def rig(self, skeleton: Skeleton) -> Skeleton:
        """Return the skeleton with the offsets of its `body_shape`, and foot vertices as end sites.

        A foot vertex is fixed to the joint with the largest skinning weight.

        Raises:
            MotionError: the skeleton's tree differs from the model's.
        """
        if skeleton.parents != self.parents:
            both = f"{self.n_joints} joints and the rig {skeleton.n_joints}"
            raise MotionError(f"the body model has {both}, or their hierarchies differ")
        shape = skeleton.body_shape
        joints = self.joints_at_rest(shape.betas)
        offsets = joints - joints[np.maximum(self.parents, 0)]
        offsets[0] = joints[0]
        ends: dict[str, tuple[np.ndarray, ...]] = {}
        if self.feet:
            for vertex, place in zip(self.feet, self.vertices_at_rest(shape.betas, self.feet)):
                joint = int(self.weights[vertex].argmax())
                name = skeleton.names[joint]
                ends[name] = (*ends.get(name, ()), place - joints[joint])
        shape = replace(shape, pelvis=tuple(joints[0]))
        return replace(skeleton, offsets=offsets, end_sites=ends, body_shape=shape)

    def vertices(self, motion: Motion) -> np.ndarray:
        """(T, V, 3) world positions of vertices under a motion, metres, for its `body_shape`.

        Face expressions are not applied, and fingers turn from the model's flat hand.

        Args:
            motion: on a rig with the model's joints; its own offsets do not matter.

        Raises:
            MotionError: a rig with other joints.
        """
        rig, betas = self.rig(motion.skeleton), motion.skeleton.body_shape.betas
        rest, joints = self.vertices_at_rest(betas), self.joints_at_rest(betas)
        weights = self.weights.astype(np.float64)
        corrections = None
        if self.pose_corrections is not None:
            corrections = self.pose_corrections.reshape(3 * self.n_vertices, -1).T
        moved = np.empty((motion.n_frames, self.n_vertices, 3))
        chunk = max(1, _CHUNK // (9 * max(self.n_vertices, self.n_joints)))
        for start in range(0, motion.n_frames, chunk):
            part = slice(start, start + chunk)
            local = motion.rotations[part]
            turns = matrix_from_quaternion(global_rotations(local, rig))
            places = forward_kinematics(local, motion.translation[part], rig)
            skin = rest[None]
            if corrections is not None:
                bends = (matrix_from_quaternion(local[:, 1:]) - np.eye(3)).reshape(len(local), -1)
                added = bends.astype(corrections.dtype) @ corrections
                skin = rest + added.reshape(len(local), -1, 3)
            # A vertex goes with joint j to R_j (v - J_j) + p_j; the mixture of maps is one map.
            steps = places - np.einsum("tjab,jb->tja", turns, joints)
            turn = np.tensordot(turns, weights, axes=(1, 1))  # (t, a, b, n)
            turned = (turn * skin.transpose(0, 2, 1)[:, None]).sum(axis=2)
            moved[part] = turned.transpose(0, 2, 1) + weights @ steps
        return moved

    def _betas(self, betas: ArrayLike) -> np.ndarray:
        """(B,) coefficients, at most as many as the model has; none for the mean body."""
        betas = np.asarray(betas, dtype=np.float64).ravel()
        return betas[: self.shapes.shape[-1]]


def _file_for(folder: Path, skeleton: Skeleton) -> Path:
    """Return the file of a folder of models that suits the size and gender of a rig."""
    family = _FAMILIES.get(skeleton.n_joints, "smplx")
    wanted = f"{family}_{skeleton.body_shape.gender or 'neutral'}".upper()
    for place in (folder, folder / family):
        for file in sorted(place.glob("*.npz")):
            if file.stem.upper().startswith(wanted):  # or SMPLX_NEUTRAL_2020.npz
                return file
    raise FormatError(f"{folder}: no {wanted}.npz, nor in its subfolder {family}; add or name one")


@lru_cache(maxsize=3)
def _remembered(path: str, stamp: int) -> BodyModel:
    return BodyModel.load(path)


def _read(archive: Archive, feet: Sequence[int] | None) -> BodyModel:
    template = _numbers(archive, "v_template", None, 3)
    n_vertices = len(template)
    is_mesh = 0 < n_vertices <= _MAX_VERTICES
    _require(archive, is_mesh, f"v_template has shape {template.shape}")
    weights = _numbers(archive, "weights", n_vertices, None)
    n_joints = weights.shape[1]
    _require(archive, 0 < n_joints <= _MAX_JOINTS, f"weights has shape {weights.shape}")
    shapes = np.zeros((n_vertices, 3, 0), np.float32)
    if "shapedirs" in archive:
        shapes = _numbers(archive, "shapedirs", n_vertices, 3, None)
        if n_joints == 55:  # SMPL-X: 300 shapes and 100 expressions of the face, or 10 and 10
            shapes = shapes[..., : 300 if shapes.shape[-1] >= 400 else 10]
    corrections = None
    if "posedirs" in archive:
        corrections = _numbers(archive, "posedirs", n_vertices, 3, 9 * (n_joints - 1))
    faces = archive["f"]
    are_faces = faces.dtype.kind in "iu" and has_shape(faces, (None, 3))
    _require(archive, are_faces, f"f has shape {faces.shape} of {faces.dtype}")
    inside = not len(faces) or 0 <= int(faces.min()) <= int(faces.max()) < n_vertices
    _require(archive, inside, f"f names vertices that are not among {n_vertices}")
    feet = FOOT_VERTICES.get(n_vertices) if feet is None else tuple(feet)
    are_feet = not feet or (len(feet) == 6 and 0 <= min(feet) <= max(feet) < n_vertices)
    _require(archive, are_feet, f"foot vertices {list(feet or ())} are not six of {n_vertices}")
    are_shares = (weights >= 0).all() and (np.abs(weights.sum(axis=1) - 1) <= _OFF_ONE).all()
    _require(archive, are_shares, "weights of a vertex are negative, or do not sum to 1")
    return BodyModel(
        template=template,
        faces=faces.astype(np.int64),
        shapes=shapes,
        pose_corrections=corrections,
        regressor=_regressor(archive, n_joints, n_vertices),
        weights=weights,
        parents=_parents(archive, n_joints),
        feet=feet,
        source=str(archive.path),
    )


def _require(archive: Archive, holds: bool | np.bool_, why: str) -> None:
    if not holds:
        raise FormatError(f"{archive.path}: {why}; expected a model of the SMPL family")


def _numbers(archive: Archive, key: str, *shape: int | None) -> np.ndarray:
    """Return finite float32 of a shape, in which None is any number."""
    array = archive.numbers(key, np.float32)
    _require(archive, has_shape(array, shape), f"{key} has shape {array.shape}, not {shape}")
    _require(archive, np.isfinite(array).all(), f"{key} holds numbers that are not finite")
    return array


def _parents(archive: Archive, n_joints: int) -> tuple[int, ...]:
    table = archive.numbers("kintree_table")
    table = table[0] if table.ndim == 2 and len(table) else table
    is_row = table.shape == (n_joints,) and np.isfinite(table).all()
    why = f"kintree_table of shape {table.shape} is not {n_joints} finite numbers"
    _require(archive, is_row, why)
    # The root's parent is -1, or what 2^32 wraps it to.
    parents = (-1, *map(int, table[1:]))
    is_tree = all(0 <= parent < j for j, parent in enumerate(parents) if j)
    _require(archive, is_tree, "kintree_table is not a tree with parents before children")
    return parents


def _regressor(archive: Archive, n_joints: int, n_vertices: int) -> np.ndarray:
    """(J, V) float32, from a plain array or the parts of a compressed sparse matrix."""
    shape = (n_joints, n_vertices)
    if "J_regressor" in archive or "J_regressor_data" not in archive:
        return _numbers(archive, "J_regressor", *shape)
    from scipy.sparse import csc_array, csr_array

    data = _numbers(archive, "J_regressor_data", None)
    indices, starts = archive["J_regressor_indices"], archive["J_regressor_indptr"]
    kind = csr_array if starts.shape == (n_joints + 1,) else csc_array
    try:
        sparse = kind((data, indices, starts), shape=shape)
        sparse.check_format(full_check=True)
    except (TypeError, ValueError) as error:
        _require(archive, False, f"J_regressor is not a sparse matrix of shape {shape} ({error})")
    return sparse.toarray()


INFLUENCES = 4
"""Joints that move a vertex, as many as WebGL's vertex shaders take at once."""


@dataclass(frozen=True, eq=False)
class Morph:
    """Displacement of some vertices of a skin at rest, by a face channel of value 1.

    Attributes:
        vertices: (K,) indices of the vertices.
        offsets: (K, 3) metres; values of the channel scale them.
    """

    vertices: np.ndarray
    offsets: np.ndarray


@dataclass(frozen=True, eq=False)
class Skin:
    """Mesh of a body at rest, and the joints that move it.

    Attributes:
        vertices: (V, 3) at rest, metres.
        faces: (F, 3) uint32, counter-clockwise from outside.
        joints: (V, 4) uint8, indices of the joints that move a vertex.
        weights: (V, 4) uint8, their weights, in units of 1/255; those that are 0 come last.
        rest: (J, 3) joints at rest, metres.
        regions: (V,) uint8, the part of the surface that gives a vertex its colour; None for a
            body of one colour.
        palette: (R, 3) uint8, RGB of the regions; None for those of the human body.
        morphs: by the name of a channel of `FaceTrack`.
    """

    vertices: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    rest: np.ndarray
    regions: np.ndarray | None = None
    palette: np.ndarray | None = None
    morphs: Mapping[str, Morph] = field(default_factory=dict)

    @classmethod
    def of(cls, body: BodyModel, betas: ArrayLike = ()) -> Skin:
        """Return the mesh with the four greatest weights of each vertex, scaled to a sum of one."""
        n_joints = min(INFLUENCES, body.n_joints)
        joints = np.argsort(-body.weights, axis=1, kind="stable")[:, :n_joints]
        weights = np.take_along_axis(body.weights, joints, axis=1).astype(np.float64)
        padding = ((0, 0), (0, INFLUENCES - n_joints))
        joints, weights = whole_weights(np.pad(joints, padding), np.pad(weights, padding))
        return cls(
            vertices=body.vertices_at_rest(betas),
            faces=body.faces.astype(np.uint32),
            joints=joints,
            weights=weights,
            rest=body.joints_at_rest(betas),
        )

    def normals(self) -> np.ndarray:
        """Return unit normals (V, 3) at rest: the mean of the adjacent faces' by area.

        Vertices at one place, which belong to several regions, share theirs.
        """
        _, same = unique_rows(self.vertices)
        corners = same[self.faces]
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        of_faces = np.cross(b - a, c - a)
        total = np.zeros(self.vertices.shape)
        for k in range(3):
            np.add.at(total, corners[:, k], of_faces)
        total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
        return total[same]


def unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first (R,) of equal rows of (V, N) in lexicographic order, and groups (V,).

    Both are those of `np.unique` along axis 0, in a third of its time.
    """
    order = np.lexsort(rows.T[::-1])
    is_new = np.ones(len(rows), bool)
    is_new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    groups = np.empty(len(rows), int)
    groups[order] = np.cumsum(is_new) - 1
    return order[is_new], groups


def whole_weights(joints: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return joints and weights (V, 4) as in `Skin`: the greatest first, in units of 1/255.

    The sums of the given weights must be above 0.
    """
    order = np.argsort(-weights, axis=1, kind="stable")
    joints, weights = (np.take_along_axis(values, order, axis=1) for values in (joints, weights))
    weights = np.floor(255 * weights / weights.sum(axis=1, keepdims=True) + 0.5)
    weights[:, 0] += 255 - weights.sum(axis=1)  # what rounding took or gave
    return joints.astype(np.uint8), weights.astype(np.uint8)


def steady_turns(motion: Motion) -> np.ndarray:
    """Return (T, J, 4) world rotations with continuous signs."""
    return steady_signs(motion.global_rotations())
