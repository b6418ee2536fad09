"""A body's skin for the player: sent once, at rest, and moved there by the joints.

The player blends linearly, on the graphics card, the four joints that matter most to each vertex;
the body model's small corrections of a bent elbow are left out. `BodyModel.vertices` has it all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gesturekit.motion.body_model.model import BodyModel

if TYPE_CHECKING:
    from gesturekit.motion import Motion

INFLUENCES = 4
"""Joints that move a vertex, as many as WebGL's vertex shaders take at once."""


@dataclass(frozen=True)
class Skin:
    """The mesh of a body model.

    Attributes:
        faces: (F, 3) uint32.
        joints: (V, 4) uint8, which joints move a vertex.
        weights: (V, 4) uint8, how much, in parts of 255.
    """

    faces: np.ndarray
    joints: np.ndarray
    weights: np.ndarray

    @classmethod
    def of(cls, body: BodyModel) -> Skin:
        """The mesh with the four greatest weights of each vertex, scaled to a sum of one."""
        n_joints = min(INFLUENCES, body.n_joints)
        joints = np.argsort(-body.weights, axis=1, kind="stable")[:, :n_joints]
        weights = np.take_along_axis(body.weights, joints, axis=1).astype(np.float64)
        weights = np.floor(255 * weights / weights.sum(axis=1, keepdims=True) + 0.5)
        weights[:, 0] += 255 - weights.sum(axis=1)  # what rounding took or gave
        padding = ((0, 0), (0, INFLUENCES - n_joints))
        return cls(
            faces=body.faces.astype(np.uint32),
            joints=np.pad(joints, padding).astype(np.uint8),
            weights=np.pad(weights, padding).astype(np.uint8),
        )


def steady_turns(motion: Motion) -> np.ndarray:
    """(T, J, 4) quaternions from the joints' frames to the world, none far from the one before.

    q and -q are one rotation; with the nearer one in each frame they can be interpolated.
    """
    turns = motion.global_rotations()
    along = (turns[1:] * turns[:-1]).sum(axis=-1)
    signs = np.cumprod(np.where(along < 0, -1.0, 1.0), axis=0)
    turns[1:] *= signs[..., None]
    return turns
