"""The motion vector of the diffusion model: exponential maps, root height and root displacement.

A frame is `[maps 3 K | height 1 | displacement 3]` (section 4.1 of Alexanderson et al. 2023, after
Holden et al. 2016): the exponential map of each modelled joint (Grassia 1998), the height of the
root, and its turn (radians), forward and leftward displacement since the frame before. Lengths are
metres of the reference body (`ModelJoints.scale`). A model that follows a given path has no
displacement columns.

- Maps are relative to each joint's mean rotation over the training data. The published ones are
  relative to a T-pose, but few rigs have one as rest pose. Relative to the mean, angles are small
  and far from pi, where a map is ambiguous. If an angle does pass pi, the map continues beyond pi,
  so that it is continuous over time; equivalent maps decode to the same rotation.
- The map of the root excludes its heading. The heading is horizontal and perpendicular to the side
  axis of the hips. With a path, it is the heading of the path, and the map holds the rotation of
  the hips relative to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gesturekit.motion.model_joints import ModelJoints
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath, side_axis
from gesturekit.motion.rotations import (
    invert_quaternions,
    matrix_from_quaternion,
    mean_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from gesturekit.motion.skeleton import Skeleton
from gesturekit.motion.torch_kinematics import PointKinematics, rotation_vector_to_matrix
from gesturekit.state.channels import StateChannels

_FRAMES_AT_ONCE = 1024  # bounds the size of temporary arrays while decoding


@dataclass(frozen=True, eq=False)
class DeltaRepresentation(ModelJoints):
    """Conversion between motions of one rig and motion vectors.

    Attributes (beside those of `ModelJoints`):
        makes_root: whether the vector has displacement columns; otherwise a path moves the root.
        side: (3,) direction of the body's left in the root joint's frame.
        references: (K, 4) mean rotations that maps are relative to; the root's without heading.
        turn_first: whether a displacement is relative to the heading of its frame, as in the
            released code, and not to the heading halfway from the frame before.
    """

    makes_root: bool
    side: np.ndarray
    references: np.ndarray
    turn_first: bool = False

    @classmethod
    def fit(
        cls, motions: Sequence[Motion], joints: str | Sequence[str] = "body", root: bool = True
    ) -> DeltaRepresentation:
        """Choose the modelled joints and compute their mean rotations from training motions.

        Args:
            motions: motions of one rig (same names and parents); see `reference_skeleton`.
            joints: "body" (no fingers, no end joints), "all", or names.
            root: whether the model moves the root over the ground; False if a path does.

        Raises:
            MotionError: no motions, or a name that the rig does not have.
        """
        chosen = cls.fit_fields(motions, joints)
        names = chosen["skeleton"].names
        indices = [names.index(name) for name in chosen["joints"]]
        side = side_axis(motions, indices[0])
        references = chosen["fixed_rotations"][indices]
        fitted = cls(**chosen, makes_root=root, side=side, references=references)
        level = [fitted._level_root(motion, fitted._default_path(motion)) for motion in motions]
        references = np.concatenate([mean_quaternion(np.concatenate(level))[None], references[1:]])
        return replace(fitted, references=references)

    def to_json(self) -> dict[str, Any]:
        """Return everything except the skeleton as plain values."""
        return super().to_json() | {
            "makes_root": self.makes_root,
            "side": self.side.tolist(),
            "references": self.references.tolist(),
            "turn_first": self.turn_first,
        }

    @classmethod
    def from_json(cls, skeleton: Skeleton, values: dict[str, Any]) -> DeltaRepresentation:
        """Rebuild a representation from `to_json`."""
        return cls(
            **cls.fields_from_json(skeleton, values),
            makes_root=bool(values["makes_root"]),
            side=np.array(values["side"], dtype=np.float64),
            references=np.array(values["references"], dtype=np.float64),
            turn_first=bool(values["turn_first"]),
        )

    @property
    def n_features(self) -> int:
        """X, the width of the vector: 3 K + 1, plus 3 with displacement columns."""
        return 3 * len(self.joints) + 1 + 3 * self.makes_root

    @property
    def map_columns(self) -> slice:
        """Columns of the exponential maps, three for each joint."""
        return slice(0, 3 * len(self.joints))

    @property
    def height_column(self) -> int:
        """Column of the root's height."""
        return 3 * len(self.joints)

    @property
    def root_columns(self) -> slice:
        """Columns of turn, forward and lateral displacement; empty with a path."""
        return slice(self.height_column + 1, self.n_features)

    def encode(self, motion: Motion, path: RootPath | None = None) -> np.ndarray:
        """Encode a motion of this rig as motion vectors (T, X) float64.

        A performer's own joint offsets may differ from the rig's. The initial position and heading
        are not encoded; frame 0 gets the displacement of frame 1.

        Args:
            motion: T frames.
            path: T frames; the root's path if `makes_root` is False. By default the motion's own
                path, smoothed (`RootPath.smoothed`).

        Raises:
            MotionError: joint names or parents differ from the rig's.
        """
        self.check_rig(motion)
        path = self._default_path(motion) if path is None else path
        rotations = motion.rotations[:, self.indices]
        rotations[:, 0] = self._level_root(motion, path)
        away = multiply_quaternions(invert_quaternions(self.references), rotations)
        maps = continuous_maps(rotation_vector_from_quaternion(away))
        height = motion.positions()[:, self.root, 1:2] / self.scale
        columns = [maps.reshape(motion.n_frames, -1), height]
        if self.makes_root:
            columns.append(path.scaled(1 / self.scale).deltas(turn_first=self.turn_first))
        return np.concatenate(columns, axis=-1)

    def decode(
        self,
        values: np.ndarray,
        fps: float,
        *,
        skeleton: Skeleton | None = None,
        path: RootPath | None = None,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> Motion:
        """Decode motion vectors to a motion.

        Args:
            values: (T, X) motion vectors.
            fps: frames per second.
            skeleton: a performer's offsets to use instead of the reference ones. Displacement and
                height of the root are scaled by leg length; a path is not.
            path: T frames at `fps`; the root's path if `makes_root` is False.
            start: x and z in metres and heading in radians of frame 0, without a path.
        """
        values = np.asarray(values, dtype=np.float64)
        n_frames, size = len(values), self.scale * self.size_of(skeleton)
        if self.makes_root:
            deltas = values[:, self.root_columns] * [1.0, size, size]
            path = RootPath.from_deltas(deltas, fps, start, turn_first=self.turn_first)
        assert path is not None
        rotations = self.fixed_pose(n_frames)
        index = self.indices
        for first in range(0, n_frames, _FRAMES_AT_ONCE):
            maps = values[first : first + _FRAMES_AT_ONCE, self.map_columns]
            away = quaternion_from_rotation_vector(maps.reshape(len(maps), len(index), 3))
            turned = multiply_quaternions(self.references, away)
            rotations[first : first + len(maps), index] = turned
        heading = _about_y(path.headings)
        rotations[:, self.root] = multiply_quaternions(heading, rotations[:, self.root])
        x, z = path.positions.T
        position = np.stack([x, values[:, self.height_column] * size, z], axis=-1)
        return self.assemble(rotations, position, fps, skeleton)

    def path_of(self, motion: Motion) -> RootPath:
        """Return the root's path over the ground, with this rig's definition of heading."""
        self.check_rig(motion)
        return RootPath.of(motion, self.root, self.side)

    def _default_path(self, motion: Motion) -> RootPath:
        """Return the default path that a motion's vectors are relative to."""
        path = self.path_of(motion)
        return path if self.makes_root else path.smoothed()

    def _level_root(self, motion: Motion, path: RootPath) -> np.ndarray:
        """Return the root's world rotation (T, 4) without the path's heading."""
        turned = motion.global_rotations()[:, self.root]
        return multiply_quaternions(_about_y(-path.headings), turned)


def continuous_maps(maps: np.ndarray) -> np.ndarray:
    """Return equivalent exponential maps (T, K, 3) without jumps over time.

    Adding a multiple of 2 pi to an angle does not change its rotation. Outwards from the frame with
    a joint's smallest angle, each frame gets the equivalent map nearest to its neighbour's.
    """
    maps = np.array(maps, dtype=np.float64)
    jumps = np.linalg.norm(np.diff(maps, axis=0), axis=-1) > np.pi
    for k in np.flatnonzero(jumps.any(axis=0)):
        joint = maps[:, k]
        smallest = int(np.linalg.norm(joint, axis=-1).argmin())
        for t in [*range(smallest + 1, len(joint)), *range(smallest - 1, -1, -1)]:
            vector, near = joint[t], joint[t - 1 if t > smallest else t + 1]
            angle = float(np.linalg.norm(vector))
            # The axis of a zero rotation is arbitrary.
            axis = vector / angle if angle > 1e-9 else near / max(np.linalg.norm(near), 1e-9)
            turns = round((float(axis @ near) - angle) / (2 * np.pi))
            joint[t] = vector + axis * (2 * np.pi * turns)
    return maps


def _about_y(angles: np.ndarray) -> np.ndarray:
    """Return rotations (T, 4) about the world's Y axis by angles (T,)."""
    return quaternion_from_rotation_vector(angles[:, None] * np.array([0.0, 1.0, 0.0]))


@dataclass(frozen=True, eq=False)
class Normaliser:
    """Mean and scale of each number of a motion vector (appendix A.1).

    Attributes:
        mean: (X,) float32.
        scale: (X,) float32, above 0.
    """

    mean: Tensor
    scale: Tensor

    @classmethod
    def fit(cls, vectors: Sequence[np.ndarray], floor: np.ndarray | float = 1e-3) -> Normaliser:
        """Compute mean and standard deviation over all frames of the training motions.

        Args:
            vectors: (T, X) each.
            floor: least scale, a number or (X,). Without it, noise in a joint that hardly moves
                would count as much as a gesture.
        """
        n_frames = sum(map(len, vectors))
        mean = sum(values.sum(axis=0, dtype=np.float64) for values in vectors) / n_frames
        square = sum(((values - mean) ** 2).sum(axis=0) for values in vectors) / n_frames
        scale = np.maximum(np.sqrt(square), floor)
        return cls(torch.from_numpy(mean).float(), torch.from_numpy(scale).float())

    def to(self, device: torch.device) -> Normaliser:
        """Return a copy on another device."""
        return Normaliser(self.mean.to(device), self.scale.to(device))

    def forward(self, values: Tensor) -> Tensor:
        """Normalise values (..., X)."""
        return (values - self.mean) / self.scale

    def inverse(self, values: Tensor) -> Tensor:
        """Convert normalised values (..., X) back to their own units."""
        return values * self.scale + self.mean


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


@torch.no_grad()
def measured_state(
    vectors: np.ndarray, representation: DeltaRepresentation, channels: StateChannels, fps: float
) -> np.ndarray:
    """Return the state of movement (C, T) of motion vectors (T, X), both in their own units."""
    places = _joint_places(representation)(torch.from_numpy(vectors).float()[None])
    return channels(places.permute(0, 2, 3, 1), fps)[0].double().numpy()


@lru_cache(maxsize=4)
def _joint_places(representation: DeltaRepresentation) -> VectorPlaces:
    return VectorPlaces(representation)
