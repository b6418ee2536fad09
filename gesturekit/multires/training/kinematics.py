"""Joint positions and speeds of motion vectors, differentiable, for losses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from gesturekit.errors import ConfigError
from gesturekit.motion.parts import arm_joints
from gesturekit.motion.rotations import matrix_from_quaternion
from gesturekit.motion.torch_kinematics import ForwardKinematics, sixd_to_matrix
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.resampling import reflect

SMOOTHING_SECONDS = 0.1
"""Standard deviation of the Gaussian that smooths rotations before arm speed is computed, and the
speed itself. Fixed: targets and losses must use the same."""

CAPTURE_SECONDS = 0.03
"""Standard deviation of the Gaussian that removes capture noise from recorded rotations before
acceleration is computed. Fixed, as it depends on motion capture only."""


class _Places(nn.Module):
    """Positions of joints, or of points fixed to them, by forward kinematics."""

    fixed: Tensor
    rows: Tensor
    turned: Tensor

    def __init__(
        self,
        representation: MultiresRepresentation,
        joints: Sequence[int],
        points: np.ndarray | None = None,
    ) -> None:
        """Prepare the kinematic chain.

        Args:
            representation: of the motion vectors.
            joints: indices in the skeleton, at least one.
            points: (F, 3) offsets from these joints, metres; None for the joints themselves.
        """
        super().__init__()
        skeleton = representation.skeleton
        modelled = [skeleton.index(name) for name in representation.joints]
        # Only joints on the way from the root to the requested ones.
        needed = {modelled[0]}
        for joint in joints:
            while joint not in needed and joint >= 0:
                needed.add(joint)
                joint = skeleton.parents[joint]
        order = sorted(needed, key=lambda j: (j != modelled[0], j))
        place = {joint: i for i, joint in enumerate(order)}
        still = representation.fixed_translations
        offsets = [still.get(skeleton.names[j], skeleton.offsets[j]) for j in order]
        # All lengths are those of the reference body, as in motion vectors.
        offsets = [offset / representation.scale for offset in offsets]
        parents = [-1, *(place[skeleton.parents[j]] for j in order[1:])]
        at = [place[joint] for joint in joints]
        self.wanted: list[int] | slice = slice(None) if at == list(range(len(order))) else at
        if points is not None:
            parents = [*parents, *at]
            offsets += [point / representation.scale for point in points]
            self.wanted = slice(len(order), None)
        self.chain = ForwardKinematics(parents, np.array(offsets))
        turning = [order[i] for i in self.chain.inner.tolist()]
        held = [joint for joint in turning if joint not in modelled]
        matrices = matrix_from_quaternion(representation.fixed_rotations[held])
        self.register_buffer("fixed", torch.from_numpy(matrices).float(), persistent=False)
        # Index of each joint's rotation: modelled joints first, fixed ones after them.
        turned = [joint for joint in turning if joint in modelled]
        rows = [[*turned, *held].index(joint) for joint in turning]
        self.register_buffer("rows", torch.tensor(rows, dtype=torch.long), persistent=False)
        turned = torch.tensor([modelled.index(joint) for joint in turned], dtype=torch.long)
        self.register_buffer("turned", turned, persistent=False)

    def forward(self, sixd: Tensor, height: Tensor) -> Tensor:
        """Return positions (B, T, n, 3), metres, with the root above the origin.

        Args:
            sixd: (B, K, 6, T) rotations of the modelled joints.
            height: (B, T) of the root.
        """
        rotations = sixd_to_matrix(sixd.index_select(1, self.turned).permute(0, 3, 1, 2))
        if len(self.fixed):
            fixed = self.fixed.expand(*rotations.shape[:2], -1, -1, -1)
            rotations = torch.cat([rotations, fixed], dim=2).index_select(2, self.rows)
        root = torch.stack([torch.zeros_like(height), height, torch.zeros_like(height)], dim=-1)
        return self.chain.from_inner(rotations, root)[:, :, self.wanted]


class VectorKinematics(nn.Module):
    """Positions and speeds of motion vectors (B, D, T) in their own units.

    Lengths are in metres of the reference body (`ModelJoints.scale`), so that losses do not depend
    on body size. Displacements are per full-rate frame at every level: `stride` is the number of
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
        points = representation.foot_points
        self.joints = _Places(representation, modelled)
        self.feet = None
        if points:
            self.feet = _Places(
                representation,
                [skeleton.index(point.joint) for point in points],
                np.array([point.offset for point in points]),
            )
        self.arms: list[int] = []
        if not arms:
            return
        missing = [name for name in arm_joints(skeleton) if name not in representation.joints]
        if missing:
            raise ConfigError(
                f"joints: {', '.join(missing)} are missing; the arms must be modelled"
            )
        self.arms = [representation.joints.index(name) for name in arm_joints(skeleton)]

    def _sixd(self, values: Tensor) -> Tensor:
        """Return the 6D rotations (B, K, 6, T) of the modelled joints."""
        return values[:, self.layout.rotations].unflatten(1, (-1, 6))

    def _foot_places(self, values: Tensor) -> Tensor:
        """Return the foot points (B, T, F, 3), metres, with the root above the origin."""
        return self.feet(self._sixd(values), values[:, self.layout.root_height])

    def places(self, values: Tensor) -> Tensor:
        """Return joint positions (B, K, 3, T), metres, with the root above the origin."""
        return self.joints(self._sixd(values), values[:, self.layout.root_height]).permute(
            0, 2, 3, 1
        )

    def _root_displacement(self, values: Tensor) -> Tensor:
        """Return the root's horizontal displacement (B, T, 3) since the previous frame, metres."""
        dx, dz = values[:, self.layout.root_xz].unbind(dim=1)
        return torch.stack([dx, torch.zeros_like(dx), dz], dim=-1)

    def foot_velocity(self, values: Tensor, stride: float) -> Tensor:
        """Return (B, T - 1, F, 3) the velocity of the foot points, m/s, over the floor included."""
        feet = self._foot_places(values)
        drift = self._root_displacement(values)
        return ((feet[:, 1:] - feet[:, :-1]) / stride + drift[:, 1:, None]) * self.fps

    def contact_labels(self, values: Tensor) -> Tensor:
        """Return (B, T - 1, F) the contact labels of all frames but the first."""
        return values[:, self.layout.contacts, 1:].transpose(1, 2)

    def bend(self, values: Tensor, places: Tensor, stride: float) -> Tensor:
        """Return (B, K, 3, T - 2) the second difference of the joints' places, metres.

        It counts per full-rate frame, movement over the floor included. `places` are those of
        `values`.
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

    def _arms(self, values: Tensor, stride: float, smoothing: float) -> Tensor:
        """Return smoothed rotation matrices (B, 4, 3, 3, T) of shoulders and elbows."""
        rotations = sixd_to_matrix(self._sixd(values)[:, self.arms].permute(0, 3, 1, 2))
        return smooth(rotations.movedim(1, -1), smoothing * self.fps / stride)


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
