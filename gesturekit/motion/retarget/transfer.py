"""Retargeting: transfer a motion to a rig with other names, offsets, rest pose or extra joints.

1. Each segment of the target gets the anatomical frame of the source (`body_frames`): arms, legs
   and fingers point in the same direction, hands and heads have the same orientation, whatever the
   two rest poses are. Spines and necks with different numbers of joints are matched along their
   length.
2. The path of the hips is scaled by leg length, measured above each rig's own ankles.
3. Hands near the body are placed where they are on the source, scaled by arm span: if only
   directions were copied, folded hands would come apart on a body with wider shoulders, or pass
   through each other. An arm that hangs or points away keeps its direction. In between the two
   targets are blended.
4. If the target's feet are then not at the scaled source positions, two-bone IK places them there:
   planted feet stay planted, on the floor.

Joints without a counterpart in the source keep their rest rotation. Where one of the rigs has no
legs, the pelvis moves as the source's, and legs of the target stand straight below it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.contacts import CONTACT_SPEED
from gesturekit.motion.ik import (
    HIP_DROP_SECONDS,
    STRETCH,
    Reach,
    bend_limbs,
    smooth_upper_envelope,
    too_high,
)
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES, find_parts
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.resampling import smoothstep
from gesturekit.motion.retarget.body_frames import (
    FORWARD,
    BodyFrames,
    standing_pose,
    standing_rig,
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
_SHORT, _ALIKE = 0.1, np.cos(np.deg2rad(10.0))
"""Bones of one rest pose are at an angle of less than 10°, but for those shorter than 10 cm on the
reference body: performers differ."""
_FEWEST_STANDING = 5
"""Frames in which a foot must stand for its height to be measured."""

Heights = tuple[tuple[float, float], tuple[float, float]]
"""(ankle, toe) above the floor of a level foot, metres, of the source and of the target."""


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


class _FootMotion(NamedTuple):
    """Foot positions of the source, and when each foot stands; left before right.

    Attributes:
        ankles: (T, 2, 3) metres.
        toes: (T, 2, 3) of the toe point, or of the ankle on a side without one, metres.
        standing: (T, 2) bool, true if heel and toe are both still.
        hips: (T, 3) midpoint between the hips, metres.
        stretch: (T, 2), distance from hip to ankle as a share of the leg length, 0 to 1.
        floor: height of the lowest joint of a standing foot, metres.
    """

    ankles: np.ndarray
    toes: np.ndarray
    standing: np.ndarray
    hips: np.ndarray
    stretch: np.ndarray
    floor: float


def _foot_motion(
    motion: Motion, frames: BodyFrames, positions: np.ndarray, world: np.ndarray
) -> _FootMotion:
    """Measure the feet of a motion.

    Args:
        motion: T frames.
        frames: segments of its rig.
        positions: (T, J, 3) positions of its joints, metres.
        world: (T, J, 4) their world rotations.
    """
    hips, knees, ankles = (
        positions[:, [frames.joints[f"{side}_{part}"] for side in SIDES]]
        for part in ("hip", "knee", "ankle")
    )
    toes = ankles.copy()
    for k, side in enumerate(SIDES):
        if side in frames.toes:
            joint, offset = frames.toes[side]
            toes[:, k] = positions[:, joint] + rotate_vectors(world[:, joint], offset)
    both = np.stack([ankles, toes], axis=1)
    speed = np.linalg.norm(np.diff(both, axis=0, prepend=both[:1]), axis=3) * motion.fps
    standing = (speed < CONTACT_SPEED * body_scale(motion.skeleton)).all(axis=1)
    lowest = np.minimum(ankles, toes)[..., 1]
    still = lowest[standing]
    floor = np.median(still) if len(still) > 10 else np.quantile(lowest.min(axis=1), 0.05)
    bones = np.linalg.norm(knees - hips, axis=2) + np.linalg.norm(ankles - knees, axis=2)
    stretch = np.linalg.norm(ankles - hips, axis=2) / bones
    return _FootMotion(ankles, toes, standing, hips.sum(axis=1) / 2, stretch, float(floor))


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
        self._lean: np.ndarray | None = None
        self._lift: float | None = None

    def __call__(self, motion: Motion) -> Motion:
        """Return the motion on the target rig; errors as for `retarget`."""
        skeleton, rig = self._skeleton, motion.skeleton
        same = _is_one_rig(motion, skeleton)
        source = self._source or BodyFrames(rig, standing_pose(motion))
        places, turns = motion.positions(), motion.global_rotations()
        feet = _foot_motion(motion, source, places, turns) if source.parts.legs else None
        if self._source is None:
            source = self._source = self._fit(motion, source, places, feet, same)
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
        rotations = _place_hands(source, target, places, turns, positions, rotations)
        # Neither arms nor legs move the hips, or what is above them.
        if feet is None or not target.parts.legs:
            shift = self._pelvis_shift(places[:, source.joints["pelvis"]], positions)
        else:
            rotations, shift = self._on_feet(rotations, world, positions, feet)
        still = np.zeros((len(world), 3))
        info = {k: motion.info[k] for k in ("source",) if k in motion.info}
        made = Motion(skeleton, rotations, still, motion.fps, moving, info, motion.face)
        # Joints above the carrier stand still.
        return made.with_joint_at(carrier, positions[:, carrier] + shift)

    def _fit(
        self,
        motion: Motion,
        source: BodyFrames,
        places: np.ndarray,
        feet: _FootMotion | None,
        same: bool,
    ) -> BodyFrames:
        """Measure the first motion, and return the frames of its rig with level feet."""
        if feet is not None:
            source = source.levelled(motion, feet.standing)
        if same:
            # Joint axes mean the same on one rig, whatever the offsets of a performer.
            target = source.on(self._skeleton)
        else:
            pose = standing_rig(self._skeleton) if self._pose is None else np.asarray(self._pose)
            target = BodyFrames(self._skeleton, pose)
        self._target, self._scale = target, target.leg_length() / source.leg_length()
        pelvis = target.joints["pelvis"]
        far = np.linalg.norm(target.places[pelvis] - target.places[0])
        # The joint that carries the body: the root, or the pelvis if the root is a marker.
        self._carrier = pelvis if far > _FLOOR_MARKER * target.leg_length() else 0
        self._drop_frames = round(HIP_DROP_SECONDS * motion.fps)
        # The point on the floor about which the source is scaled.
        self._base = places[0, source.joints["pelvis"]] * [1, 0, 1]
        if feet is not None:
            self._base[1] = feet.floor
            if target.parts.legs:
                self._base[[0, 2]] = feet.hips[0, [0, 2]]
                self._heights = [self._foot_heights(k, source, feet, same) for k in (0, 1)]
        return source

    def _foot_heights(
        self, side: int, source: BodyFrames, feet: _FootMotion, same: bool
    ) -> Heights:
        """Return the heights of a foot; `same`: both are one rig, apart from its size."""
        ankle, toe = source.foot_heights(SIDES[side])
        if (still := feet.standing[:, side]).sum() >= _FEWEST_STANDING:
            ankle, toe = (
                float(np.median(points[still, side, 1])) - feet.floor
                for points in (feet.ankles, feet.toes)
            )
        scaled = ankle * self._scale, toe * self._scale
        return (ankle, toe), scaled if same else self._target.foot_heights(SIDES[side])

    def _on_feet(
        self, rotations: np.ndarray, world: np.ndarray, positions: np.ndarray, feet: _FootMotion
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return local rotations (T, J, 4) with solved legs, and the movement (T, 3) of the hips.

        `world` and `positions` are those of the target's joints, its root at the origin.
        """
        target, joints = self._target, self._target.joints
        ankles = [self._ankle(side, world, feet) for side in (0, 1)]
        pelvis = multiply_quaternions(world[:, joints["pelvis"]], target.from_anatomical["pelvis"])
        heading = _heading_of(pelvis)
        if self._lean is None:
            # With this offset the hips' mean place over the ankles is that of the source, so that
            # a target with longer or shorter feet does not lean. Heights do not matter.
            moved = sum(
                ankle - self._scaled(feet.ankles[:, side], 0.0, 0.0)
                for side, ankle in enumerate(ankles)
            )
            lean = rotate_vectors(invert_quaternions(heading), moved / 2)
            self._lean = lean.mean(axis=0) * [1, 0, 1]
        before, after = [float(np.mean([own[i][0] for own in self._heights])) for i in (0, 1)]
        hips = self._scaled(feet.hips, before, after) + rotate_vectors(heading, self._lean)
        left, right = (positions[:, joints[f"{side}_hip"]] for side in SIDES)
        centre = (left + right) / 2
        if not self._feet:
            return rotations, hips - centre
        low = np.zeros(len(hips))
        for hip, ankle, side in zip((left, right), ankles, (0, 1)):
            length = target.leg_lengths()[SIDES[side]] * np.maximum(feet.stretch[:, side], STRETCH)
            low = np.maximum(low, too_high(hips + (hip - centre) - ankle, length))
        hips[:, 1] -= smooth_upper_envelope(low, self._drop_frames)
        places, limbs = positions + (hips - centre)[:, None], []
        for side, ankle in zip(SIDES, ankles):
            limb = [joints[f"{side}_{part}"] for part in ("hip", "knee", "ankle")]
            thigh = multiply_quaternions(world[:, limb[0]], target.from_anatomical[f"{side}_hip"])
            pole = rotate_vectors(thigh, FORWARD)
            # Feet keep their orientation.
            turn = world[:, limb[2]]
            limbs.append(Reach(limb[:2], limb[2], places[:, limb], ankle, turn, pole))
        return bend_limbs(target.skeleton, rotations, world, limbs), hips - centre

    def _ankle(self, side: int, world: np.ndarray, feet: _FootMotion) -> np.ndarray:
        """(T, 3) target position of an ankle, metres.

        It puts the ball of the foot, on which people stand and turn, at the source's position.
        """
        (own_ankle, own_toe), (ankle, toe) = self._heights[side]
        if SIDES[side] not in self._target.toes:
            return self._scaled(feet.ankles[:, side], own_ankle, ankle)
        tip = self._scaled(feet.toes[:, side], own_toe, toe)
        turn = world[:, self._target.joints[f"{SIDES[side]}_ankle"]]
        return tip - rotate_vectors(turn, self._target.foot(SIDES[side]))

    def _scaled(self, points: np.ndarray, own_height: float, height: float) -> np.ndarray:
        """(T, 3) `points` (T, 3) scaled about a point on the floor.

        Height `own_height` above the floor in the source becomes `height` in the target.
        """
        base = self._base + [0, own_height, 0]
        return (points - base) * self._scale + base + [0, height - own_height, 0]

    def _pelvis_shift(self, pelvis: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """(T, 3) movement of the pelvis where one of the rigs has no legs.

        The path of the source's `pelvis` (T, 3) is scaled about the floor under its first frame,
        which is at 0 without feet. The height of a source without legs says nothing about
        standing, so that a target with legs stands on the floor.
        """
        body = positions[:, self._target.joints["pelvis"]]
        path = (pelvis - self._base) * self._scale + self._base
        if self._lift is None:
            self._lift = 0.0
            if legs := self._target.parts.legs.values():
                names = [joint for leg in legs for joint in (leg.ankle, leg.toe)]
                ends = [self._skeleton.index(name) for name in names if name is not None]
                stands = np.median(body[:, 1] - positions[:, ends, 1].min(axis=1))
                self._lift = float(stands - np.median(path[:, 1]))
        return path + [0.0, self._lift, 0.0] - body


def _is_one_rig(motion: Motion, skeleton: Skeleton) -> bool:
    """Return whether two rigs have the same joints and rest pose, whatever their sizes.

    Offsets of joints that move, and down to the pelvis, may be those of the first frame.
    """
    rig = motion.skeleton
    if (rig.names, rig.parents) != (skeleton.names, skeleton.parents):
        return False
    pelvis = rig.index(find_parts(rig).pelvis)
    moving = {pelvis, *rig.ancestors(pelvis), *map(rig.index, motion.joint_translations)}
    bones = [j for j in range(rig.n_joints) if j not in moving]
    own, wanted = (one.offsets[bones] / body_scale(one) for one in (rig, skeleton))
    lengths = np.linalg.norm(own, axis=1), np.linalg.norm(wanted, axis=1)
    is_long = np.minimum(*lengths) > _SHORT
    return bool(((own * wanted).sum(axis=1) > _ALIKE * np.prod(lengths, axis=0))[is_long].all())


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
            targets[segment] = _heading_of(frames["pelvis"])
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


def _heading_of(turns: np.ndarray) -> np.ndarray:
    """(T, 4) rotations about the vertical that face where anatomical frames (T, 4) face."""
    ahead = rotate_vectors(turns, FORWARD)
    half = np.arctan2(ahead[:, 0], ahead[:, 2]) / 2
    return np.stack([0 * half, np.sin(half), 0 * half, np.cos(half)], axis=1)


_INSIDE, _OUTSIDE = 0.4, 1.1
"""Lateral distances from the middle of the body, as shares of half the shoulder width: up to the
first a hand is placed by position, from the second on by the direction of its arm."""


def _place_hands(
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
        upper_arm = target.from_anatomical[f"{side}_shoulder"]
        pole = rotate_vectors(multiply_quaternions(world[:, bones[0]], upper_arm), -FORWARD)
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
