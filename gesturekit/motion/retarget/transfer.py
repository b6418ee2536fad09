"""Retargeting: transfer a motion to a rig with other names, offsets, rest pose or extra joints.

1. Each segment of the target gets the anatomical frame of the source (`body_frames`): arms, legs
   and fingers point in the same direction, hands and heads have the same orientation, whatever the
   two rest poses are. Spines and necks with different numbers of joints are matched along their
   length.
2. The path of the hips is scaled by leg length, measured above each rig's own ankles.
3. Hands near the body are placed where they are on the source, scaled by arm span (`place_hands`).
4. If the target's feet are then not at the scaled source positions, two-bone IK places them there
   (`FootTargets`): planted feet stay planted, on the floor.

Joints without a counterpart in the source keep their rest rotation. Where one of the rigs has no
legs, the pelvis moves as the source's, and legs of the target stand straight below it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.ik import HIP_DROP_SECONDS
from gesturekit.motion.motion import Motion
from gesturekit.motion.retarget.body_frames import BodyFrames, body_frames
from gesturekit.motion.retarget.standing_pose import standing_pose, standing_rig
from gesturekit.motion.retarget.targets import (
    FootMotion,
    FootTargets,
    heading_of,
    place_hands,
)
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    rotate_vectors,
    slerp,
)
from gesturekit.motion.skeleton import Skeleton, forward_kinematics, global_rotations

_FLOOR_MARKER = 0.25
"""Share of the leg length; a root farther from the pelvis is a marker on the floor."""


def retarget(
    motion: Motion,
    skeleton: Skeleton,
    *,
    feet: bool = True,
    pose: np.ndarray | None = None,
) -> Motion:
    """Transfer a motion to another rig.

    Args:
        motion: T frames on the source rig.
        skeleton: the target rig, J joints, in its own size.
        feet: keep the source's foot positions by inverse kinematics.
        pose: (J, 4) local rotations in which the target stands upright. By default its rest pose,
            which need not be a T- or A-pose. Some rigs do not stand at rest (Bandai-Namco's); for
            these a pose also gives the twist of each bone, see `standing_pose`.
            Without one only the joint positions are right.

    Returns:
        The motion on `skeleton`. The floor keeps its height, the first frame its place on it.

    Raises:
        MotionError: parts of either rig that cannot be identified, a source that never stands, or a
            target that is no skeleton. Legs are not needed.
    """
    return Transfer(skeleton, feet=feet, pose=pose)(motion)


class Transfer:
    """Retargeting of motions of one rig, such as the parts of a stream.

    What is measured on a whole clip (level feet, floor, lean) is measured on the first motion, and
    holds for all later ones. Arguments as for `retarget`.
    """

    def __init__(
        self, skeleton: Skeleton, *, feet: bool = True, pose: np.ndarray | None = None
    ) -> None:
        if not isinstance(skeleton, Skeleton):
            hint = "; give its skeleton" if isinstance(skeleton, Motion) else ""
            kind = type(skeleton).__name__
            raise MotionError(f"skeleton is a {kind}, and must be a Skeleton{hint}")
        self._skeleton, self._feet, self._pose = skeleton, feet, pose
        self._source: BodyFrames | None = None
        self._targets: FootTargets
        self._path: tuple[np.ndarray, float] | None = None

    def __call__(self, motion: Motion) -> Motion:
        """Return the motion on the target rig; errors as for `retarget`."""
        skeleton, rig = self._skeleton, motion.skeleton
        same = (skeleton.names, skeleton.parents) == (rig.names, rig.parents)
        source = self._source or body_frames(rig, standing_pose(motion))
        places, turns = motion.positions(), motion.global_rotations()
        feet = FootMotion.measure(motion, source, places, turns) if source.parts.legs else None
        if self._source is None:
            source = self._fit(motion, source, feet, same)
        target, carrier = self._target, self._carrier
        moving = {
            name: values * self._scale
            for name, values in motion.joint_translations.items()
            if same and skeleton.index(name) != carrier
        }
        frames = _segment_frames(source, target, source.world(turns, places))
        world = _world_rotations(motion, frames, target, carrier, same)
        rotations = world.copy()
        above = invert_quaternions(world[:, list(skeleton.parents[1:])])
        rotations[:, 1:] = multiply_quaternions(above, world[:, 1:])
        positions = forward_kinematics(rotations, np.zeros((len(world), 3)), skeleton, moving)
        rotations = place_hands(source, target, places, turns, positions, rotations)
        # Neither arms nor legs move the hips, or what is above them.
        if feet is None or not target.parts.legs:
            shift = self._pelvis_shift(places[:, source.joints["pelvis"]], positions, feet)
        else:
            rotations, shift = self._on_feet(rotations, world, positions, feet)
        carried = positions[:, carrier] + shift
        made = _placed(motion, skeleton, rotations, moving, carrier, carried)
        return replace(made, face=motion.face)

    def _fit(
        self, motion: Motion, source: BodyFrames, feet: FootMotion | None, same: bool
    ) -> BodyFrames:
        """Measure the first motion, and return the frames of its rig with level feet."""
        if feet is not None:
            source = source.levelled(motion, feet.standing)
        if same:
            # Joint axes mean the same on one rig, whatever the offsets of a performer.
            target = replace(source, skeleton=self._skeleton)
        else:
            pose = standing_rig(self._skeleton) if self._pose is None else np.asarray(self._pose)
            target = body_frames(self._skeleton, pose)
        self._source, self._target, self._carrier = source, target, _carrier(target)
        self._scale = target.leg_length() / source.leg_length()
        if feet is not None and target.parts.legs:
            heights = feet.heights(source, target, same, self._scale)
            drop_frames = round(HIP_DROP_SECONDS * motion.fps)
            base = np.array([feet.hips[0, 0], feet.floor, feet.hips[0, 2]])
            self._targets = FootTargets(target, self._scale, feet, heights, drop_frames, base)
        return source

    def _on_feet(
        self, rotations: np.ndarray, world: np.ndarray, positions: np.ndarray, feet: FootMotion
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return local rotations (T, J, 4) with solved legs, and the movement (T, 3) of the hips.

        `world` and `positions` are those of the target's joints, its root at the origin.
        """
        if self._targets.shift is None:
            self._targets = replace(self._targets, shift=self._targets.mean_shift(world))
        targets = replace(self._targets, source=feet)
        hips = targets.hips(world)
        if self._feet:
            hips = hips - targets.hip_drop(world, positions, hips)
            rotations = targets.solve_legs(rotations, world, positions, hips)
        return rotations, hips - targets.hip_centre(positions)

    def _pelvis_shift(
        self, pelvis: np.ndarray, positions: np.ndarray, feet: FootMotion | None
    ) -> np.ndarray:
        """(T, 3) movement of the pelvis where one of the rigs has no legs.

        The path of the source's `pelvis` (T, 3) is scaled about the floor under its first frame,
        which is at 0 without feet. The height of a source without legs says nothing about
        standing, so that a target with legs stands on the floor.
        """
        legs = self._target.parts.legs.values()
        body = positions[:, self._target.joints["pelvis"]]
        if self._path is None:
            floor = 0.0 if feet is None else feet.floor
            base, lift = np.array([pelvis[0, 0], floor, pelvis[0, 2]]), 0.0
            if legs:
                names = [joint for leg in legs for joint in (leg.ankle, leg.toe)]
                ends = [self._skeleton.index(name) for name in names if name is not None]
                stands = np.median(body[:, 1] - positions[:, ends, 1].min(axis=1))
                lift = stands - np.median((pelvis - base)[:, 1] * self._scale + base[1])
            self._path = base, lift
        base, lift = self._path
        path = (pelvis - base) * self._scale + base + [0.0, lift, 0.0]
        return path - body


def _world_rotations(
    motion: Motion, frames: dict[str, np.ndarray], target: BodyFrames, carrier: int, same: bool
) -> np.ndarray:
    """(T, J, 4) world rotations of the target's joints, from anatomical frames of its segments."""
    skeleton = target.skeleton
    # Joints without a segment in the source, fingers included, keep their rest rotation.
    segment_of = {joint: segment for segment, joint in target.joints.items() if segment in frames}
    rests = motion.rotations if same else np.tile(target.pose, (motion.n_frames, 1, 1))
    pelvis = target.joints["pelvis"]
    world = np.empty((motion.n_frames, skeleton.n_joints, 4))
    anatomical = [target.from_anatomical[each] for each in segment_of.values()]
    back = invert_quaternions(np.stack(anatomical))
    segments = np.stack([frames[segment] for segment in segment_of.values()], axis=1)
    world[:, list(segment_of)] = multiply_quaternions(segments, back)
    for j, parent in enumerate(skeleton.parents):
        if j in segment_of:
            continue
        if j == carrier and not same:
            # The carrier turns with the pelvis; the joints between them keep the standing pose.
            back = invert_quaternions(target.from_anatomical["pelvis"])
            turn = multiply_quaternions(frames["pelvis"], back)
            for between in (pelvis, *skeleton.ancestors(pelvis)):
                if between == carrier:
                    break
                turn = multiply_quaternions(turn, invert_quaternions(target.pose[between]))
            world[:, j] = turn
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
    targets = {}
    spine, neck = source.chain("spine"), source.chain("neck")
    chest = frames[spine[-1]]
    for segment in target.joints:
        kind = segment.rstrip("0123456789")
        if kind == "spine" or (kind == "neck" and neck):
            chain = spine if kind == "spine" else neck
            targets[segment] = _along(source, chain, target, segment, frames)
        elif kind == "neck":
            targets[segment] = slerp(chest, frames.get("head", chest), np.array(0.5))
        elif segment in frames:
            targets[segment] = frames[segment]
        elif kind == "head":
            targets[segment] = frames[(neck or spine)[-1]]
        elif kind.endswith("clavicle"):
            targets[segment] = chest
        elif kind.endswith("wrist"):
            targets[segment] = frames[kind.replace("wrist", "elbow")]
        elif not source.parts.legs and kind.endswith(("hip", "knee", "ankle", "toe")):
            targets[segment] = heading_of(frames["pelvis"])
        elif kind.endswith("toe"):
            targets[segment] = frames[kind.replace("toe", "ankle")]
    return targets


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
    segments = target.chain(segment.rstrip("0123456789"))
    place = _heights(target, segments)[segments.index(segment)]
    at = float(np.interp(place, _heights(source, chain), np.arange(len(chain))))
    low, high = (frames[chain[k]] for k in (math.floor(at), math.ceil(at)))
    return slerp(low, high, np.array(at % 1))


def _heights(frames: BodyFrames, chain: list[str]) -> np.ndarray:
    """(N,) middles of the bones of a chain, as shares of the distance to the last one."""
    joints = [frames.joints[segment] for segment in chain]
    end = {"spine": ("neck0", "head"), "neck": ("head",)}[chain[0].rstrip("0123456789")]
    top = next((frames.joints[segment] for segment in end if segment in frames.joints), joints[-1])
    lengths = np.linalg.norm(np.diff(frames.places[[*joints, top]], axis=0), axis=1)
    middles = np.cumsum(lengths) - lengths / 2
    return middles / max(middles[-1], 1e-9)


def _carrier(target: BodyFrames) -> int:
    """Return the joint that carries the body: the root, or the pelvis if the root is a marker."""
    pelvis = target.joints["pelvis"]
    far = np.linalg.norm(target.places[pelvis] - target.places[0])
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
