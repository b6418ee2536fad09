"""Places of points in motion vectors, differentiable, for losses and the state of movement."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gesturekit.diffusion.motion_vector import DeltaRepresentation
from gesturekit.motion.rotations import matrix_from_quaternion
from gesturekit.motion.torch_kinematics import PointKinematics, rotation_vector_to_matrix


class VectorPlaces(nn.Module):
    """Places of points, metres on the reference body, in axes that turn with the root's heading.

    Args:
        representation: of the motion vectors.
        points: kinematics of the points; None for the modelled joints.
    """

    references: Tensor

    def __init__(
        self, representation: DeltaRepresentation, points: PointKinematics | None = None
    ) -> None:
        super().__init__()
        self.representation = representation
        self.points = points or PointKinematics(representation, representation.indices)
        references = torch.from_numpy(matrix_from_quaternion(representation.references)).float()
        self.register_buffer("references", references[self.points.turned])

    def forward(self, values: Tensor) -> Tensor:
        """Return (B, T, P, 3) of motion vectors (B, T, X) in their own units."""
        maps = values[..., self.representation.map_columns].unflatten(-1, (-1, 3))
        maps = maps.index_select(2, self.points.turned)
        rotations = self.references @ rotation_vector_to_matrix(maps)
        return self.points(rotations, values[..., self.representation.height_column])
