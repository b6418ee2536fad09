"""Modelled joints of a rig, and the constant pose of all others.

Both motion representations share this: they encode the modelled joints, the first of which is the
model's root, and assemble a motion of the whole rig from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import body_joints, find_legs, known_parts, leg_length
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import (
    mean_quaternion,
)
from gesturekit.motion.skeleton import Skeleton, checked

_LARGEST = 1e6
"""Largest plausible size of a body, in reference bodies."""


@dataclass(frozen=True, eq=False)
class ModelJoints:
    """Modelled joints of one rig.

    Attributes:
        skeleton: the whole rig, with all J joints of the user's file.
        joints: names of the K modelled joints, in the skeleton's order; the first is the model's
            root, see `first_moving_joint`; all others are below it.
        fixed_rotations: (J, 4) mean local quaternions of joints outside `joints`.
        fixed_translations: joint name to (3,), mean local positions that replace offsets, metres.
        scale: metres of the rig per metre of the reference body (`body_scale`). Lengths in motion
            vectors are those of the reference body, so that training does not depend on size or
            unit of the rig.
    """

    skeleton: Skeleton
    joints: tuple[str, ...]
    fixed_rotations: np.ndarray
    fixed_translations: dict[str, np.ndarray]
    scale: float = field(default=1.0, kw_only=True)

    @classmethod
    def fit_fields(
        cls, motions: Sequence[Motion], joints: str | Sequence[str] = "body"
    ) -> dict[str, Any]:
        """Determine the root, the modelled joints and the means of all others.

        Args:
            motions: training motions of one rig (same names and parents).
            joints: "body" (no fingers, no end joints), "all", or names.

        Returns:
            The attributes by name.

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
        root = first_moving_joint(motions)
        wanted &= {skeleton.names[j] for j in skeleton.descendants(root)}
        wanted.add(skeleton.names[root])
        others = [j for j, name in enumerate(skeleton.names) if name in wanted and j != root]
        moved = {name for motion in motions for name in motion.joint_translations}
        return {
            "skeleton": skeleton,
            "joints": tuple(skeleton.names[j] for j in (root, *others)),
            # Joint by joint, because rotations of a large corpus fill memory.
            "fixed_rotations": np.stack(
                [
                    mean_quaternion(np.concatenate([motion.rotations[:, j] for motion in motions]))
                    for j in range(skeleton.n_joints)
                ]
            ),
            "fixed_translations": {
                name: np.concatenate([m.local_positions(name) for m in motions]).mean(axis=0)
                for name in sorted(moved - {skeleton.names[root]})
            },
            "scale": body_scale(skeleton),
        }

    def to_json(self) -> dict[str, Any]:
        """Return all attributes but the skeleton as JSON values."""
        return {
            "joints": list(self.joints),
            "fixed_rotations": self.fixed_rotations.tolist(),
            "fixed_translations": {k: v.tolist() for k, v in self.fixed_translations.items()},
            "scale": self.scale,
        }

    def on_bones_of(self, motions: Sequence[Motion]) -> Self:
        """Return the same modelled joints and units on the bones of other motions of this rig.

        Joints that are not modelled get their mean rotation in these motions.

        Args:
            motions: with the rig's joint names and parents.
        """
        fields = self.fit_fields(motions, self.joints)
        return replace(self, **fields | {"joints": self.joints})

    @staticmethod
    def fields_from_json(skeleton: Skeleton, values: dict[str, Any]) -> dict[str, Any]:
        """Return the attributes by name, from the values of `to_json`.

        Raises:
            MotionError: values of a wrong shape, or of joints that the skeleton does not have.
        """
        scale = float(values["scale"])
        if not 0 < scale <= _LARGEST:
            raise MotionError(f"scale: {scale:g} must be above 0 and at most {_LARGEST:g}")
        joints = tuple(skeleton.names[skeleton.index(name)] for name in values["joints"])
        if not joints or len(set(joints)) < len(joints):
            raise MotionError("joints: none, or one of them twice")
        return {
            "skeleton": skeleton,
            "joints": joints,
            "fixed_rotations": checked(
                "fixed_rotations", values["fixed_rotations"], (skeleton.n_joints, 4)
            ),
            "fixed_translations": {
                skeleton.names[skeleton.index(name)]: checked("fixed_translations", value, (3,))
                for name, value in values["fixed_translations"].items()
            },
            "scale": scale,
        }

    @property
    def root(self) -> int:
        """Index of the model's root in the skeleton."""
        return self.skeleton.index(self.joints[0])

    @property
    def indices(self) -> list[int]:
        """Indices of the K modelled joints in the skeleton."""
        return [self.skeleton.index(name) for name in self.joints]

    def check_rig(self, motion: Motion) -> None:
        """Check that a motion has this rig; offsets may differ between performers.

        Raises:
            MotionError: joint names or parents differ from the rig's.
        """
        rig, other = self.skeleton, motion.skeleton
        if (other.names, other.parents) != (rig.names, rig.parents):
            here = f"{other.n_joints} joints from {other.names[0]!r}"
            own = f"{rig.n_joints} from {rig.names[0]!r}"
            raise MotionError(f"the motion's joints are not the model's: {here}, not {own}")

    def size_of(self, skeleton: Skeleton | None) -> float:
        """Return the leg length of a performer over that of the rig; 1 for None.

        A rig without legs is measured by the total length of its bones.
        """
        if skeleton is None:
            return 1.0
        try:
            return leg_length(skeleton) / leg_length(self.skeleton)
        except MotionError:
            bones, own = (
                float(np.linalg.norm(rig.offsets[1:], axis=1).sum())
                for rig in (skeleton, self.skeleton)
            )
            return bones / own if own else 1.0

    def assemble(
        self,
        rotations: np.ndarray,
        position: np.ndarray,
        fps: float,
        skeleton: Skeleton | None = None,
    ) -> Motion:
        """Return a motion of the whole rig.

        Args:
            rotations: (T, J, 4) local quaternions; world quaternions for the model's root, and
                those of `fixed_pose` for joints outside `joints`.
            position: (T, 3) world position of the model's root, metres.
            fps: frames per second.
            skeleton: a performer's skeleton, to use its offsets instead of the rig's.
        """
        moving = {
            name: np.tile(value, (len(position), 1))
            for name, value in self.fixed_translations.items()
        }
        # Joints above the model's root do not move.
        still = np.zeros_like(position) if self.root else position
        motion = Motion(skeleton or self.skeleton, rotations, still, fps, moving)
        if not self.root:
            return motion
        return motion.with_joint_at(self.root, position, rotations[:, self.root])

    def fixed_pose(self, n_frames: int) -> np.ndarray:
        """(T, J, 4) fixed rotations of all joints, repeated for each frame."""
        return np.tile(self.fixed_rotations, (n_frames, 1, 1))


def reference_skeleton(motions: Sequence[Motion]) -> Skeleton:
    """Return the skeleton whose offsets are nearest to the median over all motions.

    Files of one performer may differ in the rest offset of a moving joint. A median of offsets
    would give bones a length that no file has, so an existing skeleton is chosen.
    """
    offsets = np.stack([motion.skeleton.offsets for motion in motions])
    distance = np.abs(offsets - np.median(offsets, axis=0)).sum(axis=(1, 2))
    return motions[int(distance.argmin())].skeleton


def first_moving_joint(motions: Sequence[Motion]) -> int:
    """Return the lowest joint above all that move, from the root: position or rotation changes.

    All of them are at or below it, and so are the legs (somebody may move above the waist only). If
    the body is identified, joints on other branches (a camera, a prop) do not count.
    """
    skeleton = motions[0].skeleton
    legs = find_legs(skeleton)
    hips = [] if legs is None else [skeleton.index(leg.hip) for leg in legs.values()]
    parts = known_parts(skeleton)
    pelvis = skeleton.index(parts.pelvis) if parts else 0
    body = sorted({pelvis, *skeleton.ancestors(pelvis), *skeleton.descendants(pelvis)})
    first = next((j for j in body if _moves(motions, j)), 0)
    below = {first, *skeleton.descendants(first)}
    others = [j for j in body if j not in below and _moves(motions, j)]
    return skeleton.common_ancestor(first, *others, *hips)


def _moves(motions: Sequence[Motion], joint: int) -> bool:
    """Return whether the position or rotation of a joint changes in any motion."""
    skeleton = motions[0].skeleton
    still, name = 1e-6 * body_scale(skeleton), skeleton.names[joint]
    for motion in motions:
        places = motion.joint_translations.get(name) if joint else motion.translation
        turns = motion.rotations[:, joint]
        turning = np.abs(np.abs(turns @ turns[0]) - 1).max() > 1e-7
        if turning or (places is not None and np.ptp(places, axis=0).max() > still):
            return True
    return False
