"""Foot locking: remove the sliding of standing feet.

1. Find the contact spans of heel and ball of each foot, from the contact labels predicted by the
   model, or from speed and height (`feet`).
2. Subtract slow sliding that is common to the standing feet from the hip path (`horizontal_drift`).
3. Pin each point at its mean position on the floor in each span, and blend the correction in and
   out. A foot is never pulled down in flight: it rolls onto and off the floor as
   before. While the heel lifts, only the ball is pinned; a flat foot is pinned at both and rotated
   as a whole.
4. Raise feet that would sink deeper than before, and lower the hips if a leg is too short.
5. Solve hips and knees by two-bone IK (`gesturekit.motion.ik`). The ankle keeps the
   orientation of the foot, and the toes keep theirs.

Frames without contact do not change.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gesturekit.errors import MotionError
from gesturekit.motion.ik import Reach, bend_limbs, reachable
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs, leg_length
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.retarget.targets import HIP_DROP_SECONDS, smooth_upper_envelope
from gesturekit.motion.rotations import (
    IDENTITY,
    invert_quaternions,
    multiply_quaternions,
    normalize_quaternions,
    rotate_vectors,
    shortest_arc,
)
from gesturekit.motion.skeleton import global_rotations
from gesturekit.postprocess.feet import (
    FASTEST,
    Foot,
    contact_frames,
    contact_spans,
    feet_of_legs,
    gaussian_smoothed,
    include_landing,
    pin,
    soft_clamp,
    split_at_movement,
)

_MAX_CORRECTION = 0.1
"""Largest correction of a foot, as a share of the leg length."""
_MAX_TURN = 0.15
"""Largest difference between corrections of heel and ball, as a share of the foot length."""
_LIFT = 0.01
"""Metres on the reference body; a heel that is higher while the ball stands is really lifted."""
_STRETCH = 0.995
"""Legs are not stretched beyond this share of their length, unless they were before."""
_MAX_DROP = 0.05
"""Largest lowering of the hips, as a share of the leg length."""
_NOTHING = 1e-7
"""Metres on the reference body, and sines of half angles, that count as no change."""


def lock_feet(
    motion: Motion, contacts: np.ndarray | None = None, *, keep_path: bool = False
) -> Motion:
    """Remove the sliding of standing feet.

    Args:
        motion: T frames of any rig; one without two identifiable legs does not change.
        contacts: (T, F) labels of the points of `gesturekit.motion.contacts.foot_points`, above 0.5
            if a point stands; None decides by speed and height.
        keep_path: keep the hip path even if both feet slide with it, for motion that follows a
            requested path.

    Returns:
        The motion with corrected legs and, if both feet slid together, a corrected hip path.
        Frames without contact keep their pose bit for bit.

    Raises:
        MotionError: labels of another shape.
    """
    if find_legs(motion.skeleton) is None:
        return motion
    return _FootLock(motion, contacts).locked(keep_path)


class _Goal(NamedTuple):
    """Correction of a foot in the world: (T, 3) movement of its ankle, (T, 4) rotation."""

    moved: np.ndarray
    turn: np.ndarray


class _FootLock:
    """Foot locking of one motion; `stands` holds (mask (T,), floor height) of each anchor.

    Only the legs and the joints above them are computed: `self.motion` has no others, and `kept`
    are their indices in the whole rig.
    """

    def __init__(self, motion: Motion, contacts: np.ndarray | None) -> None:
        self.kept, self.feet = feet_of_legs(motion.skeleton)
        self.whole, self.fps = motion, motion.fps
        self.motion = motion.keep([motion.skeleton.names[j] for j in self.kept])
        self.skeleton = self.motion.skeleton
        columns = max(k for foot in self.feet for anchor in foot.anchors for k in anchor.columns)
        self.labels = None if contacts is None else np.asarray(contacts, dtype=np.float64)
        if self.labels is not None and self.labels.shape != (motion.n_frames, columns + 1):
            need = f"({motion.n_frames}, {columns + 1})"
            raise MotionError(f"contacts have shape {self.labels.shape}; expected {need}")
        self.world = self.motion.global_rotations()
        self.positions = self.motion.positions()
        self.radius = _MAX_CORRECTION * leg_length(motion.skeleton)
        self.scale = body_scale(motion.skeleton)
        self.nothing = _NOTHING * self.scale

    def locked(self, keep_path: bool) -> Motion:
        """Return the corrected motion; see `lock_feet`."""
        stands = [self._stands(foot) for foot in self.feet]
        either = [np.any([mask for mask, _ in foot], axis=0) for foot in stands]
        standing = np.stack(either, axis=1)
        if not standing.any():
            return self.whole
        shift = np.zeros((self.motion.n_frames, 3))
        if not keep_path:
            left, right = (np.mean(self._places(foot), axis=0) for foot in self.feet)
            shift -= horizontal_drift(left, right, standing, self.fps)
            heights = np.stack(list(map(self._height, self.feet, stands)), axis=1)
            shift[:, 1] -= height_error(heights, standing, self.fps)
        goals = [self._goal(*foot, shift) for foot in zip(self.feet, stands, strict=True)]
        shift[:, 1] -= self._hip_drop(goals, shift)
        return self._posed(goals, shift)

    def _places(self, foot: Foot) -> list[np.ndarray]:
        """Return the (T, 3) world positions of each anchor, metres."""
        return [anchor.positions(self.positions, self.world) for anchor in foot.anchors]

    def _height(self, foot: Foot, stands: list[tuple[np.ndarray, float]]) -> np.ndarray:
        """(T,) height of the ball, or of the heel if only that stands, above its floor, metres."""
        heights = [
            place[:, 1] - floor
            for place, (_, floor) in zip(self._places(foot), stands, strict=True)
        ]
        # The ball takes precedence, because the heel may be lifted.
        return np.where(stands[-1][0], heights[-1], heights[0])

    def _stands(self, foot: Foot) -> list[tuple[np.ndarray, float]]:
        """Return, for heel and ball, a contact mask (T,) and the height of the floor, metres."""
        stands = []
        for anchor, place in zip(foot.anchors, self._places(foot), strict=True):
            labels = None
            if self.labels is not None:
                labels = self.labels[:, list(anchor.columns)].mean(axis=1)
            stands.append(contact_frames(place, self.fps, self.scale, labels))
        return stands

    def _goal(self, foot: Foot, stands: list[tuple[np.ndarray, float]], shift: np.ndarray) -> _Goal:
        """Return the correction that keeps heel and ball in place while they stand.

        `stands` holds contact mask (T,) and floor height of each anchor; `shift` (T, 3) moves the
        hips.
        """
        ankle = self.positions[:, foot.ankle] + shift
        places = [place + shift for place in self._places(foot)]
        along = places[-1] - places[0]
        length = max(float(np.linalg.norm(along, axis=1).mean()), self.nothing)
        max_turn = _MAX_TURN * length
        offsets, holds = self._pinned(places, stands, length, max_turn)
        turn = np.tile(IDENTITY, (len(ankle), 1))
        moved = offsets[0]
        if foot.ball is not None:
            # A correction of only one anchor moves the foot as a whole.
            heel = offsets[0] + (1 - holds[0]) * offsets[1]
            ball = offsets[1] + (1 - holds[1]) * offsets[0]
            # If the two pins need too large a turn, or do not match the length of the foot, the
            # ball takes precedence, because people turn on it.
            first = holds[1]
            excess = ball - heel - soft_clamp(ball - heel, max_turn)
            heel, ball = heel + first * excess, ball - (1 - first) * excess
            turn = shortest_arc(_unit(along), _unit(along + ball - heel))
            about_heel = heel + rotate_vectors(turn, ankle - places[0]) - (ankle - places[0])
            about_ball = ball + rotate_vectors(turn, ankle - places[1]) - (ankle - places[1])
            moved = first * about_ball + (1 - first) * about_heel
        goal = _Goal(moved + shift, turn)
        goal.moved[:, 1] += self._lift(foot, goal, stands)
        return goal

    def _pinned(
        self,
        places: list[np.ndarray],
        stands: list[tuple[np.ndarray, float]],
        length: float,
        max_turn: float,
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return, for each anchor, its corrections (T, 3) and the weight (T, 1) of its pin.

        `places` are each anchor's world positions (T, 3), `stands` its contact mask (T,) and floor
        height; `max_turn` is the foot's largest turn, in metres at its length.
        """
        # Direction of the foot on the ground, also while its heel is lifted.
        level = (places[-1] - places[0]) * [1, 0, 1]
        level *= length / np.maximum(np.linalg.norm(level, axis=1, keepdims=True), length / 2)
        offsets, holds, lifts = list[np.ndarray](), list[np.ndarray](), 0.0
        # The ball first, because the heel may be lifted while the ball stands.
        for place, (mask, floor) in zip(places[::-1], stands[::-1], strict=True):
            if self.labels is None:
                mask = include_landing(mask, place, floor, self.fps, self.scale)
            spans = split_at_movement(
                contact_spans(mask, self.fps),
                np.stack([place, level], axis=1),
                self.fps,
                np.array([self.radius, max_turn]),
            )
            fastest = FASTEST * self.scale
            offset, hold = pin(place, spans, floor, self.fps, self.radius, fastest, lifts)
            offsets.insert(0, offset)
            holds.insert(0, hold[:, None])
            heel_height = places[0][:, 1] + offset[:, 1] - stands[0][1]
            lifts = hold * _above_noise(heel_height, _LIFT * self.scale)
        return offsets, holds

    def _lift(self, foot: Foot, goal: _Goal, stands: list[tuple[np.ndarray, float]]) -> np.ndarray:
        """(T,) lift of the foot that keeps its points from sinking deeper than before, metres."""
        before = foot.sole_positions(self.positions, self.world)
        flat = np.any([mask for mask, _ in stands], axis=0)
        floors = np.median(before[flat, :, 1], axis=0) if flat.any() else before[..., 1].max(axis=0)
        ankle = self.positions[:, foot.ankle, None]
        after = ankle + goal.moved[:, None] + rotate_vectors(goal.turn[:, None], before - ankle)
        if foot.toe is not None:
            toe = self.positions[:, foot.toe, None]
            at = ankle + goal.moved[:, None] + rotate_vectors(goal.turn[:, None], toe - ankle)
            tips = np.s_[:, len(foot.sole) - foot.n_toes :]
            after[tips] = at + rotate_vectors(_yaw(goal.turn)[:, None], before[tips] - toe)
        deeper = np.minimum(before[..., 1], floors) - after[..., 1]
        return np.maximum(deeper.max(axis=1), 0)

    def _hip_drop(self, goals: list[_Goal], shift: np.ndarray) -> np.ndarray:
        """(T,) smooth lowering of the hips that brings both feet within reach, metres."""
        low = np.zeros(len(shift))
        for foot, goal in zip(self.feet, goals, strict=True):
            hip, knee, ankle = (self.positions[:, j] for j in foot.limb)
            length = np.linalg.norm(knee - hip, axis=1) + np.linalg.norm(ankle - knee, axis=1)
            now = np.linalg.norm(ankle - hip, axis=1)
            away = hip + shift - ankle - goal.moved
            most = np.maximum(now, _STRETCH * length)
            reach = np.sqrt(np.maximum(most**2 - away[:, 0] ** 2 - away[:, 2] ** 2, 0))
            low = np.maximum(low, away[:, 1] - reach)
        low = np.where(low > self.nothing, low, 0)
        low = reachable(low, _MAX_DROP * length, 0 * low, 0.5)
        return smooth_upper_envelope(low, round(HIP_DROP_SECONDS * self.fps))

    def _posed(self, goals: list[_Goal], shift: np.ndarray) -> Motion:
        """Return the motion with legs solved for the goals and hips moved by `shift` (T, 3)."""
        skeleton, limbs = self.skeleton, []
        changed = np.linalg.norm(shift, axis=1) > self.nothing
        for goal in goals:
            changed |= np.linalg.norm(goal.moved, axis=1) > self.nothing
            changed |= np.linalg.norm(goal.turn[:, :3], axis=1) > _NOTHING
        # Ankles and toes keep their world rotations, turned with the foot.
        for foot, goal in zip(self.feet, goals, strict=True):
            places = self.positions[:, foot.limb]
            turn = multiply_quaternions(goal.turn, self.world[:, foot.ankle])
            target = places[:, 2] + goal.moved
            places = places + shift[:, None]
            limbs.append(Reach([foot.hip, foot.knee], foot.ankle, places, target, turn))
        rotations = bend_limbs(skeleton, self.motion.rotations, self.world, limbs, hinge=True)
        world = global_rotations(rotations, skeleton)
        for foot, goal in zip(self.feet, goals, strict=True):
            if foot.toe is not None:
                back = invert_quaternions(world[:, skeleton.parents[foot.toe]])
                turn = multiply_quaternions(_yaw(goal.turn), self.world[:, foot.toe])
                rotations[:, foot.toe] = multiply_quaternions(back, turn)
        locked = self.whole.rotations.copy()
        locked[:, self.kept] = np.where(changed[:, None, None], rotations, self.motion.rotations)
        return self._shifted(replace(self.whole, rotations=locked), shift)

    def _shifted(self, motion: Motion, shift: np.ndarray) -> Motion:
        """Return the whole motion with the body moved by `shift` (T, 3) at its carrying joint."""
        skeleton, (left, right) = self.skeleton, (foot.hip for foot in self.feet)
        above_both = set(skeleton.ancestors(left)) & set(skeleton.ancestors(right))
        for j in sorted(above_both, reverse=True):
            if skeleton.names[j] in motion.joint_translations:
                back = invert_quaternions(self.world[:, skeleton.parents[j]])
                moving = dict(motion.joint_translations)
                moving[skeleton.names[j]] = moving[skeleton.names[j]] + rotate_vectors(back, shift)
                return replace(motion, joint_translations=moving)
        return replace(motion, translation=motion.translation + shift)


def _above_noise(height: np.ndarray, noise: float) -> np.ndarray:
    """(T,) heights above the floor, with those below `noise` suppressed, metres."""
    height = np.maximum(height, 0)
    return height**3 / (height**2 + noise**2)


def _yaw(turn: np.ndarray) -> np.ndarray:
    """(..., 4) components of rotations about the vertical."""
    return normalize_quaternions(turn * [0.0, 1.0, 0.0, 1.0])


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)


_STEADY = 0.2
"""Seconds (standard deviation) over which foot speeds are smoothed before they are compared."""
_SWAY = 1.0
"""Seconds (standard deviation); faster movement is sway, which the legs absorb, and not drift."""


def horizontal_drift(
    left: np.ndarray, right: np.ndarray, stands: np.ndarray, fps: float
) -> np.ndarray:
    """(T, 3) horizontal distance that the standing feet have slid so far, without sway, metres.

    If both feet stand, the drift is the common part of their velocities; if one stands, it is that
    foot's velocity. Zero in frame 0.

    Args:
        left: (T, 3) positions of the left foot, metres.
        right: (T, 3) positions of the right foot, metres.
        stands: (T, 2) bool, true if the left or right foot stands.
        fps: frames per second.
    """
    both = np.stack([left, right], axis=1)
    standing = np.zeros(stands.shape)
    standing[1:] = stands[1:] & stands[:-1]
    steps = np.diff(both, axis=0, prepend=both[:1]) * [1, 0, 1] * standing[..., None]
    weight = gaussian_filter1d(standing, _STEADY * fps, axis=0, mode="constant")[..., None]
    steady = gaussian_filter1d(steps, _STEADY * fps, axis=0, mode="constant")
    steady /= np.maximum(weight, 1e-6)
    return gaussian_smoothed(np.cumsum(_common(steady, standing), axis=0), _SWAY * fps)


def height_error(heights: np.ndarray, stands: np.ndarray, fps: float) -> np.ndarray:
    """(T,) smoothed height above the floor that is common to the standing feet, metres.

    `heights` (T, 2) are above the feet's standing heights, metres; `stands` as in
    `horizontal_drift`.
    """
    standing = stands.astype(float)
    common = _common(heights[..., None] * standing[..., None], standing)
    weight = gaussian_smoothed(standing.max(axis=1), _SWAY * fps)
    return gaussian_smoothed(common[:, 0], _SWAY * fps) / np.maximum(weight, 0.5)


def _common(both: np.ndarray, standing: np.ndarray) -> np.ndarray:
    """(T, D) common part of two vectors (T, 2, D), one a foot.

    If both feet stand, it points along the mean and is as long as the shorter of the projections
    onto it. If one stands, it is that foot's vector.
    """
    alone = (both * standing[..., None]).sum(axis=1)
    mean = both.mean(axis=1)
    direction = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    least = (both * direction[:, None]).sum(axis=2).min(axis=1)
    together = direction * np.maximum(least, 0)[:, None]
    return np.where(standing.all(axis=1, keepdims=True), together, alone)
