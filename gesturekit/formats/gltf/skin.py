"""Skin of a body for the player: the mesh at rest, animated by linear blend skinning.

The player blends the four joints with the greatest weights of each vertex on the graphics card;
pose-dependent corrections of the body model are left out (`BodyModel.vertices` has them).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from gesturekit.motion.body_model import BodyModel
from gesturekit.motion.rotations import steady_signs

if TYPE_CHECKING:
    from gesturekit.motion import Motion

INFLUENCES = 4
"""Joints that move a vertex, as many as WebGL's vertex shaders take at once."""


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
    """

    vertices: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    rest: np.ndarray
    regions: np.ndarray | None = None
    palette: np.ndarray | None = None

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
