"""Where hands go on another rig: hands that meet in front of one body meet in front of the other.

Arms that point the same way end elsewhere where shoulders are wider or arms shorter: hands that
were folded come apart, or pass through each other. A hand near the middle of the body therefore
goes where the source's is, seen from between the shoulders and scaled by the arms' span; an arm
that hangs or points away keeps its direction; in between it is some of both.
"""

from __future__ import annotations

import numpy as np

from gesturekit.motion.body_frames import BodyFrames
from gesturekit.motion.ik import two_bone_ik
from gesturekit.motion.kinematics import global_rotations
from gesturekit.motion.parts import SIDES
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    rotate_vectors,
)
from gesturekit.motion.standing import FORWARD

_INSIDE, _OUTSIDE = 0.4, 1.1
"""Shares of half the shoulders' width from the body's middle: nearer than the first a hand goes by
its place, farther than the second by the arm's direction."""

_ARM = ("shoulder", "elbow", "wrist")


def reach_hands(
    source: BodyFrames,
    target: BodyFrames,
    source_positions: np.ndarray,
    source_turned: np.ndarray,
    positions: np.ndarray,
    rotations: np.ndarray,
) -> np.ndarray:
    """(T, J, 4) the target's local rotations with hands near the body where the source has them.

    Args:
        source: segments of the source's rig.
        target: segments of the target's.
        source_positions: (T, J', 3) of the source's joints.
        source_turned: (T, J', 4) world rotations of the source's joints.
        positions: (T, J, 3) of the target's joints, its arms turned like the source's.
        rotations: (T, J, 4) local rotations of the target's joints.
    """
    needed = [f"{side}_wrist" for side in SIDES]
    if any(segment not in frames.joints for segment in needed for frames in (source, target)):
        return rotations
    skeleton = target.skeleton
    chest = source.chain("spine")[-1]
    across = multiply_quaternions(source_turned[:, source.joints[chest]], source.own[chest])
    scale = _span(positions, target) / _span(source_positions, source)
    rotations = rotations.copy()
    for side, outward in zip(SIDES, (1.0, -1.0)):
        middle = _between_shoulders(source_positions, source)
        away = source_positions[:, source.joints[f"{side}_wrist"]] - middle
        own = rotate_vectors(invert_quaternions(across), away)
        shoulder = source_positions[:, source.joints[f"{side}_shoulder"]] - middle
        half = np.linalg.norm(shoulder, axis=-1)
        share = np.clip((outward * own[:, 0] / half - _INSIDE) / (_OUTSIDE - _INSIDE), 0, 1)
        weight = 1 - share * share * (3 - 2 * share)
        limb = [target.joints[f"{side}_{part}"] for part in _ARM]
        at_place = _between_shoulders(positions, target) + scale * away
        by_direction = positions[:, limb[2]]
        turned = global_rotations(rotations, skeleton)
        elbow = multiply_quaternions(turned[:, limb[0]], target.own[f"{side}_shoulder"])
        rotations[:, limb[:2]] = two_bone_ik(
            positions[:, limb],
            by_direction + weight[:, None] * (at_place - by_direction),
            rotations[:, limb[:2]],
            turned[:, [skeleton.parents[j] for j in limb[:2]]],
            pole=rotate_vectors(elbow, np.broadcast_to(-FORWARD, (len(elbow), 3))),
        )
        # The hand stays turned as it was.
        above = global_rotations(rotations, skeleton)[:, skeleton.parents[limb[2]]]
        rotations[:, limb[2]] = multiply_quaternions(invert_quaternions(above), turned[:, limb[2]])
    return rotations


def _between_shoulders(positions: np.ndarray, frames: BodyFrames) -> np.ndarray:
    return sum(positions[:, frames.joints[f"{side}_shoulder"]] for side in SIDES) / 2


def _span(positions: np.ndarray, frames: BodyFrames) -> float:
    """Metres from the middle of the shoulders to the wrist of an outstretched arm, mean of both."""
    ways = [positions[:, [frames.joints[f"{s}_{p}"] for p in _ARM]] for s in SIDES]
    arms = sum(np.linalg.norm(np.diff(way, axis=1), axis=-1).sum(axis=1) for way in ways)
    shoulders = np.linalg.norm(ways[0][:, 0] - ways[1][:, 0], axis=-1)
    return float(np.median(arms + shoulders)) / 2
