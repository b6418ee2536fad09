"""Standing pose of a rig: its rest pose, a frame of a motion, or a constructed T-pose.

A known pose shows how a rig's joint axes relate to the body. Most rigs stand at rest, with their
arms anywhere. The rest pose of others (Bandai-Namco's, and all whose bones lie along their own
axes) does not look like a body: they need a frame in which the body stands.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES, BodyParts, find_parts
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import (
    IDENTITY,
    invert_quaternions,
    multiply_quaternions,
    quaternion_from_matrix,
    rotate_vectors,
    shortest_arc,
)
from gesturekit.motion.skeleton import Skeleton, forward_kinematics

LEFT, UP, FORWARD = np.eye(3)
"""(3,) axes of a body that stands and faces +Z."""

_NO_LENGTH, _NO_BONE, _NO_DISTANCE = 1e-6, 1e-4, 1e-3
"""Metres on the reference body; shorter bones of a limb, bones of the trunk, and distances between
clavicles have no direction."""
_UPRIGHT = np.cos(np.deg2rad(45.0))
"""Cosine of the largest angle of a standing body between legs and torso, or shoulders and hips."""
_AXIS_ALIGNED = np.cos(np.deg2rad(20.0))
"""Cosine of the largest angle between a torso and the world axis that it stands along."""


def standing_pose(motion: Motion) -> np.ndarray:
    """(J, 4) local rotations in which the body of a motion stands upright.

    The rest pose if it stands, otherwise the most upright frame with lowered arms.

    Raises:
        MotionError: it stands neither at rest nor in any frame.
    """
    skeleton, parts = motion.skeleton, find_parts(motion.skeleton)
    rest = rest_pose(skeleton)
    if _stands(skeleton, rest):
        return rest
    bones = _bones(skeleton, motion.positions())
    score = bones["torso"][..., 1] - sum(
        bones[f"{side}_{bone}"][..., 1] * weight
        for side in SIDES
        for bone, weight in (("thigh", 1.0), ("shank", 1.0), ("arm", 0.25))
        if f"{side}_{bone}" in bones
    )
    pose = motion.rotations[int(score.argmax())]
    if not _stands(skeleton, pose):
        knee = f"left knee {parts.legs['left'].knee!r}, " if parts.legs else ""
        taken = f"pelvis {parts.pelvis!r}, {knee}left elbow {parts.arms['left'].elbow!r}"
        problem = "the body stands upright neither at rest nor in any frame"
        raise MotionError(f"{problem}; are its parts right ({taken})? Else name them by hand")
    return pose


def rest_pose(skeleton: Skeleton) -> np.ndarray:
    """(J, 4) identity rotations."""
    return np.tile(IDENTITY, (skeleton.n_joints, 1))


def standing_rig(skeleton: Skeleton) -> np.ndarray:
    """(J, 4) local rotations in which a rig stands upright, found without a motion.

    The rest pose if it stands. Otherwise each bone is rotated the shortest way to its direction in
    a T-pose. The directions are then right, but the twist of each bone is a guess.
    """
    parts, rest = find_parts(skeleton), rest_pose(skeleton)
    if _stands(skeleton, rest):
        return rest
    wanted = _t_pose(skeleton, parts)
    places = forward_kinematics(rest, np.zeros(3), skeleton)
    pelvis, chest = skeleton.index(parts.pelvis), skeleton.index(parts.spine[-1])
    scale = body_scale(skeleton)

    def at(name: str) -> np.ndarray:
        return places[skeleton.index(name)]

    world = rest.copy()
    pose = rest.copy()
    for j, parent in enumerate(skeleton.parents):
        turn = world[parent] if parent >= 0 else IDENTITY
        if j in (pelvis, chest):
            # Two directions are known: along the spine, and across hips or shoulders.
            top = wanted[j][0] if j == chest and j in wanted else chest
            up = places[top] - places[j] if top != j else places[chest] - places[pelvis]
            turn = invert_quaternions(frame(up, _across(parts, j == pelvis, at, scale)))
        elif j in wanted:
            below, direction, spare = wanted[j]
            bone = rotate_vectors(turn, places[below] - places[j])
            length = np.linalg.norm(bone)
            if length > _NO_LENGTH * scale:
                arc = shortest_arc(bone / length, direction, spare)
                turn = multiply_quaternions(arc, turn)
        world[j] = turn
        pose[j] = (
            turn if parent < 0 else multiply_quaternions(invert_quaternions(world[parent]), turn)
        )
    return pose


def frame(up: np.ndarray, across: np.ndarray) -> np.ndarray:
    """(..., 4) rotations from body axes (left, up, forward) to the world.

    Args:
        up: (..., 3) upward direction of any length; the result is exact for it.
        across: (..., 3) direction to the left, of any length.
    """
    y = up / np.linalg.norm(up, axis=-1, keepdims=True)
    x = across - (across * y).sum(axis=-1, keepdims=True) * y
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return quaternion_from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1))


def body_frame(skeleton: Skeleton, pose: np.ndarray) -> np.ndarray:
    """(4,) rotation from body axes (left, up, forward) to the world, for a rig standing in `pose`.

    Up is the world axis nearest to the torso, or the torso itself if none is near.
    """
    bones = _bones(skeleton, forward_kinematics(pose, np.zeros(3), skeleton))
    up = bones["torso"]
    axis = int(np.abs(up).argmax())
    if abs(up[axis]) > _AXIS_ALIGNED:
        up = np.eye(3)[axis] * np.sign(up[axis])
    return frame(up, bones["hips"])


def _stands(skeleton: Skeleton, pose: np.ndarray) -> bool:
    """Return whether legs point down along the torso, and shoulders to the same side as hips.

    The head of a body without legs points up along the torso.
    """
    bones = _bones(skeleton, forward_kinematics(pose, np.zeros(3), skeleton))
    up, hips = bones["torso"], bones["hips"]
    upward = [-bone for name, bone in bones.items() if name.endswith(("thigh", "shank"))]
    upward += [bones["head"]] if "head" in bones else []
    arms = (bones["left_arm"] - bones["right_arm"]) @ hips
    return bool(
        min((bone @ up for bone in upward), default=1.0) > _UPRIGHT
        and abs(up @ hips) < 0.5
        and bones["shoulders"] @ hips > _UPRIGHT
        and arms > -1.0
    )


def _bones(skeleton: Skeleton, places: np.ndarray) -> dict[str, np.ndarray]:
    """Return bone name to unit direction (..., 3), from joint positions (..., J, 3).

    The shoulders stand in for the hips of a body without legs.
    """

    def at(name: str) -> np.ndarray:
        return places[..., skeleton.index(name), :]

    parts = find_parts(skeleton)
    arms, legs = parts.arms, parts.legs
    shoulders = [at(arms[side].shoulder) for side in SIDES]
    across = shoulders[0] - shoulders[1]
    if legs:
        hips = [at(legs[side].hip) for side in SIDES]
        torso, between_hips = sum(shoulders) / 2 - sum(hips) / 2, hips[0] - hips[1]
    else:
        torso, between_hips = sum(shoulders) / 2 - at(parts.pelvis), across
    bones = {"torso": torso, "hips": between_hips, "shoulders": across}
    if not legs and parts.head is not None:
        bones["head"] = at(parts.head) - sum(shoulders) / 2
    for side in SIDES:
        if legs:
            bones[f"{side}_thigh"] = at(legs[side].knee) - at(legs[side].hip)
            bones[f"{side}_shank"] = at(legs[side].ankle) - at(legs[side].knee)
        bones[f"{side}_arm"] = at(arms[side].elbow) - at(arms[side].shoulder)
    shortest = _NO_BONE * body_scale(skeleton)
    for name, bone in bones.items():
        length = np.linalg.norm(bone, axis=-1, keepdims=True)
        if length.min() < shortest:
            raise MotionError(f"the rig's {name.replace('_', ' ')} has no length")
        bones[name] = bone / length
    return bones


def _across(
    parts: BodyParts, hips: bool, at: Callable[[str], np.ndarray], scale: float
) -> np.ndarray:
    """(3,) vector from right to left hip, or from right to left clavicle or shoulder, metres.

    A body without legs has the latter for both.
    """
    if hips and parts.legs:
        return at(parts.legs["left"].hip) - at(parts.legs["right"].hip)
    left, right = (parts.arms[side] for side in SIDES)
    if left.clavicle and right.clavicle:
        between = at(left.clavicle) - at(right.clavicle)
        if np.linalg.norm(between) > _NO_DISTANCE * scale:
            return between
    return at(left.shoulder) - at(right.shoulder)


def _t_pose(
    skeleton: Skeleton, parts: BodyParts
) -> dict[int, tuple[int, np.ndarray, np.ndarray | None]]:
    """Return joint to (joint at the end of its bone, direction (3,) in a T-pose, axis (3,)).

    A bone that points in the opposite direction is rotated about the axis.
    """
    bones: dict[int, tuple[int, np.ndarray, np.ndarray | None]] = {}

    def add(names: list[str | None], direction: np.ndarray, axis: np.ndarray) -> None:
        chain = [skeleton.index(name) for name in names if name is not None]
        unit = direction / np.linalg.norm(direction)
        bones.update({a: (b, unit, axis) for a, b in zip(chain, chain[1:])})

    add([parts.pelvis, *parts.spine, parts.neck, parts.head], UP, FORWARD)
    for side, outward in zip(SIDES, (LEFT, -LEFT)):
        arm = parts.arms[side]
        add([arm.clavicle, arm.shoulder, arm.elbow, arm.wrist], outward, FORWARD)
    for leg in parts.legs.values():
        add([leg.hip, leg.knee, leg.ankle], -UP, LEFT)
        add([leg.ankle, leg.toe], FORWARD - 0.5 * UP, LEFT)
    return bones
