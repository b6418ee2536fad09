"""Velocity of the feet in standardised motion vectors, differentiable, for the loss on it."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gesturekit.diffusion.motion_vector import DeltaRepresentation
from gesturekit.diffusion.standardiser import Standardiser
from gesturekit.motion.rotations import matrix_from_quaternion
from gesturekit.motion.torch_kinematics import PointKinematics, rotation_vector_to_matrix


class FootVelocity(nn.Module):
    """Velocity of the foot points, in axes that turn with the root's heading.

    Args:
        representation: of the motion vectors, with displacement columns.
        standardiser: of the motion vectors.
        feet: kinematics of the foot points.
        fps: frames per second.
    """

    references: Tensor

    def __init__(
        self,
        representation: DeltaRepresentation,
        standardiser: Standardiser,
        feet: PointKinematics,
        fps: float,
    ) -> None:
        super().__init__()
        self.representation, self.feet, self.fps = representation, feet, fps
        self.register_buffer("mean", standardiser.mean, persistent=False)
        self.register_buffer("scale", standardiser.scale, persistent=False)
        references = torch.from_numpy(matrix_from_quaternion(representation.references)).float()
        self.register_buffer("references", references[feet.turned], persistent=False)

    def forward(self, motion: Tensor) -> Tensor:
        """Return (B, T - 1, F, 3), m/s of the reference body, for standardised motion (B, T, X)."""
        values = Standardiser(self.mean, self.scale).inverse(motion)
        columns = self.representation
        maps = values[..., columns.map_columns].unflatten(-1, (-1, 3))
        maps = maps.index_select(2, self.feet.turned)
        rotations = self.references @ rotation_vector_to_matrix(maps)
        places = self.feet(rotations, values[..., columns.height_column])
        turn, forward, lateral = values[:, 1:, columns.root_columns].unbind(-1)
        # The displacement is relative to the heading halfway between two frames, as in `RootPath`.
        step = torch.stack([lateral, torch.zeros_like(lateral), forward], dim=-1)
        after, before = _turned(places[:, 1:], turn / 2), _turned(places[:, :-1], -turn / 2)
        return (after - before + step[:, :, None]) * self.fps


def _turned(points: Tensor, angle: Tensor) -> Tensor:
    """Rotate points (B, T, F, 3) about the Y axis by angles (B, T), radians."""
    x, y, z = points.unbind(-1)
    cosine, sine = angle.cos()[..., None], angle.sin()[..., None]
    return torch.stack([cosine * x + sine * z, y, cosine * z - sine * x], dim=-1)
