"""The pose in which a rig stands upright: its rest pose, a frame of a motion, or one worked out.

What a rig's joint axes mean is told by a pose of which we know what it looks like. Most rigs stand
at rest, their arms out, lowered or wherever. Others (Bandai-Namco's, all whose bones lie along
their own axes) are a heap of bones at rest: for them it takes a frame in which the body stands.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.kinematics import forward_kinematics
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES, BodyParts, find_parts
from gesturekit.motion.rotations import (
    IDENTITY,
    invert_quaternions,
    multiply_quaternions,
    quaternion_from_matrix,
    rotate_vectors,
    shortest_arc,
)
from gesturekit.motion.skeleton import Skeleton

LEFT, UP, FORWARD = np.eye(3)
"""Axes of a body that stands and faces +Z."""

_NO_LENGTH, _NO_BONE, _NO_WAY = 1e-6, 1e-4, 1e-3
"""Metres on the reference body; shorter bones of a limb, of the trunk, and ways between collar
bones have no direction."""
_UPRIGHT = np.cos(np.deg2rad(45.0))
_AXIS_ALIGNED = np.cos(np.deg2rad(20.0))


def standing_pose(motion: Motion, parts: BodyParts | None = None) -> np.ndarray:
    """(J, 4) local rotations in which the body of a motion stands upright.

    The rest pose where it stands, else the frame that stands most upright with its arms down.

    Raises:
        MotionError: it stands neither at rest nor in any frame.
    """
    skeleton = motion.skeleton
    parts = parts or find_parts(skeleton)
    rest = rest_pose(skeleton)
    if _stands(skeleton, parts, rest):
        return rest
    positions = motion.positions()
    bones = _bones(skeleton, parts, positions)
    score = bones["torso"][..., 1] - sum(
        bones[f"{side}_{bone}"][..., 1] * weight
        for side in SIDES
        for bone, weight in (("thigh", 1.0), ("shank", 1.0), ("arm", 0.25))
    )
    pose = motion.rotations[int(score.argmax())]
    if not _stands(skeleton, parts, pose):
        raise MotionError(
            "the body stands upright neither at rest nor in any frame; are its parts right? "
            f"Pelvis {parts.pelvis!r}, left knee {parts.legs['left'].knee!r}, left elbow "
            f"{parts.arms['left'].elbow!r}; name them by hand where they are not"
        )
    return pose


def rest_pose(skeleton: Skeleton) -> np.ndarray:
    """(J, 4) local rotations of a rig at rest: none."""
    return np.tile(IDENTITY, (skeleton.n_joints, 1))


def standing_rig(skeleton: Skeleton, parts: BodyParts | None = None) -> np.ndarray:
    """(J, 4) local rotations in which a rig stands upright, without a motion to learn from.

    The rest pose where it stands. Else each bone is turned the shortest way to where it lies in a
    T-pose: how far it is then turned about itself is a guess, its direction is not.
    """
    parts = parts or find_parts(skeleton)
    rest = rest_pose(skeleton)
    if _stands(skeleton, parts, rest):
        return rest
    wanted = _t_pose(skeleton, parts)
    places = forward_kinematics(rest, np.zeros(3), skeleton)
    pelvis, chest = skeleton.index(parts.pelvis), skeleton.index(parts.spine[-1])
    scale = body_scale(skeleton)

    def at(name: str) -> np.ndarray:
        return places[skeleton.index(name)]

    turned = rest.copy()
    pose = rest.copy()
    for j, above in enumerate(skeleton.parents):
        own = turned[above] if above >= 0 else IDENTITY
        if j in (pelvis, chest):
            # Two directions are known: up the spine, and across hips or shoulders.
            top = wanted[j][0] if j == chest and j in wanted else chest
            up = places[top] - places[j] if top != j else places[chest] - places[pelvis]
            own = invert_quaternions(frame(up, _across(parts, j == pelvis, at, scale)))
        elif j in wanted:
            below, direction, spare = wanted[j]
            bone = rotate_vectors(own, places[below] - places[j])
            length = np.linalg.norm(bone)
            if length > _NO_LENGTH * scale:
                arc = shortest_arc(bone / length, direction, spare)
                own = multiply_quaternions(arc, own)
        turned[j] = own
        pose[j] = own if above < 0 else multiply_quaternions(invert_quaternions(turned[above]), own)
    return pose


def frame(up: np.ndarray, across: np.ndarray) -> np.ndarray:
    """(..., 4) turns from body axes (left, up, forward) to the world, of a direction up (..., 3)
    and one to the left; neither need be of length 1, and up is exact."""
    y = up / np.linalg.norm(up, axis=-1, keepdims=True)
    x = across - (across * y).sum(axis=-1, keepdims=True) * y
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return quaternion_from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1))


def body_frame(skeleton: Skeleton, parts: BodyParts, pose: np.ndarray) -> np.ndarray:
    """(4,) turn from body axes (left, up, forward) to the world, of a rig that stands in `pose`.

    Up is the world's axis that the body stands along, unless it stands aslant.
    """
    places = forward_kinematics(pose, np.zeros(3), skeleton)
    bones = _bones(skeleton, parts, places)
    up = bones["torso"]
    axis = int(np.abs(up).argmax())
    if abs(up[axis]) > _AXIS_ALIGNED:
        up = np.eye(3)[axis] * np.sign(up[axis])
    return frame(up, bones["hips"])


def _stands(skeleton: Skeleton, parts: BodyParts, pose: np.ndarray) -> bool:
    """Whether legs point down along the torso, and shoulders and hips to the same side."""
    bones = _bones(skeleton, parts, forward_kinematics(pose, np.zeros(3), skeleton))
    up, hips = bones["torso"], bones["hips"]
    legs = [bones[f"{side}_{bone}"] for side in SIDES for bone in ("thigh", "shank")]
    arms = (bones["left_arm"] - bones["right_arm"]) @ hips
    return bool(
        min(-leg @ up for leg in legs) > _UPRIGHT
        and abs(up @ hips) < 0.5
        and bones["shoulders"] @ hips > _UPRIGHT
        and arms > -1.0
    )


def _bones(skeleton: Skeleton, parts: BodyParts, places: np.ndarray) -> dict[str, np.ndarray]:
    """Unit directions (..., 3) by name, of joints at `places` (..., J, 3)."""

    def at(name: str) -> np.ndarray:
        return places[..., skeleton.index(name), :]

    arms, legs = parts.arms, parts.legs
    shoulders = [at(arms[side].shoulder) for side in SIDES]
    hips = [at(legs[side].hip) for side in SIDES]
    found = {
        "torso": sum(shoulders) / 2 - sum(hips) / 2,
        "hips": hips[0] - hips[1],
        "shoulders": shoulders[0] - shoulders[1],
    }
    for side in SIDES:
        found[f"{side}_thigh"] = at(legs[side].knee) - at(legs[side].hip)
        found[f"{side}_shank"] = at(legs[side].ankle) - at(legs[side].knee)
        found[f"{side}_arm"] = at(arms[side].elbow) - at(arms[side].shoulder)
    shortest = _NO_BONE * body_scale(skeleton)
    for name, bone in found.items():
        length = np.linalg.norm(bone, axis=-1, keepdims=True)
        if length.min() < shortest:
            raise MotionError(f"the rig's {name.replace('_', ' ')} has no length")
        found[name] = bone / length
    return found


def _across(
    parts: BodyParts, hips: bool, at: Callable[[str], np.ndarray], scale: float
) -> np.ndarray:
    """(3,) from the right hip to the left, or from the right collar bone or shoulder."""
    left, right = (parts.legs[side] if hips else parts.arms[side] for side in SIDES)
    if hips:
        return at(left.hip) - at(right.hip)
    if left.clavicle and right.clavicle:
        between = at(left.clavicle) - at(right.clavicle)
        if np.linalg.norm(between) > _NO_WAY * scale:
            return between
    return at(left.shoulder) - at(right.shoulder)


def _t_pose(
    skeleton: Skeleton, parts: BodyParts
) -> dict[int, tuple[int, np.ndarray, np.ndarray | None]]:
    """Joint to (joint that its bone leads to, direction in a T-pose, axis to turn about if
    it points the other way)."""
    ways: dict[int, tuple[int, np.ndarray, np.ndarray | None]] = {}

    def lead(names: list[str | None], direction: np.ndarray, spare: np.ndarray) -> None:
        chain = [skeleton.index(name) for name in names if name is not None]
        ways.update({a: (b, direction, spare) for a, b in zip(chain, chain[1:])})

    lead([parts.pelvis, *parts.spine, parts.neck, parts.head], UP, FORWARD)
    for side, outward in zip(SIDES, (LEFT, -LEFT)):
        arm, leg = parts.arms[side], parts.legs[side]
        lead([arm.clavicle, arm.shoulder, arm.elbow, arm.wrist], outward, FORWARD)
        lead([leg.hip, leg.knee, leg.ankle], -UP, LEFT)
        lead([leg.ankle, leg.toe], FORWARD - 0.5 * UP, LEFT)
    return {j: (below, way / np.linalg.norm(way), spare) for j, (below, way, spare) in ways.items()}
