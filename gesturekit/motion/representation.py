"""The motion vector of the multi-resolution model: rotations, contacts, root.

A frame is `[K x 6 | C | 3]`: the first two columns of the rotation matrix of each modelled joint
(Zhou et al. 2019), a contact label for each foot point (eq. 1 of Moreno-Villamarin et al. 2024),
and three numbers of the root: its displacement since the frame before along the world's x and z,
and between them its height, all in metres. On SMPL with six foot points that is 24 x 6 + 6 + 3 =
153 numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.contacts import contact_labels, foot_points
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import body_joints, leg_length
from gesturekit.motion.rotations import (
    IDENTITY,
    invert_quaternions,
    mean_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    quaternion_from_sixd,
    rotate_vectors,
    sixd_from_quaternion,
)
from gesturekit.motion.skeleton import Skeleton

CONTACT_SPEED = 0.2
"""Below this speed (m/s) a foot point counts as standing on the floor."""

_FRAMES_AT_ONCE = 1024  # decoded, so that what a rotation passes through on its way stays small


@dataclass(frozen=True, eq=False)
class MultiresRepresentation:
    """Encodes motions of one rig as vectors, and vectors as motions.

    Attributes:
        skeleton: the whole rig, with all the joints of the user's file.
        joints: names of the K modelled joints, in the skeleton's order; the first is the model's
            root, the first joint of the rig that moves.
        fixed_rotations: (J, 4) local quaternions that joints outside `joints` are held at.
        fixed_translations: joint name to (3,): local positions that replace offsets, held likewise.
    """

    skeleton: Skeleton
    joints: tuple[str, ...]
    fixed_rotations: np.ndarray
    fixed_translations: dict[str, np.ndarray]

    @classmethod
    def fit(
        cls, motions: Sequence[Motion], joints: str | Sequence[str] = "body"
    ) -> MultiresRepresentation:
        """Settle the root, the modelled joints and the means of all others from training motions.

        Args:
            motions: motions of one rig (same names and parents); see `reference_skeleton`.
            joints: "body" (no fingers, no end joints), "all", or names.

        Raises:
            MotionError: no motions, or a name that the rig does not have.
        """
        if not motions:
            raise MotionError("no motion to learn a representation from")
        skeleton = reference_skeleton(motions)
        if joints == "all":
            wanted = set(skeleton.names)
        elif joints == "body":
            wanted = set(body_joints(skeleton))
        elif isinstance(joints, str):
            raise MotionError(f"joints: {joints!r}; expected body, all, or a list of joint names")
        else:
            wanted = {skeleton.names[skeleton.index(name)] for name in joints}
        root = _first_moving_joint(motions)
        wanted -= {skeleton.names[j] for j in skeleton.ancestors(root)}
        wanted.add(skeleton.names[root])
        order = [
            root,
            *(j for j, name in enumerate(skeleton.names) if name in wanted and j != root),
        ]
        rotations = np.concatenate([motion.rotations for motion in motions])
        moved = {name for motion in motions for name in motion.joint_translations}
        return cls(
            skeleton=skeleton,
            joints=tuple(skeleton.names[j] for j in order),
            fixed_rotations=np.stack(
                [mean_quaternion(rotations[:, j]) for j in range(skeleton.n_joints)]
            ),
            fixed_translations={
                name: np.concatenate([_local_position(m, name) for m in motions]).mean(axis=0)
                for name in sorted(moved - {skeleton.names[root]})
            },
        )

    def to_json(self) -> dict[str, Any]:
        """Everything but the skeleton, as plain values."""
        return {
            "joints": list(self.joints),
            "fixed_rotations": self.fixed_rotations.tolist(),
            "fixed_translations": {k: v.tolist() for k, v in self.fixed_translations.items()},
        }

    @classmethod
    def from_json(cls, skeleton: Skeleton, values: dict[str, Any]) -> MultiresRepresentation:
        """Inverse of `to_json`."""
        return cls(
            skeleton=skeleton,
            joints=tuple(skeleton.names[skeleton.index(name)] for name in values["joints"]),
            fixed_rotations=np.array(values["fixed_rotations"], dtype=np.float64),
            fixed_translations={
                name: np.array(value, dtype=np.float64)
                for name, value in values["fixed_translations"].items()
            },
        )

    @property
    def root(self) -> int:
        """The model's root, as an index into the skeleton's joints."""
        return self.skeleton.index(self.joints[0])

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
        if (motion.skeleton.names, motion.skeleton.parents) != (
            self.skeleton.names,
            self.skeleton.parents,
        ):
            raise MotionError(
                "the motion's joints are not those of the model: "
                f"{motion.skeleton.n_joints} joints from {motion.skeleton.names[0]!r}, the model "
                f"has {self.skeleton.n_joints} from {self.skeleton.names[0]!r}"
            )
        index = [self.skeleton.index(name) for name in self.joints]
        rotations = motion.rotations[:, index].copy()
        about_y = quaternion_from_rotation_vector(np.array([0.0, turn, 0.0]))
        rotations[:, 0] = multiply_quaternions(about_y, motion.global_rotations()[:, self.root])
        position = rotate_vectors(about_y, motion.positions()[:, self.root])
        displacement = np.diff(position, axis=0, prepend=position[:1])
        if motion.n_frames > 1:
            displacement[0] = displacement[1]
        root = np.stack([displacement[:, 0], position[:, 1], displacement[:, 2]], axis=-1)
        contacts = contact_labels(motion, threshold=CONTACT_SPEED)
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
        size = 1.0 if skeleton is None else leg_length(skeleton) / leg_length(self.skeleton)
        skeleton = skeleton or self.skeleton
        n_frames = len(values)
        rotations = np.tile(self.fixed_rotations, (n_frames, 1, 1))
        index = [self.skeleton.index(name) for name in self.joints]
        for start in range(0, n_frames, _FRAMES_AT_ONCE):
            part = values[start : start + _FRAMES_AT_ONCE, : 6 * len(index)]
            modelled = quaternion_from_sixd(part.reshape(len(part), len(index), 6))
            rotations[start : start + len(part), index] = modelled
        dx, height, dz = values[:, self.root_columns].T
        position = np.stack([np.cumsum(dx) - dx[0], height, np.cumsum(dz) - dz[0]], axis=-1) * size
        moving = {
            name: np.tile(value, (n_frames, 1)) for name, value in self.fixed_translations.items()
        }
        translation = position
        ancestors = self.skeleton.ancestors(self.root)[::-1]
        if ancestors:
            # The joints above the model's root stand still: take them off its world position.
            turn, origin = IDENTITY, np.zeros(3)
            for j in ancestors:
                step = self.fixed_translations.get(skeleton.names[j], skeleton.offsets[j])
                origin = origin + rotate_vectors(turn, step if j else np.zeros(3))
                turn = multiply_quaternions(turn, self.fixed_rotations[j])
            back = invert_quaternions(turn)
            rotations[:, self.root] = multiply_quaternions(back, rotations[:, self.root])
            moving[skeleton.names[self.root]] = rotate_vectors(back, position - origin)
            translation = np.zeros((n_frames, 3))
        return Motion(
            skeleton=skeleton,
            rotations=rotations,
            translation=translation,
            fps=fps,
            joint_translations=moving,
        )


def reference_skeleton(motions: Sequence[Motion]) -> Skeleton:
    """The skeleton of these motions that lies nearest to the median of all their offsets.

    Files of one performer may differ in where a moving joint happens to rest; the commonest
    place is meant, and no bone shall get a length that nobody has.
    """
    offsets = np.stack([motion.skeleton.offsets for motion in motions])
    apart = np.abs(offsets - np.median(offsets, axis=0)).sum(axis=(1, 2))
    return motions[int(apart.argmin())].skeleton


def _local_position(motion: Motion, name: str) -> np.ndarray:
    """(T, 3) position of a joint in its parent's frame, whether the file moves it or not."""
    still = motion.skeleton.offsets[motion.skeleton.index(name)]
    return motion.joint_translations.get(name, np.tile(still, (motion.n_frames, 1)))


def _first_moving_joint(motions: Sequence[Motion]) -> int:
    """The first joint, from the root outwards, whose place or rotation changes in some motion."""
    skeleton = motions[0].skeleton
    for j, name in enumerate(skeleton.names):
        for motion in motions:
            places = motion.translation if j == 0 else motion.joint_translations.get(name)
            turns = motion.rotations[:, j]
            turning = np.abs(np.abs(turns @ turns[0]) - 1).max() > 1e-7
            if turning or (places is not None and np.ptp(places, axis=0).max() > 1e-6):
                return j
    return 0
