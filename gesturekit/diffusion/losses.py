"""Losses of the diffusion system: pure functions that return one value per clip."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gesturekit.diffusion.motion_vector import DeltaRepresentation, VectorPlaces
from gesturekit.motion.contacts import CONTACT_SPEED
from gesturekit.motion.torch_kinematics import PointKinematics
from gesturekit.state.process import StateProcess

SLIDING = 0.1
"""m/s on the reference body, the unit of `foot_sliding`."""


def denoising_error(predicted: Tensor, target: Tensor) -> Tensor:
    """Return the squared error of the network's prediction, eq. 4 of Alexanderson et al. 2023.

    Args:
        predicted: (B, T, X) noise, velocity or clean motion, as predicted by the network.
        target: (B, T, X), its target.

    Returns:
        (B,), the mean over frames and features of each clip.
    """
    return (predicted - target).square().mean(dim=(1, 2))


def change_error(predicted: Tensor, target: Tensor, spread: Tensor) -> Tensor:
    """Return the squared error of frame-to-frame changes; not in the paper.

    Args:
        predicted: (B, T, X) clean motion, as predicted by the network.
        target: (B, T, X) clean motion.
        spread: (X,) standard deviation of the recordings' changes, the unit of the error.

    Returns:
        (B,), the mean over changes and features of each clip.
    """
    return ((predicted - target).diff(dim=1) / spread).square().mean(dim=(1, 2))


def foot_sliding(predicted: Tensor, recorded: Tensor) -> Tensor:
    """Return the sliding speed of feet that are planted in the recording; not in the paper.

    The foot contact loss of Tevet et al. 2023 (MDM), with bounded gradients: a speed s, in units of
    `SLIDING`, gives the loss 2 (sqrt(1 + s^2) - 1), which is about s^2 for small s and 2 s for
    large s.

    Args:
        predicted: (B, T, F, 3) velocity of F foot points, m/s on the reference body.
        recorded: (B, T, F, 3), of the recorded motion. A point slower than `CONTACT_SPEED` is
            planted.

    Returns:
        (B,), the mean over frames and points of each clip; points that are not planted count as 0.
    """
    stands = recorded.norm(dim=-1) < CONTACT_SPEED
    squared = (predicted / SLIDING).square().sum(dim=-1)
    return (stands * 2 * ((1 + squared).sqrt() - 1)).mean(dim=(1, 2))


class FootVelocity(nn.Module):
    """Velocity of the foot points, in axes that turn with the root's heading.

    Args:
        representation: of the motion vectors, with displacement columns.
        feet: kinematics of the foot points.
        fps: frames per second.
    """

    def __init__(
        self, representation: DeltaRepresentation, feet: PointKinematics, fps: float
    ) -> None:
        super().__init__()
        self.places, self.fps = VectorPlaces(representation, feet), fps

    def forward(self, values: Tensor) -> Tensor:
        """Return (B, T - 1, F, 3), m/s of the reference body, for motion vectors (B, T, X)."""
        places = self.places(values)
        steps = values[:, 1:, self.places.representation.root_columns]
        turn, forward, lateral = steps.unbind(-1)
        # The displacement is relative to the heading halfway between two frames, as in `RootPath`.
        step = torch.stack([lateral, torch.zeros_like(lateral), forward], dim=-1)
        after, before = _turned(places[:, 1:], turn / 2), _turned(places[:, :-1], -turn / 2)
        return (after - before + step[:, :, None]) * self.fps


def _turned(points: Tensor, angle: Tensor) -> Tensor:
    """Rotate points (B, T, F, 3) about the Y axis by angles (B, T), radians."""
    x, y, z = points.unbind(-1)
    cosine, sine = angle.cos()[..., None], angle.sin()[..., None]
    return torch.stack([cosine * x + sine * z, y, cosine * z - sine * x], dim=-1)


class StateDistance(nn.Module):
    """Distance of the state of movement that a prediction shows from that of the recording.

    Args:
        representation: of the motion vectors.
        process: of the recordings.
    """

    weight: Tensor

    def __init__(self, representation: DeltaRepresentation, process: StateProcess) -> None:
        super().__init__()
        self.places = VectorPlaces(representation)
        self.channels, self.fps = process.channels, process.fps
        weight = process.channels.counts / process.scale
        self.register_buffer("weight", torch.from_numpy(weight).float()[:, None])

    def forward(self, predicted: Tensor, recorded: Tensor) -> Tensor:
        """Return (B,) for motion vectors (B, T, X), in standard deviations of the recordings."""
        shown, wanted = (
            self.channels(self.places(values).permute(0, 2, 3, 1), self.fps)
            for values in (predicted, recorded)
        )
        return (self.weight * (shown - wanted)).abs().mean(dim=(1, 2))
