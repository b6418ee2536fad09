"""Where hips and feet go on another rig: what is planted stays planted, and stands on the floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gesturekit.motion.body_size import body_scale
from gesturekit.motion.contacts import CONTACT_SPEED
from gesturekit.motion.ik.two_bone import two_bone_ik
from gesturekit.motion.kinematics import global_rotations
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES
from gesturekit.motion.retarget.body_frames import BodyFrames
from gesturekit.motion.retarget.standing_pose import FORWARD
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    rotate_vectors,
)

_STRETCH = 0.995
"""Legs are not pulled straighter than this share of their length, unless the source's are."""
GIVE_WAY = 0.2
"""Seconds before and after in which the hips come down to where the legs reach."""


@dataclass(frozen=True, eq=False)
class Feet:
    """Where the source's feet are, and when they stand.

    Attributes:
        ankles, toes: side to (T, 3), metres; a side without a toe point has its ankle in `toes`.
        standing: side to (T,) bool, heel and toe both still.
        hips: (T, 3) middle between the hips.
        stretch: side to (T,), how straight that leg is, 0 to 1.
        floor: height of the lowest joint of a standing foot.
    """

    ankles: dict[str, np.ndarray]
    toes: dict[str, np.ndarray]
    standing: dict[str, np.ndarray]
    hips: np.ndarray
    stretch: dict[str, np.ndarray]
    floor: float

    @classmethod
    def of(cls, motion: Motion, frames: BodyFrames) -> Feet:
        """The feet of a motion."""
        positions, turned = motion.positions(), motion.global_rotations()
        ankles, toes, standing, stretch = {}, {}, {}, {}
        still = CONTACT_SPEED * body_scale(motion.skeleton)
        for side in SIDES:
            hip, knee, ankle = (
                positions[:, frames.joints[f"{side}_{part}"]] for part in ("hip", "knee", "ankle")
            )
            bones = [np.linalg.norm(b - a, axis=-1) for a, b in ((hip, knee), (knee, ankle))]
            stretch[side] = np.linalg.norm(ankle - hip, axis=-1) / sum(bones)
            ankles[side] = toes[side] = ankle
            if side in frames.toes:
                joint, offset = frames.toes[side]
                toes[side] = positions[:, joint] + rotate_vectors(turned[:, joint], offset)
            both = np.stack([ankles[side], toes[side]], axis=1)
            speed = np.linalg.norm(np.diff(both, axis=0, prepend=both[:1]), axis=-1) * motion.fps
            standing[side] = (speed < still).all(axis=1)
        lowest = {side: np.minimum(ankles[side], toes[side])[:, 1] for side in SIDES}
        still = np.concatenate([lowest[side][standing[side]] for side in SIDES])
        anyway = np.quantile(np.minimum(lowest["left"], lowest["right"]), 0.05)
        hips = sum(positions[:, frames.joints[f"{side}_hip"]] for side in SIDES) / 2
        return cls(
            ankles,
            toes,
            standing,
            hips,
            stretch,
            float(np.median(still) if len(still) > 10 else anyway),
        )

    def heights(
        self, source: BodyFrames, target: BodyFrames, same: bool, scale: float
    ) -> dict[str, tuple[tuple[float, float], tuple[float, float]]]:
        """Side to heights over the floor of (ankle, toe) on a level foot, source and target."""
        found = {}
        for side in SIDES:
            own = source.foot_heights(side)
            if self.standing[side].sum() >= 5:
                still = self.standing[side]
                own = tuple(
                    float(np.median(points[side][still, 1])) - self.floor
                    for points in (self.ankles, self.toes)
                )
            scaled = own[0] * scale, own[1] * scale
            found[side] = own, scaled if same else target.foot_heights(side)
        return found


@dataclass(frozen=True, eq=False)
class FootPlan:
    """Where hips and feet of the target shall be."""

    target: BodyFrames
    scale: float
    source: Feet
    heights: dict[str, tuple[tuple[float, float], tuple[float, float]]]
    frames_to_give_way: int

    def between_hips(self, positions: np.ndarray) -> np.ndarray:
        """(T, 3) middle between the target's hips."""
        return sum(positions[:, self.target.joints[f"{side}_hip"]] for side in SIDES) / 2

    def hips(self, turned: np.ndarray) -> np.ndarray:
        """(T, 3) where the middle between the target's hips shall be: above its ankles as the
        source's is, on the whole; longer or shorter feet than the source's shall not make it lean.
        """
        ankle = [np.mean([self.heights[side][i][0] for side in SIDES]) for i in (0, 1)]
        hips = self._scaled(self.source.hips, *ankle)
        moved = sum(
            self.ankle(side, turned) - self._scaled(self.source.ankles[side], *self._ankles(side))
            for side in SIDES
        )
        pelvis = self.target.joints["pelvis"]
        own = multiply_quaternions(turned[:, pelvis], self.target.own["pelvis"])
        ahead = rotate_vectors(own, np.broadcast_to(FORWARD, hips.shape))
        angle = np.arctan2(ahead[:, 0], ahead[:, 2])
        heading = np.stack([0 * angle, np.sin(angle / 2), 0 * angle, np.cos(angle / 2)], axis=-1)
        own_way = rotate_vectors(invert_quaternions(heading), moved / 2).mean(axis=0)
        return hips + rotate_vectors(heading, np.broadcast_to(own_way * [1, 0, 1], hips.shape))

    def _ankles(self, side: str) -> tuple[float, float]:
        own, target = self.heights[side]
        return own[0], target[0]

    def give_way(self, turned: np.ndarray, at_origin: np.ndarray, hips: np.ndarray) -> np.ndarray:
        """(T, 3) by how much the hips must come down for both feet to be in reach, smoothly."""
        low = np.zeros(len(hips))
        for side in SIDES:
            length = self.target.leg_lengths()[side]
            length = length * np.maximum(self.source.stretch[side], _STRETCH)
            hip = at_origin[:, self.target.joints[f"{side}_hip"]] - self.between_hips(at_origin)
            away = hips + hip - self.ankle(side, turned)
            reach = np.sqrt(np.maximum(length**2 - away[:, 0] ** 2 - away[:, 2] ** 2, 0))
            low = np.maximum(low, away[:, 1] - reach)
        low = smooth_above(low, self.frames_to_give_way)
        return np.stack([np.zeros_like(low), low, np.zeros_like(low)], axis=-1)

    def ankle(self, side: str, turned: np.ndarray) -> np.ndarray:
        """(T, 3) where an ankle of the target shall be: so that the ball of the foot is where the
        source has it, as people stand and turn on it."""
        (own_ankle, own_toe), (ankle, toe) = self.heights[side]
        if side not in self.target.toes:
            return self._scaled(self.source.ankles[side], own_ankle, ankle)
        tip = self._scaled(self.source.toes[side], own_toe, toe)
        foot = self.target.foot(side)
        turn = turned[:, self.target.joints[f"{side}_ankle"]]
        return tip - rotate_vectors(turn, np.broadcast_to(foot, tip.shape))

    def plant(
        self, rotations: np.ndarray, turned: np.ndarray, at_origin: np.ndarray, hips: np.ndarray
    ) -> np.ndarray:
        """(T, J, 4) local rotations with the ankles where they shall be, feet turned as before."""
        skeleton = self.target.skeleton
        rotations = rotations.copy()
        positions = at_origin + (hips - self.between_hips(at_origin))[:, None]
        for side in SIDES:
            hip, knee, ankle = limb = [
                self.target.joints[f"{side}_{part}"] for part in ("hip", "knee", "ankle")
            ]
            own = multiply_quaternions(turned[:, hip], self.target.own[f"{side}_hip"])
            above = turned[:, [skeleton.parents[hip], skeleton.parents[knee]]]
            rotations[:, [hip, knee]] = two_bone_ik(
                positions[:, limb],
                self.ankle(side, turned),
                rotations[:, [hip, knee]],
                above,
                pole=rotate_vectors(own, np.broadcast_to(FORWARD, (len(own), 3))),
            )
            now = global_rotations(rotations, skeleton)
            back = invert_quaternions(now[:, skeleton.parents[ankle]])
            rotations[:, ankle] = multiply_quaternions(back, turned[:, ankle])
        return rotations

    def _scaled(self, points: np.ndarray, own_height: float, height: float) -> np.ndarray:
        """Scaled about the floor under the hips of the first frame; heights over the floor count
        from `own_height` in the source and from `height` in the target."""
        floor = self.source.floor
        base = np.array([self.source.hips[0, 0], floor + own_height, self.source.hips[0, 2]])
        return (points - base) * self.scale + base + [0, height - own_height, 0]


def smooth_above(values: np.ndarray, frames: int) -> np.ndarray:
    """(T,) a smooth curve that is nowhere below `values` (T,), which are not negative."""
    if not values.any():
        return values
    around = np.pad(values, 2 * frames, mode="edge")
    highest = np.lib.stride_tricks.sliding_window_view(around, 2 * frames + 1).max(axis=-1)
    window = np.hanning(2 * frames + 3)[1:-1]
    return np.convolve(highest, window / window.sum(), mode="valid")
