"""Targets of retargeting: planted feet stay planted, and hands that meet also meet on the target.

If only directions are copied, hands end elsewhere on a body with wider shoulders or shorter arms:
folded hands come apart, or pass through each other. A hand near the middle of the body is therefore
placed where the source's is, relative to the midpoint of the shoulders and scaled by arm span. An
arm that hangs or points away keeps its direction. In between the two targets are blended.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gesturekit.motion.contacts import CONTACT_SPEED
from gesturekit.motion.ik import STRETCH, Reach, bend_limbs, smooth_upper_envelope, too_high
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.resampling import smoothstep
from gesturekit.motion.retarget.body_frames import BodyFrames
from gesturekit.motion.retarget.standing_pose import FORWARD
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    rotate_vectors,
)
from gesturekit.motion.skeleton import global_rotations

_FEWEST_STANDING = 5
"""Frames in which a foot must stand for its height to be measured."""


@dataclass(frozen=True, eq=False)
class FootMotion:
    """Foot positions of the source, and when each foot stands.

    Attributes:
        ankles: side to (T, 3), metres.
        toes: side to (T, 3) of the toe point, or of the ankle on a side without one, metres.
        standing: side to (T,) bool, true if heel and toe are both still.
        hips: (T, 3) midpoint between the hips, metres.
        stretch: side to (T,), distance from hip to ankle as a share of the leg length, 0 to 1.
        floor: height of the lowest joint of a standing foot, metres.
    """

    ankles: dict[str, np.ndarray]
    toes: dict[str, np.ndarray]
    standing: dict[str, np.ndarray]
    hips: np.ndarray
    stretch: dict[str, np.ndarray]
    floor: float

    @classmethod
    def measure(
        cls, motion: Motion, frames: BodyFrames, positions: np.ndarray, world: np.ndarray
    ) -> FootMotion:
        """Measure the feet of a motion.

        Args:
            motion: T frames.
            frames: segments of its rig.
            positions: (T, J, 3) positions of its joints, metres.
            world: (T, J, 4) their world rotations.
        """
        ankles, toes, standing, stretch = {}, {}, {}, {}
        still = CONTACT_SPEED * body_scale(motion.skeleton)
        for side in SIDES:
            hip, knee, ankle = (
                positions[:, frames.joints[f"{side}_{part}"]] for part in ("hip", "knee", "ankle")
            )
            bones = [np.linalg.norm(b - a, axis=1) for a, b in ((hip, knee), (knee, ankle))]
            stretch[side] = np.linalg.norm(ankle - hip, axis=1) / sum(bones)
            ankles[side] = toes[side] = ankle
            if side in frames.toes:
                joint, offset = frames.toes[side]
                toes[side] = positions[:, joint] + rotate_vectors(world[:, joint], offset)
            both = np.stack([ankles[side], toes[side]], axis=1)
            speed = np.linalg.norm(np.diff(both, axis=0, prepend=both[:1]), axis=2) * motion.fps
            standing[side] = (speed < still).all(axis=1)
        lowest = {side: np.minimum(ankles[side], toes[side])[:, 1] for side in SIDES}
        still = np.concatenate([lowest[side][standing[side]] for side in SIDES])
        fallback = np.quantile(np.minimum(lowest["left"], lowest["right"]), 0.05)
        left_hip, right_hip = (positions[:, frames.joints[f"{side}_hip"]] for side in SIDES)
        return cls(
            ankles,
            toes,
            standing,
            (left_hip + right_hip) / 2,
            stretch,
            float(np.median(still) if len(still) > 10 else fallback),
        )

    def heights(
        self, source: BodyFrames, target: BodyFrames, same: bool, scale: float
    ) -> dict[str, tuple[tuple[float, float], tuple[float, float]]]:
        """Return, for each side, (ankle, toe) heights above the floor of a level foot, metres.

        Args:
            source: segments of the source rig.
            target: segments of the target rig.
            same: both are one rig, apart from its size.
            scale: leg length of the target over that of the source.

        Returns:
            Side to the heights of the source and of the target.
        """
        heights = {}
        for side in SIDES:
            ankle, toe = source.foot_heights(side)
            if (still := self.standing[side]).sum() >= _FEWEST_STANDING:
                ankle, toe = (
                    float(np.median(points[side][still, 1])) - self.floor
                    for points in (self.ankles, self.toes)
                )
            scaled = ankle * scale, toe * scale
            heights[side] = (ankle, toe), scaled if same else target.foot_heights(side)
        return heights


@dataclass(frozen=True, eq=False)
class FootTargets:
    """Target positions of hips and feet.

    Attributes:
        target: segments of the target rig.
        scale: leg length of the target over that of the source.
        source: foot positions of the source.
        heights: see `FootMotion.heights`.
        drop_frames: frames before and after over which the hips move down.
        base: (3,) point on the floor about which the source is scaled, metres.
        shift: (3,) offset of the hips, see `mean_shift`; None before it is measured.
    """

    target: BodyFrames
    scale: float
    source: FootMotion
    heights: dict[str, tuple[tuple[float, float], tuple[float, float]]]
    drop_frames: int
    base: np.ndarray
    shift: np.ndarray | None = None

    def hip_centre(self, positions: np.ndarray) -> np.ndarray:
        """(T, 3) midpoint between the target's hips, from joint positions (T, J, 3), metres."""
        left, right = (positions[:, self.target.joints[f"{side}_hip"]] for side in SIDES)
        return (left + right) / 2

    def hips(self, world: np.ndarray) -> np.ndarray:
        """(T, 3) target midpoint between the hips, metres.

        Args:
            world: (T, J, 4) world rotations of the target's joints.
        """
        before, after = [np.mean([self.heights[side][i][0] for side in SIDES]) for i in (0, 1)]
        assert self.shift is not None
        hips = self._scaled(self.source.hips, float(before), float(after))
        return hips + rotate_vectors(self._heading(world), np.broadcast_to(self.shift, hips.shape))

    def mean_shift(self, world: np.ndarray) -> np.ndarray:
        """(3,) horizontal offset of the hips along the body's heading, metres.

        With it, their mean offset from the ankles is that of the source, so that a target with
        longer or shorter feet does not lean.

        Args:
            world: (T, J, 4) world rotations of the target's joints.
        """
        # Only the horizontal part is used, so no heights are needed.
        moved = sum(
            self.ankle(side, world) - self._scaled(self.source.ankles[side], 0.0, 0.0)
            for side in SIDES
        )
        back = invert_quaternions(self._heading(world))
        return rotate_vectors(back, moved / 2).mean(axis=0) * [1, 0, 1]

    def _heading(self, world: np.ndarray) -> np.ndarray:
        """(T, 4) rotations about the vertical that face where the target's pelvis does."""
        pelvis = self.target.joints["pelvis"]
        turns = multiply_quaternions(world[:, pelvis], self.target.from_anatomical["pelvis"])
        return heading_of(turns)

    def hip_drop(self, world: np.ndarray, positions: np.ndarray, hips: np.ndarray) -> np.ndarray:
        """(T, 3) smooth downward shift of the hips that brings both feet within reach, metres.

        Args:
            world: (T, J, 4) world rotations of the target's joints.
            positions: (T, J, 3) joint positions of the target, its root at the origin.
            hips: (T, 3) target midpoint between the hips.
        """
        low = np.zeros(len(hips))
        for side in SIDES:
            length = self.target.leg_lengths()[side]
            length = length * np.maximum(self.source.stretch[side], STRETCH)
            hip = positions[:, self.target.joints[f"{side}_hip"]] - self.hip_centre(positions)
            away = hips + hip - self.ankle(side, world)
            low = np.maximum(low, too_high(away, length))
        low = smooth_upper_envelope(low, self.drop_frames)
        return np.stack([np.zeros_like(low), low, np.zeros_like(low)], axis=1)

    def ankle(self, side: str, world: np.ndarray) -> np.ndarray:
        """(T, 3) target position of an ankle, metres.

        It puts the ball of the foot, on which people stand and turn, at the source's position.

        Args:
            side: "left" or "right".
            world: (T, J, 4) world rotations of the target's joints.
        """
        (own_ankle, own_toe), (ankle, toe) = self.heights[side]
        if side not in self.target.toes:
            return self._scaled(self.source.ankles[side], own_ankle, ankle)
        tip = self._scaled(self.source.toes[side], own_toe, toe)
        foot = self.target.foot(side)
        turn = world[:, self.target.joints[f"{side}_ankle"]]
        return tip - rotate_vectors(turn, np.broadcast_to(foot, tip.shape))

    def solve_legs(
        self, rotations: np.ndarray, world: np.ndarray, positions: np.ndarray, hips: np.ndarray
    ) -> np.ndarray:
        """(T, J, 4) local rotations with the ankles at their targets; feet keep their orientation.

        Args:
            rotations: (T, J, 4) local rotations of the target's joints.
            world: (T, J, 4) their world rotations.
            positions: (T, J, 3) their positions, the root at the origin.
            hips: (T, 3) target midpoint between the hips.
        """
        positions = positions + (hips - self.hip_centre(positions))[:, None]
        limbs = []
        for side in SIDES:
            joints = [self.target.joints[f"{side}_{part}"] for part in ("hip", "knee", "ankle")]
            thigh = self.target.from_anatomical[f"{side}_hip"]
            thigh = multiply_quaternions(world[:, joints[0]], thigh)
            pole = rotate_vectors(thigh, np.broadcast_to(FORWARD, (len(thigh), 3)))
            ankle, turn = self.ankle(side, world), world[:, joints[2]]
            limbs.append(Reach(joints[:2], joints[2], positions[:, joints], ankle, turn, pole))
        return bend_limbs(self.target.skeleton, rotations, world, limbs)

    def _scaled(self, points: np.ndarray, own_height: float, height: float) -> np.ndarray:
        """(T, 3) `points` (T, 3) scaled about a point on the floor.

        Height `own_height` above the floor in the source becomes `height` in the target.
        """
        base = self.base + [0, own_height, 0]
        return (points - base) * self.scale + base + [0, height - own_height, 0]


def heading_of(turns: np.ndarray) -> np.ndarray:
    """(T, 4) rotations about the vertical that face where anatomical frames (T, 4) face."""
    ahead = rotate_vectors(turns, np.broadcast_to(FORWARD, (len(turns), 3)))
    half = np.arctan2(ahead[:, 0], ahead[:, 2]) / 2
    return np.stack([0 * half, np.sin(half), 0 * half, np.cos(half)], axis=1)


_INSIDE, _OUTSIDE = 0.4, 1.1
"""Lateral distances from the middle of the body, as shares of half the shoulder width: up to the
first a hand is placed by position, from the second on by the direction of its arm."""


def place_hands(
    source: BodyFrames,
    target: BodyFrames,
    source_positions: np.ndarray,
    source_world: np.ndarray,
    positions: np.ndarray,
    rotations: np.ndarray,
) -> np.ndarray:
    """(T, J, 4) local rotations of the target with hands near the body placed as on the source.

    Args:
        source: segments of the source rig.
        target: segments of the target rig.
        source_positions: (T, J', 3) positions of the source's joints, metres.
        source_world: (T, J', 4) world rotations of the source's joints.
        positions: (T, J, 3) positions of the target's joints, before hands are placed.
        rotations: (T, J, 4) local rotations of the target's joints.
    """
    if any(side not in frames.hands for side in SIDES for frames in (source, target)):
        return rotations
    chest = source.chain("spine")[-1]
    torso = multiply_quaternions(
        source_world[:, source.joints[chest]], source.from_anatomical[chest]
    )
    world = global_rotations(rotations, target.skeleton)
    source_arms = _arms(source, source_positions, source_world)
    arms = _arms(target, positions, world)
    scale = _span(arms) / _span(source_arms)
    limbs = []
    for side, outward in zip(SIDES, (1.0, -1.0)):
        middle = _between_shoulders(source_arms)
        away = source_arms[side][:, 2] - middle
        lateral = rotate_vectors(invert_quaternions(torso), away)[:, 0]
        half = np.linalg.norm(source_arms[side][:, 0] - middle, axis=1)
        share = np.clip((outward * lateral / half - _INSIDE) / (_OUTSIDE - _INSIDE), 0, 1)
        weight = 1 - smoothstep(share)
        by_position = _between_shoulders(arms) + scale * away
        by_direction = arms[side][:, 2]
        bones = [target.joints[f"{side}_{part}"] for part in ("shoulder", "elbow")]
        upper_arm = multiply_quaternions(
            world[:, bones[0]], target.from_anatomical[f"{side}_shoulder"]
        )
        pole = rotate_vectors(upper_arm, np.broadcast_to(-FORWARD, by_position.shape))
        goal = by_direction + weight[:, None] * (by_position - by_direction)
        wrist = target.joints.get(f"{side}_wrist")
        turn = None if wrist is None else world[:, wrist]  # the hand keeps its orientation
        limbs.append(Reach(bones, wrist, arms[side], goal, turn, pole))
    return bend_limbs(target.skeleton, rotations, world, limbs)


def _arms(frames: BodyFrames, positions: np.ndarray, world: np.ndarray) -> dict[str, np.ndarray]:
    """Return side to (T, 3, 3), positions of shoulder, elbow and hand, metres."""
    arms = {}
    for side in SIDES:
        bones = [frames.joints[f"{side}_{part}"] for part in ("shoulder", "elbow")]
        joint, offset = frames.hands[side]
        hand = positions[:, joint] + rotate_vectors(world[:, joint], offset)
        arms[side] = np.concatenate([positions[:, bones], hand[:, None]], axis=1)
    return arms


def _between_shoulders(arms: dict[str, np.ndarray]) -> np.ndarray:
    """(T, 3) midpoint of the shoulders, metres."""
    return (arms["left"][:, 0] + arms["right"][:, 0]) / 2


def _span(arms: dict[str, np.ndarray]) -> float:
    """Return metres from the shoulders' midpoint to an outstretched hand, mean of both arms."""
    lengths = sum(np.linalg.norm(np.diff(arm, axis=1), axis=2).sum(axis=1) for arm in arms.values())
    shoulders = np.linalg.norm(arms["left"][:, 0] - arms["right"][:, 0], axis=1)
    return float(np.median(lengths + shoulders)) / 2
