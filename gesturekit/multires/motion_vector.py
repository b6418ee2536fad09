"""The motion vector of the multi-resolution model: rotations, contacts, root.

A frame is `[K x 6 | C | 3]`: the first two columns of the rotation matrix of each modelled joint
(Zhou et al. 2019), a contact label for each foot point (eq. 1 of Moreno-Villamarin et al. 2024),
and three numbers of the root, in this order: displacement along the world's x axis since the
previous frame, height, and displacement along z, all in metres of the reference body
(`ModelJoints.scale`). On SMPL with six foot points that is 24 x 6 + 6 + 3 = 153 numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.motion.contacts import CONTACT_SPEED, contact_labels, foot_points
from gesturekit.motion.model_joints import ModelJoints
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    quaternion_from_sixd,
    rotate_vectors,
    sixd_from_quaternion,
)
from gesturekit.motion.skeleton import Skeleton

_FRAMES_AT_ONCE = 1024
"""Frames decoded in one call, which bounds the memory of intermediate rotations."""

_SCALE_FLOORS = {"joint": 0.02, "contact": 0.25, "displacement": 0.025, "height": 5e-3}
"""Smallest scale of each kind of channel (6D entries, label, m/s, m; on the reference body). Fixed,
so that the noise of channels without movement is not amplified."""


@dataclass(frozen=True)
class VectorLayout:
    """Named columns of a motion vector: indices into an axis of 6 K + C + 3 numbers.

    Attributes:
        rotations: 6 K columns, for each joint the first two columns of its rotation matrix.
        root_rotation: the first six of these, the root's orientation in world coordinates.
        contacts: C columns of contact labels, about 0 or 1; over 0.5 means contact.
        root: three columns, displacement along x, height, displacement along z.
        root_xz: the first and last of these, metres since the previous frame.
        root_height: the middle one, metres.
    """

    rotations: slice
    root_rotation: slice
    contacts: slice
    root: slice
    root_xz: list[int]
    root_height: int


@dataclass(frozen=True, eq=False)
class MultiresRepresentation(ModelJoints):
    """Conversion between motions of one rig and motion vectors.

    Attributes:
        contact_speed: speed below which a foot point is in contact (eq. 1), m/s on the reference
            body.
    """

    contact_speed: float = field(default=CONTACT_SPEED, kw_only=True)

    @classmethod
    def fit(
        cls,
        motions: Sequence[Motion],
        joints: str | Sequence[str] = "body",
        contact_speed: float = CONTACT_SPEED,
    ) -> MultiresRepresentation:
        """Choose the modelled joints, and fix the others at their mean training rotation.

        Args:
            motions: motions of one rig (same names and parents); see `reference_skeleton`.
            joints: "body" (no fingers, no end joints), "all", or names.
            contact_speed: see the class.

        Raises:
            MotionError: no motions, or a name that the rig does not have.
        """
        return cls(**cls.fit_fields(motions, joints), contact_speed=contact_speed)

    @classmethod
    def from_json(cls, skeleton: Skeleton, values: dict[str, Any]) -> MultiresRepresentation:
        """Return the inverse of `to_json`."""
        speed = float(values["contact_speed"])
        return cls(**cls.fields_from_json(skeleton, values), contact_speed=speed)

    def to_json(self) -> dict[str, Any]:
        """Return all attributes but the skeleton as plain values."""
        return super().to_json() | {"contact_speed": self.contact_speed}

    @cached_property
    def foot_points(self) -> tuple:
        """C points on the feet whose contact with the floor is modelled."""
        return tuple(foot_points(self.skeleton))

    @cached_property
    def layout(self) -> VectorLayout:
        """Named columns of the motion vector."""
        contacts = 6 * len(self.joints)
        root = contacts + len(self.foot_points)
        return VectorLayout(
            rotations=slice(0, contacts),
            root_rotation=slice(0, 6),
            contacts=slice(contacts, root),
            root=slice(root, root + 3),
            root_xz=[root, root + 2],
            root_height=root + 1,
        )

    @property
    def n_features(self) -> int:
        """Length of a motion vector: 6 K + C + 3."""
        return self.layout.root.stop

    def joint_columns(self, name: str) -> slice:
        """Return the six columns of a modelled joint."""
        k = self.joints.index(name)
        return slice(6 * k, 6 * k + 6)

    @cached_property
    def block_sizes(self) -> tuple[int, ...]:
        """Numbers in each block of a skeleton-aware convolution: K of 6, C of 1 and one of 3."""
        return (6,) * len(self.joints) + (1,) * len(self.foot_points) + (3,)

    def encode(self, motion: Motion, turn: float = 0.0) -> np.ndarray:
        """Return the motion vectors of a motion, (T, 6 K + C + 3) float64.

        The root's orientation is in world coordinates. Frame 0 has the displacement of frame 1.

        Args:
            motion: T frames on this rig; bone lengths may differ.
            turn: radians about the world's Y axis by which the whole motion is turned first.

        Raises:
            MotionError: joint names or parents differ from the rig's.
        """
        self.check_rig(motion)
        rotations = motion.rotations[:, self.indices]
        about_y = quaternion_from_rotation_vector(np.array([0.0, turn, 0.0]))
        rotations[:, 0] = multiply_quaternions(about_y, motion.global_rotations()[:, self.root])
        position = rotate_vectors(about_y, motion.positions()[:, self.root])
        displacement = np.diff(position, axis=0, prepend=position[:1])
        if motion.n_frames > 1:
            displacement[0] = displacement[1]
        root = np.stack([displacement[:, 0], position[:, 1], displacement[:, 2]], axis=-1)
        root /= self.scale
        contacts = contact_labels(motion, threshold=self.contact_speed)
        sixd = sixd_from_quaternion(rotations).reshape(motion.n_frames, -1)
        return np.concatenate([sixd, contacts, root], axis=-1)

    def decode(self, values: np.ndarray, fps: float, *, skeleton: Skeleton | None = None) -> Motion:
        """Return the motion of motion vectors; it starts above the origin.

        Args:
            values: (T, 6 K + C + 3); rotations need not be orthonormal.
            fps: frames per second.
            skeleton: bone lengths to use in place of the reference ones; the root's steps and
                height scale with the length of the legs.
        """
        n_frames = len(values)
        rotations = self.fixed_pose(n_frames)
        index = self.indices
        for start in range(0, n_frames, _FRAMES_AT_ONCE):
            sixd = values[start : start + _FRAMES_AT_ONCE, self.layout.rotations]
            modelled = quaternion_from_sixd(sixd.reshape(len(sixd), len(index), 6))
            rotations[start : start + len(sixd), index] = modelled
        dx, height, dz = values[:, self.layout.root].T
        position = np.stack([np.cumsum(dx) - dx[0], height, np.cumsum(dz) - dz[0]], axis=-1)
        size = self.scale * self.size_of(skeleton)
        return self.assemble(rotations, position * size, fps, skeleton)


@dataclass(frozen=True)
class Normaliser:
    """Normalisation of motion vectors to zero mean and comparable spread, whatever the rig's units.

    The six numbers of a joint share one scale, so that distances between its rotations are kept up
    to that factor.

    Attributes:
        mean: (D,).
        scale: (D,).
    """

    mean: Tensor
    scale: Tensor

    @classmethod
    def fit(
        cls, motions: Sequence[np.ndarray], representation: MultiresRepresentation, fps: float
    ) -> Normaliser:
        """Compute mean and scale of encoded training motions, each (T, D)."""
        values = np.concatenate(motions)
        scale, root = values.std(axis=0), representation.layout.root
        sizes = np.array(representation.block_sizes[:-1])
        of_joint = np.arange(len(sizes)) < len(representation.joints)
        floors = np.where(of_joint, _SCALE_FLOORS["joint"], _SCALE_FLOORS["contact"])
        sums = np.add.reduceat(scale[: root.start] ** 2, np.cumsum(sizes) - sizes)
        scale[: root.start] = np.repeat(np.maximum(np.sqrt(sums / sizes), floors), sizes)
        dx, height, dz = scale[root]
        across = max(np.hypot(dx, dz) / np.sqrt(2), _SCALE_FLOORS["displacement"] / fps)
        scale[root] = across, max(height, _SCALE_FLOORS["height"]), across
        return cls(torch.from_numpy(values.mean(axis=0)).float(), torch.from_numpy(scale).float())

    def to(self, device: torch.device) -> Normaliser:
        """Return a copy on another device."""
        return Normaliser(self.mean.to(device), self.scale.to(device))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise motion vectors (B, D, T)."""
        return (x - self.mean[:, None]) / self.scale[:, None]

    def inverse(self, x: Tensor) -> Tensor:
        """Return normalised motion vectors (B, D, T) to their own units."""
        return x * self.scale[:, None] + self.mean[:, None]

    def to_values(self, vectors: Tensor) -> np.ndarray:
        """Return (T, D) float64 in their own units, from (1, D, T) normalised."""
        return self.inverse(vectors)[0].T.double().numpy().copy()

    def from_values(self, values: np.ndarray) -> Tensor:
        """Return (1, D, T) normalised, from (T, D) in their own units."""
        return self.forward(torch.from_numpy(values.T).float()[None])


_MAX_STEP = 3.0
"""Limit of root steps that the next level gets, in standard deviations: far outside of the training
data its output is arbitrary."""


def turned(values: np.ndarray, angle: np.ndarray | float, layout: VectorLayout) -> np.ndarray:
    """Return motion vectors (T, D) turned about the world's Y axis.

    Args:
        values: (T, D) in their own units.
        angle: radians, (T,) or one for all frames.
        layout: columns of the vectors.
    """
    values = values.copy()
    angle = np.broadcast_to(angle, len(values))
    about_y = quaternion_from_rotation_vector(angle[:, None] * np.array([0.0, 1.0, 0.0]))
    root = quaternion_from_sixd(values[:, layout.root_rotation])
    root = multiply_quaternions(about_y, root)
    values[:, layout.root_rotation] = sixd_from_quaternion(root)
    values[:, layout.root_xz] = turned_plane(values[:, layout.root_xz], angle)
    return values


def clamped_steps(vectors: Tensor, layout: VectorLayout) -> Tensor:
    """Return normalised vectors (1, D, T) with root steps within `_MAX_STEP`."""
    vectors = vectors.clone()
    vectors[:, layout.root_xz] = vectors[:, layout.root_xz].clamp(-_MAX_STEP, _MAX_STEP)
    return vectors


def fastest_second(steps: np.ndarray, fps: float) -> float:
    """Return the ground speed (m/s) in the fastest second, or on average if there is less.

    Args:
        steps: (T, 2) displacement over the ground in each frame, m.
        fps: frames per second.
    """
    window = max(1, min(len(steps), round(fps)))
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    distance = np.linalg.norm(path[window:] - path[:-window], axis=1)
    return float(distance.max(initial=0.0) * fps / window)  # a single frame has no steps


def turned_plane(plane: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Return x and z (T, 2) turned about Y; a quarter turn takes +Z to +X."""
    x, z = plane.T
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.stack([x * cosine + z * sine, z * cosine - x * sine], axis=1)
