"""A motion on another rig of the same body plan: other names, offsets, rest pose, extra joints.

1. Each segment of the target is turned so that its anatomical frame is the source's
   (`body_frames`): arms, legs and fingers point the same way, hands and heads face the same way,
   whatever the two rest poses are. Spines and necks of different numbers of joints are matched
   along their length.
2. The path of the hips is scaled by the length of the legs, above each rig's own ankles.
3. Hands near the body go where they are on the source, scaled by the span of the arms (`reaching`).
4. Where the target's feet then are not where the scaled source feet are, two-bone IK puts them
   there (`planting`): what is planted stays planted, and stands on the floor.

Joints that the source has no counterpart for rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gesturekit.motion.body_size import body_scale
from gesturekit.motion.kinematics import forward_kinematics, global_rotations
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.motion.retarget.body_frames import BodyFrames, body_frames
from gesturekit.motion.retarget.feet import GIVE_WAY, Feet, FootPlan
from gesturekit.motion.retarget.hands import place_hands
from gesturekit.motion.retarget.standing_pose import standing_pose, standing_rig
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    rotate_vectors,
    slerp,
)
from gesturekit.motion.skeleton import Skeleton

_NO_LENGTH = 1e-6
"""Metres on the reference body; a spine or neck that is shorter has no length."""
_MARKER_ON_THE_FLOOR = 0.25
"""A root that lies farther from the pelvis than this share of the legs does not move with it."""


def retarget(
    motion: Motion,
    skeleton: Skeleton,
    *,
    parts: Mapping[str, str] | None = None,
    target_parts: Mapping[str, str] | None = None,
    feet: bool = True,
    pose: np.ndarray | None = None,
) -> Motion:
    """Put a motion onto another rig.

    Args:
        motion: what to carry over.
        skeleton: the rig to put it on, in its own size.
        parts: parts of the motion's rig named by hand, see `parts.find_parts`.
        target_parts: parts of `skeleton` named by hand.
        feet: keep the feet where the source has them, by inverse kinematics.
        pose: (J, 4) local rotations in which the target stands upright. By default its rest pose,
            which need be neither T nor A. Rigs that do not stand at rest (Bandai-Namco's) turn
            their joints about the bones as they should where a pose is given, see
            `standing.standing_pose`; without one only the places of their joints are right.

    Returns:
        The motion on `skeleton`, at the same frame rate; the floor stays where it is, and the
        first frame where it stands.

    Raises:
        MotionError: parts of either rig that cannot be told, or a source that never stands.
    """
    source_parts = find_parts(motion.skeleton, parts)
    source = body_frames(motion.skeleton, source_parts, standing_pose(motion, source_parts))
    feet_of_source = Feet.of(motion, source)
    source = source.levelled(motion, feet_of_source.standing)
    same = (skeleton.names, skeleton.parents) == (motion.skeleton.names, motion.skeleton.parents)
    if same:
        # One rig means one thing by its axes, whatever a performer's offsets.
        target = replace(source, skeleton=skeleton)
    else:
        found = find_parts(skeleton, target_parts)
        target = body_frames(
            skeleton, found, standing_rig(skeleton, found) if pose is None else np.asarray(pose)
        )
    turned = _turned(motion, source, target, same)
    rotations = _local(turned, skeleton)
    still = np.zeros((motion.n_frames, 3))
    moving = {}
    scale = target.leg_length() / source.leg_length()
    mover = _mover(target)
    if same:
        moving = {
            name: values * scale
            for name, values in motion.joint_translations.items()
            if skeleton.index(name) != mover
        }
    plan = FootPlan(
        target,
        scale,
        feet_of_source,
        feet_of_source.heights(source, target, same, scale),
        round(GIVE_WAY * motion.fps),
    )
    at_origin = forward_kinematics(rotations, still, skeleton, moving)
    rotations = place_hands(
        source,
        target,
        motion.positions(),
        motion.global_rotations(),
        at_origin,
        rotations,
    )
    hips = plan.hips(turned)
    if feet:
        hips = hips - plan.give_way(turned, at_origin, hips)
        rotations = plan.plant(rotations, turned, at_origin, hips)
        at_origin = forward_kinematics(rotations, still, skeleton, moving)
    shift = hips - plan.between_hips(at_origin)
    made = _placed(motion, skeleton, rotations, moving, mover, at_origin[:, mover] + shift)
    return replace(made, expressions=motion.expressions) if same else made


# Turning


def _turned(motion: Motion, source: BodyFrames, target: BodyFrames, same: bool) -> np.ndarray:
    """(T, J, 4) world rotations of the target's joints."""
    skeleton = target.skeleton
    frames = _for_target(
        source, target, source.world(motion.global_rotations(), motion.positions())
    )
    # Fingers that the source does not have rest on their hands, as all other extra joints do.
    segment_of = {joint: segment for segment, joint in target.joints.items() if segment in frames}
    rests = motion.rotations if same else np.tile(target.pose, (motion.n_frames, 1, 1))
    pelvis, mover = target.joints["pelvis"], _mover(target)
    turned = np.empty((motion.n_frames, skeleton.n_joints, 4))
    for j, above in enumerate(skeleton.parents):
        if j in segment_of:
            back = invert_quaternions(target.own[segment_of[j]])
            turned[:, j] = multiply_quaternions(frames[segment_of[j]], back)
        elif j == mover and not same:
            # The pelvis rests on it: what turns the pelvis turns the mover.
            own = multiply_quaternions(frames["pelvis"], invert_quaternions(target.own["pelvis"]))
            for between in (pelvis, *skeleton.ancestors(pelvis)):
                if between == mover:
                    break
                own = multiply_quaternions(own, invert_quaternions(target.pose[between]))
            turned[:, j] = own
        elif above < 0:
            turned[:, j] = rests[:, j]
        else:
            turned[:, j] = multiply_quaternions(turned[:, above], rests[:, j])
    return turned


def _for_target(
    source: BodyFrames, target: BodyFrames, frames: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Anatomical frames of the target's segments: those of the source, or what stands in."""
    found = {}
    spine = source.chain("spine")
    for segment in target.joints:
        kind = segment.rstrip("0123456789")
        if kind == "spine":
            found[segment] = _along(source, spine, target, segment, frames)
        elif kind == "neck":
            neck = source.chain("neck")
            found[segment] = (
                _along(source, neck, target, segment, frames)
                if neck
                else slerp(frames[spine[-1]], frames.get("head", frames[spine[-1]]), np.array(0.5))
            )
        elif segment in frames:
            found[segment] = frames[segment]
        elif kind == "head":
            found[segment] = frames[(source.chain("neck") or spine)[-1]]
        elif kind.endswith("clavicle"):
            found[segment] = frames[spine[-1]]
        elif kind.endswith("wrist"):
            found[segment] = frames[kind.replace("wrist", "elbow")]
        elif kind.endswith("toe"):
            found[segment] = frames[kind.replace("toe", "ankle")]
    return found


def _along(
    source: BodyFrames,
    chain: list[str],
    target: BodyFrames,
    segment: str,
    frames: dict[str, np.ndarray],
) -> np.ndarray:
    """Frames of a spine or neck at the height of one of the target's joints."""
    own = target.chain(segment.rstrip("0123456789"))
    place = _heights(target, own)[own.index(segment)]
    places = _heights(source, chain)
    high = int(np.clip(np.searchsorted(places, place - 1e-9), 1, max(len(places) - 1, 1)))
    if len(places) == 1 or place <= places[0]:
        return frames[chain[0]]
    weight = (place - places[high - 1]) / max(places[high] - places[high - 1], 1e-9)
    return slerp(frames[chain[high - 1]], frames[chain[high]], np.clip(weight, 0, 1))


def _heights(frames: BodyFrames, chain: list[str]) -> np.ndarray:
    """Middles of the bones of a chain, as shares of the way to the middle of the last one."""
    skeleton = frames.skeleton
    places = forward_kinematics(frames.pose, np.zeros(3), skeleton)
    joints = [frames.joints[segment] for segment in chain]
    end = {"spine": ("neck0", "head"), "neck": ("head",)}[chain[0].rstrip("0123456789")]
    top = next((frames.joints[segment] for segment in end if segment in frames.joints), joints[-1])
    way = places[[*joints, top]]
    lengths = np.linalg.norm(np.diff(way, axis=0), axis=-1)
    middles = np.cumsum(lengths) - lengths / 2
    if middles[-1] < _NO_LENGTH * body_scale(skeleton):
        return np.linspace(0, 1, len(chain) + 1)[1:]
    return middles / middles[-1]


def _local(turned: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    local = turned.copy()
    for j, above in enumerate(skeleton.parents):
        if above >= 0:
            back = invert_quaternions(turned[:, above])
            local[:, j] = multiply_quaternions(back, turned[:, j])
    return local


def _mover(target: BodyFrames) -> int:
    """The joint that carries the body about: the root, unless that is a marker on the floor."""
    pelvis = target.joints["pelvis"]
    places = forward_kinematics(target.pose, np.zeros(3), target.skeleton)
    far = np.linalg.norm(places[pelvis] - places[0])
    return pelvis if far > _MARKER_ON_THE_FLOOR * target.leg_length() else 0


def _placed(
    motion: Motion,
    skeleton: Skeleton,
    rotations: np.ndarray,
    moving: dict[str, np.ndarray],
    mover: int,
    place: np.ndarray,
) -> Motion:
    """The motion whose joint `mover` is at `place` (T, 3); what is above it stands still."""
    translation = place
    if mover:
        translation = np.zeros_like(place)
        above = skeleton.parents[mover]
        positions = forward_kinematics(rotations, translation, skeleton, moving)[:, above]
        turned = global_rotations(rotations, skeleton)[:, above]
        moving = dict(moving)
        moving[skeleton.names[mover]] = rotate_vectors(
            invert_quaternions(turned), place - positions
        )
    return Motion(
        skeleton=skeleton,
        rotations=rotations,
        translation=translation,
        fps=motion.fps,
        joint_translations=moving,
        info={k: motion.info[k] for k in ("source",) if k in motion.info},
    )
