"""Where hands go on another rig: hands that meet in front of one body meet in front of the other.

Arms that point the same way end elsewhere where shoulders are wider or arms shorter: hands that
were folded come apart, or pass through each other. A hand near the middle of the body therefore
goes where the source's is, seen from between the shoulders and scaled by the arms' span; an arm
that hangs or points away keeps its direction; in between it is some of both.
"""

from __future__ import annotations

import numpy as np

from gesturekit.motion.ik.two_bone import two_bone_ik
from gesturekit.motion.kinematics import global_rotations
from gesturekit.motion.parts import SIDES
from gesturekit.motion.retarget.body_frames import BodyFrames
from gesturekit.motion.retarget.standing_pose import FORWARD
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    rotate_vectors,
)

_INSIDE, _OUTSIDE = 0.4, 1.1
"""Shares of half the shoulders' width from the body's middle: nearer than the first a hand goes by
its place, farther than the second by the arm's direction."""


def place_hands(
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
    if any(side not in frames.hands for side in SIDES for frames in (source, target)):
        return rotations
    skeleton = target.skeleton
    chest = source.chain("spine")[-1]
    across = multiply_quaternions(source_turned[:, source.joints[chest]], source.own[chest])
    turned = global_rotations(rotations, skeleton)
    source_arms = _arms(source, source_positions, source_turned)
    arms = _arms(target, positions, turned)
    scale = _span(arms) / _span(source_arms)
    rotations = rotations.copy()
    for side, outward in zip(SIDES, (1.0, -1.0)):
        middle = _between_shoulders(source_arms)
        away = source_arms[side][:, 2] - middle
        own = rotate_vectors(invert_quaternions(across), away)
        half = np.linalg.norm(source_arms[side][:, 0] - middle, axis=-1)
        share = np.clip((outward * own[:, 0] / half - _INSIDE) / (_OUTSIDE - _INSIDE), 0, 1)
        weight = 1 - share * share * (3 - 2 * share)
        at_place = _between_shoulders(arms) + scale * away
        by_direction = arms[side][:, 2]
        bones = [target.joints[f"{side}_{part}"] for part in ("shoulder", "elbow")]
        upper_arm = multiply_quaternions(turned[:, bones[0]], target.own[f"{side}_shoulder"])
        rotations[:, bones] = two_bone_ik(
            arms[side],
            by_direction + weight[:, None] * (at_place - by_direction),
            rotations[:, bones],
            turned[:, [skeleton.parents[j] for j in bones]],
            pole=rotate_vectors(upper_arm, np.broadcast_to(-FORWARD, at_place.shape)),
        )
        wrist = target.joints.get(f"{side}_wrist")
        if wrist is not None:  # the hand stays turned as it was
            above = global_rotations(rotations, skeleton)[:, skeleton.parents[wrist]]
            back = invert_quaternions(above)
            rotations[:, wrist] = multiply_quaternions(back, turned[:, wrist])
    return rotations


def _arms(frames: BodyFrames, positions: np.ndarray, turned: np.ndarray) -> dict[str, np.ndarray]:
    """Side to (T, 3, 3), places of shoulder, elbow and wrist."""
    arms = {}
    for side in SIDES:
        bones = [frames.joints[f"{side}_{part}"] for part in ("shoulder", "elbow")]
        joint, offset = frames.hands[side]
        hand = positions[:, joint] + rotate_vectors(turned[:, joint], offset)
        arms[side] = np.concatenate([positions[:, bones], hand[:, None]], axis=1)
    return arms


def _between_shoulders(arms: dict[str, np.ndarray]) -> np.ndarray:
    return sum(arm[:, 0] for arm in arms.values()) / 2


def _span(arms: dict[str, np.ndarray]) -> float:
    """Metres from the middle of the shoulders to the wrist of an outstretched arm, mean of both."""
    lengths = sum(
        np.linalg.norm(np.diff(arm, axis=1), axis=-1).sum(axis=1) for arm in arms.values()
    )
    shoulders = np.linalg.norm(arms["left"][:, 0] - arms["right"][:, 0], axis=-1)
    return float(np.median(lengths + shoulders)) / 2
