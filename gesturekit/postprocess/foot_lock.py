"""Feet that stay where they stand.

1. Contact spans of heel and ball of each foot, from the labels that the model predicted, or from
   speed and height (`contact_spans`).
2. What the standing feet slide together, slowly, is taken from the path of the hips (`carrying`).
3. In each span the point is pinned at its mean place, on the floor, and blended in and out
   (`pinning`), but never pulled down in flight: a foot rolls onto the floor and off it as it did.
   The ball holds while the heel lifts; a flat foot holds by both, turned as a whole.
4. No foot sinks deeper than it was, and the hips come down a little where a leg is too short.
5. Two-bone IK (`gesturekit.motion.ik.two_bone`) turns hips and knees; the ankle keeps the foot's
   orientation, the toes lie as they lay.

Frames without contact come back as they were.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.ik.two_bone import reachable, two_bone_ik
from gesturekit.motion.kinematics import global_rotations
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs, leg_length
from gesturekit.motion.retarget.feet import HIP_DROP_SECONDS, smooth_upper_envelope
from gesturekit.motion.rotations import (
    IDENTITY,
    invert_quaternions,
    multiply_quaternions,
    normalize_quaternions,
    rotate_vectors,
    shortest_arc,
)
from gesturekit.motion.skeleton import Skeleton
from gesturekit.postprocess.contact_spans import (
    contact_frames,
    contact_spans,
    split_where_it_moves,
    with_edges,
)
from gesturekit.postprocess.foot import Anchor, Foot, feet_of
from gesturekit.postprocess.pinning import FASTEST, give_way, pin
from gesturekit.postprocess.root_drift import drift, rise

_STRAY = 0.1
"""Share of the leg's length within which a foot is pulled back to its pin."""
_TURN = 0.15
"""Share of the foot's length by which heel and ball are moved against each other: radians."""
_LIFT = 0.01
"""Metres on the reference body; a heel that is farther from the floor while the ball stands is
lifted, not noisy."""
_STRETCH = 0.995
"""Legs are not pulled straighter than this share of their length, unless they were."""
_LOWEST = 0.05
"""Share of the leg's length by which the hips come down, at most."""
_NOTHING = 1e-7
"""Metres on the reference body, and sines of half angles, that are no change."""


def lock_feet(
    motion: Motion, contacts: np.ndarray | None = None, *, keep_path: bool = False
) -> Motion:
    """Take the sliding out of feet that stand.

    Args:
        motion: T frames of any rig; one without two legs that can be identified stays as it is.
        contacts: (T, F) contact labels of `gesturekit.motion.contacts.foot_points`, over 0.5 where
            a point stands; None judges by speed and height.
        keep_path: leave the hips on their path even where both feet slide along with it, for
            motion whose path was asked for.

    Returns:
        The motion with other legs and, where both feet slid together, another path of the hips.
        Frames without contact keep their pose to the last bit.

    Raises:
        MotionError: labels of another shape.
    """
    if find_legs(motion.skeleton) is None:
        return motion
    return _FootLock(motion, contacts).locked(keep_path)


@dataclass(eq=False)
class _Goal:
    """How a foot goes where it shall be: its ankle moves (T, 3), it turns (T, 4), in the world."""

    moved: np.ndarray
    turn: np.ndarray


class _FootLock:
    def __init__(self, motion: Motion, contacts: np.ndarray | None) -> None:
        self.motion, self.skeleton, self.fps = motion, motion.skeleton, motion.fps
        self.feet = feet_of(motion.skeleton)
        columns = max(
            k
            for foot in self.feet
            for anchor in (foot.heel, foot.ball)
            if anchor is not None
            for k in anchor.columns
        )
        self.labels = None if contacts is None else np.asarray(contacts, dtype=np.float64)
        if self.labels is not None and self.labels.shape != (motion.n_frames, columns + 1):
            raise MotionError(
                f"contacts have shape {self.labels.shape}; {motion.n_frames} frames of this rig "
                f"need ({motion.n_frames}, {columns + 1})"
            )
        self.turned = motion.global_rotations()
        self.positions = motion.positions()
        self.radius = _STRAY * leg_length(motion.skeleton)
        self.scale = body_scale(motion.skeleton)
        self.nothing = _NOTHING * self.scale

    def locked(self, keep_path: bool) -> Motion:
        stands = [self._stands(foot) for foot in self.feet]
        if not any(mask.any() for foot in stands for mask, _ in foot):
            return self.motion
        shift = np.zeros((self.motion.n_frames, 3))
        if not keep_path:
            held = np.stack([np.any([mask for mask, _ in foot], axis=0) for foot in stands], axis=1)
            left, right = (self._middle(foot) for foot in self.feet)
            shift -= drift(left, right, held, self.fps)
            above = [self._above(foot, own) for foot, own in zip(self.feet, stands, strict=True)]
            shift[:, 1] -= rise(np.stack(above, axis=1), held, self.fps)
        goals = [self._goal(foot, own, shift) for foot, own in zip(self.feet, stands, strict=True)]
        shift[:, 1] -= self._lowered(goals, shift)
        return self._posed(goals, shift)

    def _anchors(self, foot: Foot) -> list[Anchor]:
        return [anchor for anchor in (foot.heel, foot.ball) if anchor is not None]

    def _middle(self, foot: Foot) -> np.ndarray:
        places = [anchor.places(self.positions, self.turned) for anchor in self._anchors(foot)]
        return np.mean(places, axis=0)

    def _above(self, foot: Foot, stands: list[tuple[np.ndarray, float]]) -> np.ndarray:
        """(T,) metres of what stands of a foot, heel or ball, above where it stands."""
        heights = [
            anchor.places(self.positions, self.turned)[:, 1] - floor
            for anchor, (_, floor) in zip(self._anchors(foot), stands, strict=True)
        ]
        # The ball tells where it stands: a heel may be lifted.
        return np.where(stands[-1][0], heights[-1], heights[0])

    def _stands(self, foot: Foot) -> list[tuple[np.ndarray, float]]:
        """For heel and ball: when it stands, (T,) bool, and how high."""
        found = []
        for anchor in self._anchors(foot):
            labels = None
            if self.labels is not None:
                labels = self.labels[:, list(anchor.columns)].mean(axis=1)
            places = anchor.places(self.positions, self.turned)
            found.append(contact_frames(places, self.fps, self.scale, labels))
        return found

    def _goal(self, foot: Foot, stands: list[tuple[np.ndarray, float]], shift: np.ndarray) -> _Goal:
        """Where a foot shall be so that heel and ball stay where they stand."""
        ankle = self.positions[:, foot.limb[2]] + shift
        places = [a.places(self.positions, self.turned) + shift for a in self._anchors(foot)]
        along = places[-1] - places[0]
        length = max(float(np.linalg.norm(along, axis=-1).mean()), self.nothing)
        turns = _TURN * length
        level = along * [1, 0, 1]
        # Where the foot points, however far its heel is lifted.
        level *= length / np.maximum(np.linalg.norm(level, axis=-1, keepdims=True), length / 2)
        offsets, holds, lifts = [], [], 0.0
        # The ball first: while it stands the heel may be lifted.
        for place, (mask, floor) in zip(places[::-1], stands[::-1], strict=True):
            if self.labels is None:
                mask = with_edges(mask, place, floor, self.fps, self.scale)
            spans = split_where_it_moves(
                contact_spans(mask, self.fps),
                np.stack([place, level], axis=1),
                self.fps,
                np.array([self.radius, turns]),
            )
            fastest = FASTEST * self.scale
            offset, hold = pin(place, spans, floor, self.fps, self.radius, fastest, lifts)
            offsets.insert(0, offset), holds.insert(0, hold[:, None])
            above = places[0][:, 1] + offset[:, 1] - stands[0][1]
            lifts = hold * _lifted(above, _LIFT * self.scale)
        turn = np.tile(IDENTITY, (len(ankle), 1))
        moved = offsets[0]
        if foot.ball is not None:
            # What only one of them holds moves the foot as a whole.
            heel = offsets[0] + (1 - holds[0]) * offsets[1]
            ball = offsets[1] + (1 - holds[1]) * offsets[0]
            # Pins of other spans may ask for more of a turn than a foot that stands makes. Then,
            # and where its length does not fit, the ball comes first: people turn on it.
            first = holds[1]
            excess = ball - heel - give_way(ball - heel, turns)
            heel, ball = heel + first * excess, ball - (1 - first) * excess
            turn = shortest_arc(_unit(along), _unit(along + ball - heel))
            about_heel = heel + rotate_vectors(turn, ankle - places[0]) - (ankle - places[0])
            about_ball = ball + rotate_vectors(turn, ankle - places[1]) - (ankle - places[1])
            moved = first * about_ball + (1 - first) * about_heel
        goal = _Goal(moved + shift, turn)
        goal.moved[:, 1] += self._lift(foot, goal, stands)
        return goal

    def _lift(self, foot: Foot, goal: _Goal, stands: list[tuple[np.ndarray, float]]) -> np.ndarray:
        """(T,) by how much the foot must come up for no point of it to be deeper than it was."""
        before = foot.sole_places(self.positions, self.turned)
        flat = np.any([mask for mask, _ in stands], axis=0)
        floors = np.median(before[flat, :, 1], axis=0) if flat.any() else before[..., 1].max(axis=0)
        ankle = self.positions[:, foot.limb[2], None]
        after = ankle + goal.moved[:, None] + rotate_vectors(goal.turn[:, None], before - ankle)
        if foot.toe is not None:
            toe = self.positions[:, foot.toe, None]
            at = ankle + goal.moved[:, None] + rotate_vectors(goal.turn[:, None], toe - ankle)
            tips = np.s_[:, len(foot.sole) - foot.n_toes :]
            after[tips] = at + rotate_vectors(_yaw(goal.turn)[:, None], before[tips] - toe)
        deeper = np.minimum(before[..., 1], floors) - after[..., 1]
        return np.maximum(deeper.max(axis=1), 0)

    def _lowered(self, goals: list[_Goal], shift: np.ndarray) -> np.ndarray:
        """(T,) by how much the hips come down for both feet to be in reach, smoothly."""
        low, length = np.zeros(len(shift)), np.zeros(1)
        for foot, goal in zip(self.feet, goals, strict=True):
            hip, knee, ankle = (self.positions[:, j] for j in foot.limb)
            length = np.linalg.norm(knee - hip, axis=-1) + np.linalg.norm(ankle - knee, axis=-1)
            now = np.linalg.norm(ankle - hip, axis=-1)
            away = hip + shift - ankle - goal.moved
            most = np.maximum(now, _STRETCH * length)
            reach = np.sqrt(np.maximum(most**2 - away[:, 0] ** 2 - away[:, 2] ** 2, 0))
            low = np.maximum(low, away[:, 1] - reach)
        low = np.where(low > self.nothing, low, 0)
        low = reachable(low, _LOWEST * length, 0 * low, 0.5)
        return smooth_upper_envelope(low, round(HIP_DROP_SECONDS * self.fps))

    def _posed(self, goals: list[_Goal], shift: np.ndarray) -> Motion:
        motion, skeleton = self.motion, self.skeleton
        rotations = motion.rotations.copy()
        changed = np.linalg.norm(shift, axis=-1) > self.nothing
        for goal in goals:
            changed |= np.linalg.norm(goal.moved, axis=-1) > self.nothing
            changed |= np.linalg.norm(goal.turn[:, :3], axis=-1) > _NOTHING
        for foot, goal in zip(self.feet, goals, strict=True):
            limb = list(foot.limb)
            above = self.turned[:, [skeleton.parents[j] for j in limb[:2]]]
            rotations[:, limb[:2]] = two_bone_ik(
                self.positions[:, limb] + shift[:, None],
                self.positions[:, limb[2]] + goal.moved,
                rotations[:, limb[:2]],
                above,
                hinge=True,
            )
        turned = global_rotations(rotations, skeleton)
        for foot, goal in zip(self.feet, goals, strict=True):
            _turn_to(rotations, turned, skeleton, foot.limb[2], self._own(foot.limb[2], goal.turn))
            if foot.toe is not None:
                turned = global_rotations(rotations, skeleton)
                _turn_to(
                    rotations, turned, skeleton, foot.toe, self._own(foot.toe, _yaw(goal.turn))
                )
        rotations = np.where(changed[:, None, None], rotations, motion.rotations)
        return _shifted(replace(motion, rotations=rotations), shift, self.turned)

    def _own(self, joint: int, turn: np.ndarray) -> np.ndarray:
        return multiply_quaternions(turn, self.turned[:, joint])


def _turn_to(
    rotations: np.ndarray, turned: np.ndarray, skeleton: Skeleton, joint: int, world: np.ndarray
) -> None:
    """Give a joint the local rotation by which it is turned to `world` (T, 4)."""
    back = invert_quaternions(turned[:, skeleton.parents[joint]])
    rotations[:, joint] = multiply_quaternions(back, world)


def _shifted(motion: Motion, shift: np.ndarray, turned: np.ndarray) -> Motion:
    """The motion with its body moved by `shift` (T, 3): the joint that carries it about moves."""
    skeleton = motion.skeleton
    hips = [skeleton.index(leg.hip) for leg in find_legs(skeleton).values()]
    above_both = set(skeleton.ancestors(hips[0])) & set(skeleton.ancestors(hips[1]))
    for j in sorted(above_both, reverse=True):
        if skeleton.names[j] in motion.joint_translations:
            own = rotate_vectors(invert_quaternions(turned[:, skeleton.parents[j]]), shift)
            moving = dict(motion.joint_translations)
            moving[skeleton.names[j]] = moving[skeleton.names[j]] + own
            return replace(motion, joint_translations=moving)
    return replace(motion, translation=motion.translation + shift)


def _lifted(above: np.ndarray, noise: float) -> np.ndarray:
    """(T,) of metres over the floor those that are no noise: none near it, all far from it."""
    above = np.maximum(above, 0)
    return above**3 / (above**2 + noise**2)


def _yaw(turn: np.ndarray) -> np.ndarray:
    """(..., 4) what of turns is about the vertical."""
    return normalize_quaternions(turn * [0.0, 1.0, 0.0, 1.0])


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)
