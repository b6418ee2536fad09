"""Hand placement of retargeting: hands that meet on the source also meet on the target.

If only directions are copied, hands end elsewhere on a body with wider shoulders or shorter arms:
folded hands come apart, or pass through each other. A hand near the middle of the body is therefore
placed where the source's is, relative to the midpoint of the shoulders and scaled by arm span. An
arm that hangs or points away keeps its direction. In between the two targets are blended.
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
    skeleton = target.skeleton
    chest = source.chain("spine")[-1]
    torso = multiply_quaternions(
        source_world[:, source.joints[chest]], source.from_anatomical[chest]
    )
    world = global_rotations(rotations, skeleton)
    source_arms = _arms(source, source_positions, source_world)
    arms = _arms(target, positions, world)
    scale = _span(arms) / _span(source_arms)
    rotations = rotations.copy()
    for side, outward in zip(SIDES, (1.0, -1.0)):
        middle = _between_shoulders(source_arms)
        away = source_arms[side][:, 2] - middle
        own = rotate_vectors(invert_quaternions(torso), away)
        half = np.linalg.norm(source_arms[side][:, 0] - middle, axis=1)
        share = np.clip((outward * own[:, 0] / half - _INSIDE) / (_OUTSIDE - _INSIDE), 0, 1)
        weight = 1 - share * share * (3 - 2 * share)
        by_position = _between_shoulders(arms) + scale * away
        by_direction = arms[side][:, 2]
        bones = [target.joints[f"{side}_{part}"] for part in ("shoulder", "elbow")]
        upper_arm = multiply_quaternions(
            world[:, bones[0]], target.from_anatomical[f"{side}_shoulder"]
        )
        rotations[:, bones] = two_bone_ik(
            arms[side],
            by_direction + weight[:, None] * (by_position - by_direction),
            rotations[:, bones],
            world[:, [skeleton.parents[j] for j in bones]],
            pole=rotate_vectors(upper_arm, np.broadcast_to(-FORWARD, by_position.shape)),
        )
    now = global_rotations(rotations, skeleton)
    for side in SIDES:
        wrist = target.joints.get(f"{side}_wrist")
        if wrist is not None:  # keep the orientation of the hand
            back = invert_quaternions(now[:, skeleton.parents[wrist]])
            rotations[:, wrist] = multiply_quaternions(back, world[:, wrist])
    return rotations


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
