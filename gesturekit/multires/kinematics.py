"""Joint positions and speeds of motion vectors, differentiable, for losses."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from gesturekit.errors import ConfigError
from gesturekit.motion.parts import arm_joints
from gesturekit.motion.torch_kinematics import PointKinematics, foot_kinematics, sixd_to_matrix
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.resampling import reflect
from gesturekit.state.channels import StateChannels

SMOOTHING_SECONDS = 0.1
"""Standard deviation of the Gaussian that smooths rotations before arm speed is computed, and the
speed itself. Fixed: targets and losses must use the same."""

CAPTURE_SECONDS = 0.03
"""Standard deviation of the Gaussian that removes capture noise from recorded rotations before
acceleration is computed. Fixed, as it depends on motion capture only."""
_FLOORS = 1.0, 10.0
"""Added to arm speed (rad/s) and acceleration (rad/s^2) before the logarithm, so that slow movement
counts little."""


class VectorKinematics(nn.Module):
    """Positions and speeds of motion vectors (B, D, T) in their own units.

    Lengths are in metres of the reference body (`ModelJoints.scale`), so that losses do not depend
    on body size. At every level, displacements are per full-rate frame: `stride` is the number of
    full-rate frames between two frames of the level.
    """

    def __init__(
        self, representation: MultiresRepresentation, fps: float, arms: bool = True
    ) -> None:
        super().__init__()
        skeleton = representation.skeleton
        self.fps = fps
        self.layout = representation.layout
        modelled = [skeleton.index(name) for name in representation.joints]
        self.joints = PointKinematics(representation, modelled)
        self.feet = foot_kinematics(representation)
        self.arms: list[int] = []
        if not arms:
            return
        missing = [name for name in arm_joints(skeleton) if name not in representation.joints]
        if missing:
            raise ConfigError(
                f"joints: {', '.join(missing)} are missing; the losses on arms need them: add "
                "them, or set losses.arm_speed=0 losses.arm_acceleration=0"
            )
        self.arms = [representation.joints.index(name) for name in arm_joints(skeleton)]

    def _sixd(self, values: Tensor) -> Tensor:
        """Return the 6D rotations (B, K, 6, T) of the modelled joints."""
        return values[:, self.layout.rotations].unflatten(1, (-1, 6))

    def _positions(self, points: PointKinematics, values: Tensor) -> Tensor:
        """Return positions (B, T, n, 3), metres, with the root above the origin."""
        sixd = self._sixd(values).index_select(1, points.turned)
        rotations = sixd_to_matrix(sixd.permute(0, 3, 1, 2))
        return points(rotations, values[:, self.layout.root_height])

    def places(self, values: Tensor) -> Tensor:
        """Return joint positions (B, K, 3, T), metres, with the root above the origin."""
        return self._positions(self.joints, values).permute(0, 2, 3, 1)

    def _root_displacement(self, values: Tensor) -> Tensor:
        """Return the root's horizontal displacement (B, T, 3) since the previous frame, metres."""
        dx, dz = values[:, self.layout.root_xz].unbind(dim=1)
        return torch.stack([dx, torch.zeros_like(dx), dz], dim=-1)

    def foot_velocity(self, values: Tensor, stride: float, time: str = "second") -> Tensor:
        """Return the velocity (B, T - 1, F, 3) of the foot points in the world; see
        `LossConfig.contact_time`."""
        assert self.feet is not None
        feet = self._positions(self.feet, values)
        change, drift = feet[:, 1:] - feet[:, :-1], self._root_displacement(values)[:, 1:, None]
        return change + drift if time == "frame" else (change / stride + drift) * self.fps

    def contact_labels(self, values: Tensor) -> Tensor:
        """Return (B, T - 1, F) the contact labels of all frames but the first."""
        return values[:, self.layout.contacts, 1:].transpose(1, 2)

    def bend(self, values: Tensor, places: Tensor, stride: float) -> Tensor:
        """Return the second difference (B, K, 3, T - 2) of the joint positions in the world,
        metres.

        It is per full-rate frame. `places` are the joint positions of `values`.
        """
        drift = self._root_displacement(values).transpose(1, 2)[:, None]
        bend = places[..., 2:] - 2 * places[..., 1:-1] + places[..., :-2]
        return bend / stride**2 + (drift[..., 2:] - drift[..., 1:-1]) / stride

    def arm_speed(
        self, values: Tensor, stride: float, smoothing: float = SMOOTHING_SECONDS
    ) -> Tensor:
        """Return the summed angular speed (B, T) of shoulders and elbows, rad/s.

        Rotations are smoothed by a Gaussian of `smoothing` seconds, so that trembling does not
        count as speed. The angle between frames is the chord |R' - R| / sqrt 2, which is accurate
        for small angles and has a gradient everywhere. Frame 0 copies frame 1.
        """
        arms = self._arms(values, stride, smoothing)
        speed = _size(arms[..., 1:] - arms[..., :-1]) * (self.fps / stride)
        return torch.cat([speed[:, :1], speed], dim=1)

    def arm_acceleration(self, values: Tensor, stride: float, smoothing: float = 0.0) -> Tensor:
        """Return the summed angular acceleration (B, T) of shoulders and elbows, rad/s^2.

        It is |R'' - 2 R' + R| / sqrt 2 of three frames, which includes changes of the rotation
        axis. The first and last frame copy their neighbours; it is 0 for fewer than three frames.
        `smoothing` as in `arm_speed`.
        """
        if values.shape[-1] < 3:
            return values.new_zeros(len(values), values.shape[-1])
        arms = self._arms(values, stride, smoothing)
        bend = _size(arms[..., 2:] - 2 * arms[..., 1:-1] + arms[..., :-2])
        bend = bend * (self.fps / stride) ** 2
        return torch.cat([bend[:, :1], bend, bend[:, -1:]], dim=1)

    def arm_movement(self, values: Tensor, stride: float) -> Tensor:
        """Return `log_movement` (B, 2, T) of generated motion, trembling included."""
        speed = self.arm_speed(values, stride)
        return log_movement(speed, self.arm_acceleration(values, stride), stride / self.fps)

    def recorded_arm_movement(self, values: Tensor, stride: float) -> Tensor:
        """Return `log_movement` (B, 2, T) of recordings, without capture noise."""
        speed = self.arm_speed(values, stride, smoothing=0.0)
        acceleration = self.arm_acceleration(values, stride, smoothing=CAPTURE_SECONDS)
        return log_movement(speed, acceleration, stride / self.fps)

    def _arms(self, values: Tensor, stride: float, smoothing: float) -> Tensor:
        """Return smoothed rotation matrices (B, 4, 3, 3, T) of shoulders and elbows."""
        rotations = sixd_to_matrix(self._sixd(values)[:, self.arms].permute(0, 3, 1, 2))
        return smooth(rotations.movedim(1, -1), smoothing * self.fps / stride)


@torch.no_grad()
def measured_state(
    vectors: np.ndarray, representation: MultiresRepresentation, channels: StateChannels, fps: float
) -> np.ndarray:
    """Return the state of movement (C, T) of motion vectors (T, D), in their own units."""
    values = torch.from_numpy(vectors.T[None]).float()
    places = VectorKinematics(representation, fps, arms=False).places(values)
    return channels(places, fps)[0].double().numpy()


def log_movement(speed: Tensor, acceleration: Tensor, frame_seconds: float) -> Tensor:
    """Return (B, 2, T) smoothed logarithms (sigma 0.1 s) of (B, T) arm movement.

    Args:
        speed: (B, T), rad/s.
        acceleration: (B, T), rad/s^2.
        frame_seconds: time between two frames.
    """
    both = torch.stack([speed, acceleration], dim=1)
    added = both.new_tensor(_FLOORS)[:, None]
    return torch.log(smooth(both, SMOOTHING_SECONDS / frame_seconds) + added)


def _size(change: Tensor) -> Tensor:
    """Return the summed angle (B, T), radians, of differences of matrices (B, J, 3, 3, T)."""
    return (change.square().sum(dim=(2, 3)) / 2 + 1e-10).sqrt().sum(dim=1)


def smooth(x: Tensor, sigma: float) -> Tensor:
    """Filter (..., T) by a Gaussian of `sigma` frames, cut at 3 sigma, reflected at the ends."""
    reach = int(3 * sigma)
    if reach == 0:
        return x
    at = torch.arange(-reach, reach + 1, device=x.device, dtype=x.dtype)
    kernel = torch.exp(-0.5 * (at / sigma) ** 2)
    return reflect(x, reach).unfold(-1, 2 * reach + 1, 1) @ (kernel / kernel.sum())
