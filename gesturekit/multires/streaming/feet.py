"""Foot locking of a stream: frame by frame, without knowledge of the future."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from gesturekit.motion.ik import two_bone_ik
from gesturekit.motion.kinematics import forward_kinematics, global_rotations
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs, leg_length
from gesturekit.motion.rotations import invert_quaternions, multiply_quaternions
from gesturekit.motion.skeleton import Skeleton
from gesturekit.postprocess.foot import feet_of_legs

_FURTHEST = 0.1
"""A standing foot is kept within this share of the leg length from where it would be."""
_RELEASE_SECONDS = 0.12
"""Time constant with which a lifted foot returns to its own path."""
_FOLLOW_SECONDS = 0.5
"""Time constant with which the body follows standing feet."""


class FootHold:
    """Standing feet that are kept in place.

    A foot stays where it came to stand, by inverse kinematics of the leg. What both feet have in
    common moves the body instead: their slow slide.

    Args:
        skeleton: of the stream; one without two identifiable legs does not change.
        fps: frames per second.
    """

    def __init__(self, skeleton: Skeleton, fps: float) -> None:
        self._fps, self._feet = fps, None
        if find_legs(skeleton) is not None:
            # Only the legs and the joints above them are computed.
            self._kept, self._feet = feet_of_legs(skeleton)
            index = {joint: k for k, joint in enumerate(self._kept)}
            self._legs = Skeleton(
                tuple(skeleton.names[joint] for joint in self._kept),
                tuple(index.get(skeleton.parents[joint], -1) for joint in self._kept),
                skeleton.offsets[self._kept],
            )
            self._reach = _FURTHEST * leg_length(skeleton)
        self._shift = np.zeros(3)
        self._moved = np.zeros((2, 3))
        self._anchors = np.full((2, 3), np.nan)

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs."""
        return {name: getattr(self, name) for name in _STATE}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a `state` of a stream with the same arguments."""
        for name in _STATE:
            setattr(self, name, state[name])

    def __call__(
        self,
        motion: Motion,
        contacts: np.ndarray,
        displaced: Callable[[Motion, np.ndarray], Motion],
    ) -> Motion:
        """Return the next frame with standing feet in place.

        Args:
            motion: one frame.
            contacts: (F,) labels of `gesturekit.motion.contacts.foot_points`, above 0.5 if a point
                stands.
            displaced: returns a motion with its root displaced by (2,) metres of x and z.
        """
        if self._feet is None:
            return motion
        legs, rotations = self._legs, motion.rotations[:, self._kept]
        moving = {n: v for n, v in motion.joint_translations.items() if n in legs.names}
        positions = forward_kinematics(rotations, motion.translation, legs, moving)
        world = global_rotations(rotations, legs)
        ankles = positions[0, [foot.ankle for foot in self._feet]]
        columns = [[k for anchor in foot.anchors for k in anchor.columns] for foot in self._feet]
        self._follow(ankles, np.array([(contacts[own] > 0.5).any() for own in columns]))
        limbs = np.array([foot.limb for foot in self._feet])
        bones, joints = limbs[:, :2], positions[0, limbs] + self._shift
        rotations[0, bones] = two_bone_ik(
            joints,
            ankles + self._shift + self._moved,
            rotations[0, bones],
            world[0, np.array(legs.parents)[bones]],
            pole=joints[:, 1] - joints[:, 0],
        )
        reached = global_rotations(rotations, legs)
        for foot in self._feet:
            back = invert_quaternions(reached[:, legs.parents[foot.ankle]])
            rotations[:, foot.ankle] = multiply_quaternions(back, world[:, foot.ankle])
        whole = motion.rotations.copy()
        whole[:, self._kept] = rotations
        return replace(displaced(motion, self._shift[[0, 2]]), rotations=whole)

    def _follow(self, ankles: np.ndarray, stands: np.ndarray) -> None:
        """Update the corrections for a frame with ankles (2, 3), two of which may stand."""
        own = ankles + self._shift
        new = stands & np.isnan(self._anchors[:, 0])
        self._anchors[new] = (own + self._moved)[new]
        self._anchors[~stands] = np.nan
        self._moved[~stands] *= math.exp(-1 / (_RELEASE_SECONDS * self._fps))
        away = (self._anchors - own)[stands] * [1.0, 0.0, 1.0]
        length = np.linalg.norm(away, axis=1, keepdims=True)
        away *= np.minimum(1.0, self._reach / np.maximum(length, 1e-9))
        self._moved[stands] = away
        self._anchors[stands] = (own[stands] + away) * [1.0, 0.0, 1.0]
        if stands.any():
            common = away.mean(axis=0) * (1 - math.exp(-1 / (_FOLLOW_SECONDS * self._fps)))
            self._shift += common
            self._moved[stands] -= common


_STATE = ("_shift", "_moved", "_anchors")
