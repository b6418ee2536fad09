"""The motion vector of the multi-resolution model: rotations, contacts, root.

A frame is `[K x 6 | C | 3]`: the first two columns of the rotation matrix of each modelled joint
(Zhou et al. 2019), a contact label for each foot point (eq. 1 of Moreno-Villamarin et al. 2024),
and three numbers of the root: its displacement since the frame before along the world's x and z,
and between them its height, all in metres of the reference body (`ModelJoints.scale`). On SMPL with
six foot points that is 24 x 6 + 6 + 3 = 153 numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from gesturekit.motion.contacts import CONTACT_SPEED, contact_labels, foot_points
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    quaternion_from_sixd,
    rotate_vectors,
    sixd_from_quaternion,
)
from gesturekit.motion.selection.model_joints import ModelJoints, reference_skeleton
from gesturekit.motion.skeleton import Skeleton

__all__ = ["CONTACT_SPEED", "MultiresRepresentation", "reference_skeleton"]

_FRAMES_AT_ONCE = 1024  # decoded, so that what a rotation passes through on its way stays small


@dataclass(frozen=True, eq=False)
class MultiresRepresentation(ModelJoints):
    """Encodes motions of one rig as vectors, and vectors as motions.

    Attributes:
        contact_speed: m/s on the reference body; a slower foot point stands.
    """

    contact_speed: float = field(default=CONTACT_SPEED, kw_only=True)

    @classmethod
    def fit(
        cls,
        motions: Sequence[Motion],
        joints: str | Sequence[str] = "body",
        contact_speed: float = CONTACT_SPEED,
    ) -> MultiresRepresentation:
        """Learn from training motions which joints to model and how to hold the others.

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
        """Inverse of `to_json`; values of older models have no contact speed."""
        speed = float(values.get("contact_speed", CONTACT_SPEED))
        return cls(**cls.fields_from_json(skeleton, values), contact_speed=speed)

    def to_json(self) -> dict[str, Any]:
        """Everything but the skeleton, as plain values."""
        return super().to_json() | {"contact_speed": self.contact_speed}

    @cached_property
    def foot_points(self) -> tuple:
        """The C points on the feet whose contact with the floor is modelled."""
        return tuple(foot_points(self.skeleton))

    @property
    def n_features(self) -> int:
        """Width of the vector: 6 K + C + 3."""
        return 6 * len(self.joints) + len(self.foot_points) + 3

    @property
    def contact_columns(self) -> slice:
        """Where the C contact labels stand."""
        start = 6 * len(self.joints)
        return slice(start, start + len(self.foot_points))

    @property
    def root_columns(self) -> slice:
        """Where displacement along x, height and displacement along z stand."""
        return slice(self.n_features - 3, self.n_features)

    def joint_columns(self, name: str) -> slice:
        """Where the six numbers of one modelled joint stand."""
        k = self.joints.index(name)
        return slice(6 * k, 6 * k + 6)

    @cached_property
    def block_sizes(self) -> tuple[int, ...]:
        """Widths of the blocks that a skeleton-aware convolution tells apart."""
        return (6,) * len(self.joints) + (1,) * len(self.foot_points) + (3,)

    def encode(self, motion: Motion, turn: float = 0.0) -> np.ndarray:
        """(T, 6 K + C + 3) float64 of a motion of this rig; a performer's own offsets may differ.

        The root's orientation is the world's. Frame 0 has the displacement of frame 1.

        Args:
            motion: T frames.
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

    def contacts(self, values: np.ndarray) -> np.ndarray:
        """(T, C) contact labels of motion vectors: over 0.5 where a foot point stands."""
        return values[:, self.contact_columns]

    def decode(self, values: np.ndarray, fps: float, *, skeleton: Skeleton | None = None) -> Motion:
        """A motion from (T, 6 K + C + 3) values; it starts above the origin.

        Args:
            values: motion vectors; rotations need not be orthonormal.
            fps: frames per second.
            skeleton: a performer's offsets to use in place of the reference ones; steps and the
                height of the root grow with the length of the legs.
        """
        n_frames = len(values)
        rotations = self.fixed_pose(n_frames)
        index = self.indices
        for start in range(0, n_frames, _FRAMES_AT_ONCE):
            part = values[start : start + _FRAMES_AT_ONCE, : 6 * len(index)]
            modelled = quaternion_from_sixd(part.reshape(len(part), len(index), 6))
            rotations[start : start + len(part), index] = modelled
        dx, height, dz = values[:, self.root_columns].T
        position = np.stack([np.cumsum(dx) - dx[0], height, np.cumsum(dz) - dz[0]], axis=-1)
        size = self.scale * self.size_of(skeleton)
        return self.assemble(rotations, position * size, fps, skeleton)
