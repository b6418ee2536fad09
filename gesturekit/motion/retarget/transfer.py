"""Retargeting: transfer a motion to a rig with other names, offsets, rest pose or extra joints.

1. Each segment of the target gets the anatomical frame of the source (`body_frames`): arms, legs
   and fingers point in the same direction, hands and heads have the same orientation, whatever the
   two rest poses are. Spines and necks with different numbers of joints are matched along their
   length.
2. The path of the hips is scaled by leg length, measured above each rig's own ankles.
3. Hands near the body are placed where they are on the source, scaled by arm span (`hands`).
4. If the target's feet are then not at the scaled source positions, two-bone IK places them there
   (`feet`): planted feet stay planted, on the floor.

Joints without a counterpart in the source keep their rest rotation. Where one of the rigs has no
legs, the pelvis moves as the source's, and legs of the target stand straight below it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.kinematics import forward_kinematics, global_rotations
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.retarget.body_frames import BodyFrames, body_frames
from gesturekit.motion.retarget.feet import HIP_DROP_SECONDS, FootMotion, FootTargets
from gesturekit.motion.retarget.hands import place_hands
from gesturekit.motion.retarget.standing_pose import FORWARD, standing_pose, standing_rig
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    rotate_vectors,
    slerp,
)
from gesturekit.motion.skeleton import Skeleton

_NO_LENGTH = 1e-6
"""Metres on the reference body; a shorter spine or neck has no length."""
_FLOOR_MARKER = 0.25
"""Share of the leg length; a root farther from the pelvis is a marker on the floor."""


def retarget(
    motion: Motion,
    skeleton: Skeleton,
    *,
    parts: Mapping[str, str] | None = None,
    target_parts: Mapping[str, str] | None = None,
    feet: bool = True,
    pose: np.ndarray | None = None,
) -> Motion:
    """Transfer a motion to another rig.

    Args:
        motion: T frames on the source rig.
        skeleton: the target rig, J joints, in its own size.
        parts: parts of the source rig specified by hand, see `parts.find_parts`.
        target_parts: parts of `skeleton` specified by hand.
        feet: keep the source's foot positions by inverse kinematics.
        pose: (J, 4) local rotations in which the target stands upright. By default its rest pose,
            which need not be a T- or A-pose. Some rigs do not stand at rest (Bandai-Namco's); for
            these a pose also gives the twist of each bone, see `standing_pose.standing_pose`.
            Without one only the joint positions are right.

    Returns:
        The motion on `skeleton`. The floor keeps its height, the first frame its place on it.

    Raises:
        MotionError: parts of either rig that cannot be identified, a source that never stands, or a
            target that is no skeleton. Legs are not needed.
    """
    _check_target(skeleton)
    source_parts = find_parts(motion.skeleton, parts)
    source = body_frames(motion.skeleton, source_parts, standing_pose(motion, source_parts))
    source_feet = FootMotion.measure(motion, source) if source_parts.legs else None
    if source_feet is not None:
        source = source.levelled(motion, source_feet.standing)
    same = (skeleton.names, skeleton.parents) == (motion.skeleton.names, motion.skeleton.parents)
    if same:
        # Joint axes mean the same on one rig, whatever the offsets of a performer.
        target = replace(source, skeleton=skeleton)
    else:
        found = find_parts(skeleton, target_parts)
        stands = standing_rig(skeleton, found) if pose is None else np.asarray(pose)
        target = body_frames(skeleton, found, stands)
    scale = target.leg_length() / source.leg_length()
    carrier = _carrier(target)
    moving = {
        name: values * scale
        for name, values in motion.joint_translations.items()
        if same and skeleton.index(name) != carrier
    }
    world = _world_rotations(motion, source, target, same)
    if source_feet is None or not target.parts.legs:
        rotations, root = _without_feet(motion, source, target, world, moving, carrier, source_feet)
    else:
        heights = source_feet.heights(source, target, same, scale)
        drop_frames = round(HIP_DROP_SECONDS * motion.fps)
        targets = FootTargets(target, scale, source_feet, heights, drop_frames)
        rotations, root = _solved(motion, source, targets, world, moving, carrier, feet)
    made = _placed(motion, skeleton, rotations, moving, carrier, root)
    return replace(made, expressions=motion.expressions) if same else made


def _check_target(skeleton: Any) -> None:
    """Raise MotionError for a target that is no skeleton, such as a motion on it."""
    if not isinstance(skeleton, Skeleton):
        kind = type(skeleton).__name__
        hint = "; give its skeleton" if isinstance(skeleton, Motion) else ""
        raise MotionError(f"skeleton is a {kind}, and must be a Skeleton{hint}")


def _solved(
    motion: Motion,
    source: BodyFrames,
    targets: FootTargets,
    world: np.ndarray,
    moving: dict[str, np.ndarray],
    carrier: int,
    feet: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve arms and, if `feet`, legs; return local rotations (T, J, 4) and carrier places (T, 3).

    `world` (T, J, 4) and `moving` {joint: (T, 3)} are world rotations and joint translations of the
    target; `carrier` is the joint that carries its body.
    """
    target = targets.target
    skeleton = target.skeleton
    rotations = _local_rotations(world, skeleton)
    origin = np.zeros((motion.n_frames, 3))
    positions = forward_kinematics(rotations, origin, skeleton, moving)
    source_world = motion.global_rotations()
    rotations = place_hands(source, target, motion.positions(), source_world, positions, rotations)
    hips = targets.hips(world)
    if feet:
        hips = hips - targets.hip_drop(world, positions, hips)
        rotations = targets.solve_legs(rotations, world, positions, hips)
        positions = forward_kinematics(rotations, origin, skeleton, moving)
    return rotations, positions[:, carrier] + (hips - targets.hip_centre(positions))


def _without_feet(
    motion: Motion,
    source: BodyFrames,
    target: BodyFrames,
    world: np.ndarray,
    moving: dict[str, np.ndarray],
    carrier: int,
    source_feet: FootMotion | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the arms where one of the rigs has no legs; see `_solved`.

    The path of the pelvis is scaled about the floor under its first frame, which is at 0 without
    feet (`source_feet`). The height of a source without legs says nothing about standing, so that a
    target with legs stands on the floor.
    """
    skeleton, scale = target.skeleton, target.leg_length() / source.leg_length()
    rotations = _local_rotations(world, skeleton)
    origin = np.zeros((motion.n_frames, 3))
    positions = forward_kinematics(rotations, origin, skeleton, moving)
    own = motion.positions()
    rotations = place_hands(source, target, own, motion.global_rotations(), positions, rotations)
    pelvis = own[:, source.joints["pelvis"]]
    floor = 0.0 if source_feet is None else source_feet.floor
    base = np.array([pelvis[0, 0], floor, pelvis[0, 2]])
    path = (pelvis - base) * scale + base
    body = positions[:, target.joints["pelvis"]]
    if target.parts.legs:
        names = [joint for leg in target.parts.legs.values() for joint in (leg.ankle, leg.toe)]
        feet = [skeleton.index(name) for name in names if name is not None]
        stands = np.median(body[:, 1] - positions[:, feet, 1].min(axis=1))
        path[:, 1] += stands - np.median(path[:, 1])
    return rotations, positions[:, carrier] + (path - body)


def _world_rotations(
    motion: Motion, source: BodyFrames, target: BodyFrames, same: bool
) -> np.ndarray:
    """(T, J, 4) world rotations of the target's joints."""
    skeleton = target.skeleton
    frames = _segment_frames(
        source, target, source.world(motion.global_rotations(), motion.positions())
    )
    # Joints without a segment in the source, fingers included, keep their rest rotation.
    segment_of = {joint: segment for segment, joint in target.joints.items() if segment in frames}
    rests = motion.rotations if same else np.tile(target.pose, (motion.n_frames, 1, 1))
    pelvis, carrier = target.joints["pelvis"], _carrier(target)
    world = np.empty((motion.n_frames, skeleton.n_joints, 4))
    for j, parent in enumerate(skeleton.parents):
        if j in segment_of:
            back = invert_quaternions(target.from_anatomical[segment_of[j]])
            world[:, j] = multiply_quaternions(frames[segment_of[j]], back)
        elif j == carrier and not same:
            # The carrier turns with the pelvis; the joints between them keep the standing pose.
            back = invert_quaternions(target.from_anatomical["pelvis"])
            own = multiply_quaternions(frames["pelvis"], back)
            for between in (pelvis, *skeleton.ancestors(pelvis)):
                if between == carrier:
                    break
                own = multiply_quaternions(own, invert_quaternions(target.pose[between]))
            world[:, j] = own
        elif parent < 0:
            world[:, j] = rests[:, j]
        else:
            world[:, j] = multiply_quaternions(world[:, parent], rests[:, j])
    return world


def _segment_frames(
    source: BodyFrames, target: BodyFrames, frames: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return segment to (T, 4) anatomical frame of the target, from `frames` of the source.

    A segment that the source does not have gets the frame of a neighbour.
    """
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
        elif not source.parts.legs and kind.endswith(("hip", "knee", "ankle", "toe")):
            found[segment] = _heading(frames["pelvis"])
        elif kind.endswith("toe"):
            found[segment] = frames[kind.replace("toe", "ankle")]
    return found


def _heading(turns: np.ndarray) -> np.ndarray:
    """(T, 4) rotations about the vertical that face where anatomical frames (T, 4) face."""
    ahead = rotate_vectors(turns, np.broadcast_to(FORWARD, (len(turns), 3)))
    half = np.arctan2(ahead[:, 0], ahead[:, 2]) / 2
    return np.stack([0 * half, np.sin(half), 0 * half, np.cos(half)], axis=-1)


def _along(
    source: BodyFrames,
    chain: list[str],
    target: BodyFrames,
    segment: str,
    frames: dict[str, np.ndarray],
) -> np.ndarray:
    """(T, 4) frame of the source's spine or neck at the height of one of the target's joints.

    `chain` are the source's segments of the spine or neck from below, `segment` the target's, and
    `frames` {segment: (T, 4)} the source's anatomical frames.
    """
    own = target.chain(segment.rstrip("0123456789"))
    place = _heights(target, own)[own.index(segment)]
    places = _heights(source, chain)
    high = int(np.clip(np.searchsorted(places, place - 1e-9), 1, max(len(places) - 1, 1)))
    if len(places) == 1 or place <= places[0]:
        return frames[chain[0]]
    weight = (place - places[high - 1]) / max(places[high] - places[high - 1], 1e-9)
    return slerp(frames[chain[high - 1]], frames[chain[high]], np.clip(weight, 0, 1))


def _heights(frames: BodyFrames, chain: list[str]) -> np.ndarray:
    """(N,) middles of the bones of a chain, as shares of the distance to the last one."""
    skeleton = frames.skeleton
    places = forward_kinematics(frames.pose, np.zeros(3), skeleton)
    joints = [frames.joints[segment] for segment in chain]
    end = {"spine": ("neck0", "head"), "neck": ("head",)}[chain[0].rstrip("0123456789")]
    top = next((frames.joints[segment] for segment in end if segment in frames.joints), joints[-1])
    lengths = np.linalg.norm(np.diff(places[[*joints, top]], axis=0), axis=-1)
    middles = np.cumsum(lengths) - lengths / 2
    if middles[-1] < _NO_LENGTH * body_scale(skeleton):
        return np.linspace(0, 1, len(chain) + 1)[1:]
    return middles / middles[-1]


def _local_rotations(world: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """(T, J, 4) local rotations from world rotations of the same shape."""
    local = world.copy()
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            local[:, j] = multiply_quaternions(invert_quaternions(world[:, parent]), world[:, j])
    return local


def _carrier(target: BodyFrames) -> int:
    """Return the joint that carries the body: the root, or the pelvis if the root is a marker."""
    pelvis = target.joints["pelvis"]
    places = forward_kinematics(target.pose, np.zeros(3), target.skeleton)
    far = np.linalg.norm(places[pelvis] - places[0])
    return pelvis if far > _FLOOR_MARKER * target.leg_length() else 0


def _placed(
    motion: Motion,
    skeleton: Skeleton,
    rotations: np.ndarray,
    moving: dict[str, np.ndarray],
    carrier: int,
    position: np.ndarray,
) -> Motion:
    """Return the motion with joint `carrier` at `position` (T, 3); joints above it stand still."""
    translation = position
    if carrier:
        translation = np.zeros_like(position)
        parent = skeleton.parents[carrier]
        positions = forward_kinematics(rotations, translation, skeleton, moving)[:, parent]
        world = global_rotations(rotations, skeleton)[:, parent]
        moving = dict(moving)
        moving[skeleton.names[carrier]] = rotate_vectors(
            invert_quaternions(world), position - positions
        )
    return Motion(
        skeleton=skeleton,
        rotations=rotations,
        translation=translation,
        fps=motion.fps,
        joint_translations=moving,
        info={k: motion.info[k] for k in ("source",) if k in motion.info},
    )
