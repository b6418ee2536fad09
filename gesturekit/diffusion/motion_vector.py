"""The motion vector of the diffusion model: exponential maps, height, steps of the root.

A frame is `[3 K | 1 | 3]`: the exponential map of each modelled joint (Grassia 1998), the height of
the root, and the root's steps over the ground as it turns (radians), goes forward and goes to its
left, each since the frame before (section 4.1 of Alexanderson et al. 2023, after Holden et al.
2016). Lengths are metres of the reference body (`ModelJoints.scale`). Where the root follows a path
that is given, the steps are left out.

- Maps are relative to each joint's mean rotation over the training data. The published ones are
  relative to a T-pose, which few rigs rest in; about the mean, angles are small and far from pi,
  where a map is ambiguous. Where an angle passes pi all the same, the map goes on in the
  neighbouring turn, so that it is continuous over time; any of them decodes to the rotation.
- The root's own map is what is left of its rotation once the heading is taken off. The heading is
  square to the hips' side axis and level; on a path it is the path's, and the hips' swing about it
  stays in the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.heading import side_axis
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import (
    invert_quaternions,
    mean_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from gesturekit.motion.selection.model_joints import ModelJoints
from gesturekit.motion.skeleton import Skeleton

_FRAMES_AT_ONCE = 1024  # decoded, so that what a rotation passes through on its way stays small


@dataclass(frozen=True, eq=False)
class DeltaRepresentation(ModelJoints):
    """Encodes motions of one rig as vectors, and vectors as motions.

    Attributes (beside those of `ModelJoints`):
        makes_root: whether the vector holds the root's steps; else a path gives them.
        side: (3,) towards the body's left in the root joint's frame.
        references: (K, 4) mean rotations that maps are relative to; of the root, without heading.
    """

    makes_root: bool
    side: np.ndarray
    references: np.ndarray

    @classmethod
    def fit(
        cls, motions: Sequence[Motion], joints: str | Sequence[str] = "body", root: bool = True
    ) -> DeltaRepresentation:
        """Learn from training motions which joints to model, and the means.

        Args:
            motions: motions of one rig (same names and parents); see `reference_skeleton`.
            joints: "body" (no fingers, no end joints), "all", or names.
            root: whether the model moves the root over the ground; False where a path does.

        Raises:
            MotionError: no motions, or a name that the rig does not have.
        """
        chosen = cls.fit_fields(motions, joints)
        names = chosen["skeleton"].names
        indices = [names.index(name) for name in chosen["joints"]]
        side = side_axis(motions, indices[0])
        references = chosen["fixed_rotations"][indices]
        unreferenced = cls(**chosen, makes_root=root, side=side, references=references)
        level = [
            unreferenced._level_root(motion, unreferenced._own_path(motion)) for motion in motions
        ]
        references = np.concatenate([mean_quaternion(np.concatenate(level))[None], references[1:]])
        return cls(**chosen, makes_root=root, side=side, references=references)

    def to_json(self) -> dict[str, Any]:
        """Everything but the skeleton, as plain values."""
        return super().to_json() | {
            "makes_root": self.makes_root,
            "side": self.side.tolist(),
            "references": self.references.tolist(),
        }

    @classmethod
    def from_json(cls, skeleton: Skeleton, values: dict[str, Any]) -> DeltaRepresentation:
        """Inverse of `to_json`."""
        return cls(
            **cls.fields_from_json(skeleton, values),
            makes_root=bool(values["makes_root"]),
            side=np.array(values["side"], dtype=np.float64),
            references=np.array(values["references"], dtype=np.float64),
        )

    @property
    def n_features(self) -> int:
        """Width of the vector: 3 K + 1, and 3 more where it holds the root's steps."""
        return 3 * len(self.joints) + 1 + 3 * self.makes_root

    @property
    def height_column(self) -> int:
        """Where the height of the root stands."""
        return 3 * len(self.joints)

    @property
    def root_columns(self) -> slice:
        """Where turn, forward and lateral stand; empty where a path gives them."""
        return slice(self.height_column + 1, self.n_features)

    def joint_columns(self, name: str) -> slice:
        """Where the three numbers of one modelled joint stand."""
        k = self.joints.index(name)
        return slice(3 * k, 3 * k + 3)

    def encode(self, motion: Motion, path: RootPath | None = None) -> np.ndarray:
        """(T, n_features) float64 of a motion of this rig; a performer's own offsets may differ.

        Where the motion begins and which way it faces then is not told. Frame 0 has the steps of
        frame 1.

        Args:
            motion: T frames.
            path: T frames, what the root follows where `makes_root` is False; by default the
                motion's own path, smoothed (`RootPath.smoothed`).

        Raises:
            MotionError: joint names or parents differ from the rig's, or a path of other length.
        """
        self.check_rig(motion)
        if path is None:
            path = self._own_path(motion)
        elif self.makes_root:
            raise MotionError("the vector holds the root's own steps, so no path can be given")
        elif path.n_frames != motion.n_frames:
            raise MotionError(f"a path of {path.n_frames} frames for {motion.n_frames} of motion")
        rotations = motion.rotations[:, self.indices]
        rotations[:, 0] = self._level_root(motion, path)
        away = multiply_quaternions(invert_quaternions(self.references), rotations)
        maps = continuous_maps(rotation_vector_from_quaternion(away))
        height = motion.positions()[:, self.root, 1:2] / self.scale
        parts = [maps.reshape(motion.n_frames, -1), height]
        if self.makes_root:
            parts.append(path.scaled(1 / self.scale).deltas())
        return np.concatenate(parts, axis=-1)

    def decode(
        self,
        values: np.ndarray,
        fps: float,
        *,
        skeleton: Skeleton | None = None,
        path: RootPath | None = None,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> Motion:
        """A motion from (T, n_features) values.

        Args:
            values: motion vectors.
            fps: frames per second.
            skeleton: a performer's offsets to use in place of the reference ones; steps and the
                height of the root grow with the length of the legs. A path stays as it is.
            path: T frames at `fps`, which the root follows where `makes_root` is False.
            start: x and z in metres and heading in radians of frame 0, where no path is followed.

        Raises:
            MotionError: a path where none belongs, none where one is needed, or one that does not
                fit; see `RootPath.resample`.
        """
        values = np.asarray(values, dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != self.n_features:
            raise MotionError(
                f"motion vectors of shape {values.shape}; expected (T, {self.n_features})"
            )
        n_frames, size = len(values), self.scale * self.size_of(skeleton)
        if self.makes_root:
            if path is not None:
                raise MotionError("the model moves the root itself, so it cannot follow a path")
            deltas = values[:, self.root_columns] * [1.0, size, size]
            path = RootPath.from_deltas(deltas, fps, start)
        elif path is None:
            raise MotionError("the model moves the root along a path, and none was given")
        elif (path.fps, path.n_frames) != (fps, n_frames):
            raise MotionError(
                f"the path has {path.n_frames} frames at {path.fps:g} fps; the motion has "
                f"{n_frames} at {fps:g}"
            )
        rotations = self.fixed_pose(n_frames)
        index = self.indices
        for first in range(0, n_frames, _FRAMES_AT_ONCE):
            part = values[first : first + _FRAMES_AT_ONCE, : 3 * len(index)]
            away = quaternion_from_rotation_vector(part.reshape(len(part), len(index), 3))
            rotations[first : first + len(part), index] = multiply_quaternions(
                self.references, away
            )
        rotations[:, self.root] = multiply_quaternions(
            _about_y(path.headings), rotations[:, self.root]
        )
        x, z = path.positions.T
        position = np.stack([x, values[:, self.height_column] * size, z], axis=-1)
        return self.assemble(rotations, position, fps, skeleton)

    def path_of(self, motion: Motion) -> RootPath:
        """The way of the root over the ground, as this rig's heading is told."""
        self.check_rig(motion)
        return RootPath.of(motion, self.root, self.side)

    def _own_path(self, motion: Motion) -> RootPath:
        """What the vectors of a motion are relative to unless a path is given."""
        path = self.path_of(motion)
        return path if self.makes_root else path.smoothed()

    def _level_root(self, motion: Motion, path: RootPath) -> np.ndarray:
        """(T, 4) the root's world rotation without the path's heading."""
        turned = motion.global_rotations()[:, self.root]
        return multiply_quaternions(_about_y(-path.headings), turned)


def continuous_maps(maps: np.ndarray) -> np.ndarray:
    """Exponential maps (T, K, 3) of the same rotations, without jumps over time.

    Adding whole turns to an angle leaves its rotation as it is. From the frame in which a joint's
    angle is smallest, each frame takes the equivalent map that lies nearest to its neighbour's.
    """
    maps = np.array(maps, dtype=np.float64)
    jumps = np.linalg.norm(np.diff(maps, axis=0), axis=-1) > np.pi
    for k in np.flatnonzero(jumps.any(axis=0)):
        one = maps[:, k]
        calmest = int(np.linalg.norm(one, axis=-1).argmin())
        for t in range(calmest + 1, len(one)):
            one[t] = _nearest_map(one[t], one[t - 1])
        for t in range(calmest - 1, -1, -1):
            one[t] = _nearest_map(one[t], one[t + 1])
    return maps


def _nearest_map(vector: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(3,) of all maps that are the rotation of `vector`, the nearest to `near`."""
    angle = float(np.linalg.norm(vector))
    if angle > 1e-9:
        axis = vector / angle
    else:  # no turn at all has every axis
        length = float(np.linalg.norm(near))
        axis = near / length if length else vector
    return vector + axis * (2 * np.pi * round((float(axis @ near) - angle) / (2 * np.pi)))


def _about_y(angles: np.ndarray) -> np.ndarray:
    """(T, 4) turns about the world's Y axis."""
    return quaternion_from_rotation_vector(angles[:, None] * np.array([0.0, 1.0, 0.0]))
