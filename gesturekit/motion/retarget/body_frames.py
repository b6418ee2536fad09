"""Anatomical frames: the orientation of each body segment, independent of a rig's joint axes.

On a body that stands in a T-pose and faces +Z, all anatomical frames equal the world axes: x to its
left, y up, z forward. Each frame turns with its segment. A segment's frame therefore means the same
on every rig, whatever the rest pose, and motion is transferred through these frames.

The rotation from a joint's frame to its anatomical frame is read from a pose in which the rig
stands (`standing_pose`):

- arms, legs, fingers: the shortest rotation from the T-pose direction to the direction of the bone;
- hands with fingers: from the knuckles;
- feet: level and pointing forward, whatever the direction of the bone to the toes. A motion that
  stands gives the level orientation better than a rest pose (`BodyFrames.levelled`);
- pelvis, spine, neck, head, clavicles: the axes of the whole body, because the directions of these
  bones differ between rigs.

Most rigs stand at rest, with their arms anywhere. The rest pose of others (Bandai-Namco's, and all
whose bones lie along their own axes) does not look like a body: they need a frame of a motion in
which the body stands, or get a T-pose.
"""

from __future__ import annotations

import copy
import re

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES, BodyParts, find_parts
from gesturekit.motion.parts.body_size import body_scale, body_size, real_end_sites
from gesturekit.motion.rotations import (
    IDENTITY,
    invert_quaternions,
    mean_quaternion,
    multiply_quaternions,
    quaternion_from_matrix,
    rotate_vectors,
    shortest_arc,
)
from gesturekit.motion.skeleton import Skeleton, forward_kinematics, global_rotations

LEFT, UP, FORWARD = np.eye(3)
"""(3,) axes of a body that stands and faces +Z."""

_NO_LENGTH, _NO_BONE, _NO_DISTANCE, _NO_END = 1e-6, 1e-4, 1e-3, 0.01
"""Metres on the reference body; shorter bones of a limb, bones of the trunk, distances between
clavicles, across a hand or along a foot, and ends of limbs have no direction."""
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
    rest = np.tile(IDENTITY, (skeleton.n_joints, 1))
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


def standing_rig(skeleton: Skeleton) -> np.ndarray:
    """(J, 4) local rotations in which a rig stands upright, found without a motion.

    The rest pose if it stands. Otherwise each bone is rotated the shortest way to its direction in
    a T-pose. The directions are then right, but the twist of each bone is a guess.
    """
    parts, pose = find_parts(skeleton), np.tile(IDENTITY, (skeleton.n_joints, 1))
    if _stands(skeleton, pose):
        return pose
    wanted = _t_pose(skeleton, parts)
    places = skeleton.rest_positions
    pelvis, chest = skeleton.index(parts.pelvis), skeleton.index(parts.spine[-1])
    world = pose.copy()
    for j, parent in enumerate(skeleton.parents):
        turn = world[parent] if parent >= 0 else IDENTITY
        if j in (pelvis, chest):
            # Two directions are known: along the spine, and across hips or shoulders.
            top = wanted[j][0] if j == chest and j in wanted else chest
            up = places[top] - places[j] if top != j else places[chest] - places[pelvis]
            turn = invert_quaternions(frame(up, _across(skeleton, places, j == pelvis)))
        elif j in wanted:
            below, direction, spare = wanted[j]
            bone = rotate_vectors(turn, places[below] - places[j])
            length = np.linalg.norm(bone)
            if length > _NO_LENGTH * body_scale(skeleton):
                arc = shortest_arc(bone / length, direction, spare)
                turn = multiply_quaternions(arc, turn)
        world[j] = turn
    above = invert_quaternions(world[list(skeleton.parents[1:])])
    return np.concatenate([world[:1], multiply_quaternions(above, world[1:])])


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


def _across(skeleton: Skeleton, places: np.ndarray, hips: bool) -> np.ndarray:
    """(3,) vector from right to left hip, or from right to left clavicle or shoulder, metres.

    A body without legs has the latter for both. `places` are the joints' positions (J, 3).
    """
    parts = find_parts(skeleton)

    def between(*names: str) -> np.ndarray:
        left, right = (places[skeleton.index(name)] for name in names)
        return left - right

    if hips and parts.legs:
        return between(*(parts.legs[side].hip for side in SIDES))
    left, right = (parts.arms[side] for side in SIDES)
    if left.clavicle and right.clavicle:
        apart = between(left.clavicle, right.clavicle)
        if np.linalg.norm(apart) > _NO_DISTANCE * body_scale(skeleton):
            return apart
    return between(left.shoulder, right.shoulder)


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


_DRAWN_LEVEL = np.deg2rad(10.0)
"""A bone from ankle to toes that is less steep than this means a foot drawn level: no person's
ankle is as low as the ball of the foot."""
_STEEP = np.deg2rad(60.0)
"""A steeper bone means a foot that points down."""
_LEG_SHARE = 0.57
"""Length of an adult's leg from hip to ankle, as a share of `body_size`."""
_USUAL_PITCH = np.deg2rad(27.0)
"""Pitch of the bone from ankle to toes on a level foot."""
_STEADY = np.deg2rad(15.0)
"""A foot whose tilt varies by more while it stands gives no level orientation."""


class BodyFrames:
    """Body segments of a rig, and their anatomical frames relative to its joints.

    Attributes:
        skeleton: the rig, J joints.
        parts: its body parts.
        pose: (J, 4) local rotations in which it stands.
        places: (J, 3) positions of the joints in that pose, the root at the origin, metres.
        joints: segment ("pelvis", "spine0", "left_elbow", "left_index0", ...) to joint.
        from_anatomical: segment to (4,), rotation from the anatomical frame to the joint's frame.
        bones: segment to (joint at the end of its bone, direction (3,) in the anatomical frame);
            only segments whose direction is transferred exactly.
        toes: side to (joint, offset (3,) in its frame) of the point about which the foot rolls.
        hands: side to (joint, offset (3,)) of the wrist, or of the end of the forearm without one.
    """

    def __init__(self, skeleton: Skeleton, pose: np.ndarray) -> None:
        """Read the anatomical frames from a pose (J, 4), local rotations in which the rig stands.

        Raises:
            MotionError: parts that cannot be identified.
        """
        self.skeleton, self.parts, self.pose = skeleton, find_parts(skeleton), pose
        self.places = forward_kinematics(pose, np.zeros(3), skeleton)
        self._turns = global_rotations(pose, skeleton)
        self._body = body_frame(skeleton, pose)
        self._scale, self._sites = body_scale(skeleton), real_end_sites(skeleton)
        self.joints: dict[str, int] = {}
        self.from_anatomical: dict[str, np.ndarray] = {}
        self.bones: dict[str, tuple[int, np.ndarray]] = {}
        self.toes: dict[str, tuple[int, np.ndarray]] = {}
        self.hands: dict[str, tuple[int, np.ndarray]] = {}
        self._add_trunk()
        for side, outward in zip(SIDES, (LEFT, -LEFT)):
            self._add_arm(side, outward)
            if self.parts.legs:
                self._add_leg(side)

    def on(self, skeleton: Skeleton) -> BodyFrames:
        """Return the same frames on the rig with other offsets."""
        made = copy.copy(self)
        made.skeleton = skeleton
        made.places = forward_kinematics(self.pose, np.zeros(3), skeleton)
        return made

    def world(
        self, rotations: np.ndarray, positions: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        """Return segment to (..., 4), the world rotation of its anatomical frame.

        Args:
            rotations: (..., J, 4) world rotations of the joints.
            positions: (..., J, 3) positions of the joints. If given, bone directions come from
                them, which also handles joint translations and limbs bent by helper joints.
        """
        segments, joints = list(self.joints), list(self.joints.values())
        from_anatomical = np.array([self.from_anatomical[segment] for segment in segments])
        frames = multiply_quaternions(rotations[..., joints, :], from_anatomical)
        if positions is not None and self.bones:
            shortest = _NO_LENGTH * body_scale(self.skeleton)
            drawn = [segments.index(segment) for segment in self.bones]
            ends, directions = zip(*self.bones.values())
            starts = [joints[k] for k in drawn]
            bone = positions[..., list(ends), :] - positions[..., starts, :]
            length = np.linalg.norm(bone, axis=-1, keepdims=True)
            expected = rotate_vectors(frames[..., drawn, :], np.array(directions))
            bone = np.where(length > shortest, bone / np.maximum(length, shortest), expected)
            arc = shortest_arc(expected, bone)
            frames[..., drawn, :] = multiply_quaternions(arc, frames[..., drawn, :])
        return {segment: frames[..., k, :] for k, segment in enumerate(segments)}

    def chain(self, kind: str) -> list[str]:
        """Return the segments of a kind, "spine" or "neck", from below: "spine0", "spine1", ..."""
        return [segment for segment in self.joints if segment.rstrip("0123456789") == kind]

    def leg_lengths(self) -> dict[str, float]:
        """Return side to metres from hip to knee to ankle."""
        lengths = {}
        for side in SIDES:
            leg = self.places[[self.joints[f"{side}_{part}"] for part in ("hip", "knee", "ankle")]]
            lengths[side] = float(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum())
        return lengths

    def leg_length(self) -> float:
        """Return the mean length of both legs, metres; without legs, what the person would have."""
        if not self.parts.legs:
            return _LEG_SHARE * body_size(self.skeleton)
        return sum(self.leg_lengths().values()) / 2

    def foot_heights(self, side: str) -> tuple[float, float]:
        """Return (ankle, toe point) heights above the lower of the two on a level foot, metres."""
        if side not in self.toes:
            return 0.0, 0.0
        back = invert_quaternions(self.from_anatomical[f"{side}_ankle"])
        below = rotate_vectors(back, self.foot(side))[1]
        return max(-below, 0.0), max(below, 0.0)

    def foot(self, side: str) -> np.ndarray:
        """(3,) vector from the ankle to the toe point in the frame of the ankle, metres."""
        ankle = self.joints[f"{side}_ankle"]
        joint, offset = self.toes[side]
        tip = self.places[joint] + rotate_vectors(self._turns[joint], offset)
        return rotate_vectors(invert_quaternions(self._turns[ankle]), tip - self.places[ankle])

    def levelled(self, motion: Motion, standing: np.ndarray) -> BodyFrames:
        """Return the frames with level feet as measured in a motion instead of in the pose.

        Args:
            motion: T frames of this rig.
            standing: (T, 2) bool, true if the left or right foot stands flat on the floor.
        """
        made = copy.copy(self)
        made.from_anatomical = dict(self.from_anatomical)
        world = motion.global_rotations()
        for side, stands in zip(SIDES, standing.T):
            if side not in self.toes or stands.sum() < 5:
                continue
            turns = world[stands, self.joints[f"{side}_ankle"]]
            ups = rotate_vectors(invert_quaternions(turns), UP)
            up = ups.mean(axis=0) / np.linalg.norm(ups.mean(axis=0))
            if np.quantile(np.arccos(np.clip(ups @ up, -1, 1)), 0.8) > _STEADY:
                continue  # the foot rolls while it stands
            level = made.from_anatomical[f"{side}_ankle"] = frame(up, np.cross(up, self.foot(side)))
            toe = self.joints.get(f"{side}_toe")
            if toe is not None:
                back = invert_quaternions(world[stands, toe])
                toes = multiply_quaternions(back, multiply_quaternions(turns, level))
                made.from_anatomical[f"{side}_toe"] = mean_quaternion(toes)
        return made

    def _add(self, segment: str, joint: str | int, turn: np.ndarray) -> np.ndarray:
        """Add a segment with its anatomical frame `turn` (4,) in the pose, and return the frame."""
        joint = joint if isinstance(joint, int) else self.skeleton.index(joint)
        self.joints[segment] = joint
        back = invert_quaternions(self._turns[joint])
        self.from_anatomical[segment] = multiply_quaternions(back, turn)
        return turn

    def _add_trunk(self) -> None:
        parts, skeleton = self.parts, self.skeleton
        self._add("pelvis", parts.pelvis, self._body)
        for k, name in enumerate(parts.spine):
            self._add(f"spine{k}", name, self._body)
        if parts.head is None:
            return
        if parts.neck is not None:
            above = skeleton.ancestors(skeleton.index(parts.head))
            bottom = above.index(skeleton.index(parts.neck))
            for k, joint in enumerate(above[: bottom + 1][::-1]):
                self._add(f"neck{k}", joint, self._body)
        self._add("head", parts.head, self._body)

    def _add_bone(
        self, segment: str, joint: int, below: int, drawn: np.ndarray, turn: np.ndarray
    ) -> np.ndarray:
        """Add a segment whose bone ends at joint `below`; see `_aligned`."""
        self.bones[segment] = (below, drawn)
        bone = self.places[below] - self.places[joint]
        return self._add(segment, joint, _aligned(turn, drawn, bone))

    def _add_arm(self, side: str, outward: np.ndarray) -> None:
        arm, index = self.parts.arms[side], self.skeleton.index
        if arm.clavicle is not None:
            self._add(f"{side}_clavicle", arm.clavicle, self._body)
        elbow = index(arm.elbow)
        self._add_bone(f"{side}_shoulder", index(arm.shoulder), elbow, outward, self._body)
        if arm.wrist is None:
            end = self._end(elbow)
            self._mark(self.hands, side, elbow, end)
            self._add(f"{side}_elbow", elbow, _aligned(self._body, outward, end))
            return
        wrist = index(arm.wrist)
        forearm = self._add_bone(f"{side}_elbow", elbow, wrist, outward, self._body)
        self.hands[side] = (wrist, np.zeros(3))
        chains = finger_chains(self.skeleton, self.parts, side)
        hand = self._add(f"{side}_wrist", wrist, self._hand(wrist, chains, forearm, outward))
        for kind, chain in chains.items():
            for k, joint in enumerate(chain):
                below = self.skeleton.children(joint)
                if len(below) == 1:
                    self._add_bone(f"{side}_{kind}{k}", joint, below[0], outward, hand)

    def _hand(
        self,
        wrist: int,
        chains: dict[str, list[int]],
        forearm: np.ndarray,
        outward: np.ndarray,
    ) -> np.ndarray:
        """(4,) frame of a hand: from the knuckles of its fingers, or along the forearm's frame."""
        knuckles = [self.places[chain[0]] for kind, chain in chains.items() if kind != "thumb"]
        if len(knuckles) >= 2:
            fingers = np.mean(knuckles, axis=0) - self.places[wrist]
            thumbward = knuckles[0] - knuckles[-1]
            shortest = min(np.linalg.norm(fingers), np.linalg.norm(thumbward))
            if shortest > _NO_DISTANCE * self._scale:
                # In a T-pose fingers point outward, the thumb's side forward and the palm down.
                fingers = fingers * outward[0]
                return frame(np.cross(thumbward, fingers), fingers)
        return _aligned(forearm, outward, self._end(wrist))

    def _end(self, joint: int) -> np.ndarray:
        """(3,) world vector from a joint to its farthest child or end site, metres."""
        sites = self._sites.get(self.skeleton.names[joint], ())
        ends = [rotate_vectors(self._turns[joint], site) for site in sites]
        ends += [self.places[j] - self.places[joint] for j in self.skeleton.children(joint)]
        return max(ends, key=np.linalg.norm, default=np.zeros(3))

    def _mark(
        self, ends: dict[str, tuple[int, np.ndarray]], side: str, joint: int, end: np.ndarray
    ) -> None:
        """Note a limb's end, (3,) in the world from its last joint, unless it is too near."""
        if np.linalg.norm(end) > _NO_END * self._scale:
            ends[side] = (joint, rotate_vectors(invert_quaternions(self._turns[joint]), end))

    def _add_leg(self, side: str) -> None:
        leg, index = self.parts.legs[side], self.skeleton.index
        hip, knee, ankle = (index(name) for name in (leg.hip, leg.knee, leg.ankle))
        self._add_bone(f"{side}_hip", hip, knee, -UP, self._body)
        self._add_bone(f"{side}_knee", knee, ankle, -UP, self._body)
        if leg.toe is None:
            bone = self._end(ankle)
            self._mark(self.toes, side, ankle, bone)
        else:
            toe = index(leg.toe)
            self.toes[side] = (toe, np.zeros(3))
            bone = self.places[toe] - self.places[ankle]
        level = self._level(bone)
        self._add(f"{side}_ankle", ankle, self._pitched(level, bone))
        if leg.toe is not None:
            self._add(f"{side}_toe", toe, level)

    def _level(self, bone: np.ndarray) -> np.ndarray:
        """(4,) frame of a level foot with the heading of its bone (3,)."""
        up = rotate_vectors(self._body, UP)
        ahead = bone - (bone @ up) * up
        if np.linalg.norm(ahead) < 0.1 * np.linalg.norm(bone) + 1e-9:
            ahead = rotate_vectors(self._body, FORWARD)
        return frame(up, np.cross(up, ahead))

    def _pitched(self, level: np.ndarray, bone: np.ndarray) -> np.ndarray:
        """(4,) frame of the foot in the pose, in which it may be drawn level or pointing down."""
        _, y, z = rotate_vectors(invert_quaternions(level), bone)
        pitch = np.arctan2(-y, np.abs(z))
        if _DRAWN_LEVEL <= pitch <= _STEEP or np.linalg.norm(bone) < _NO_DISTANCE * self._scale:
            return level
        # Pitch of the foot in the pose against that of a standing foot.
        lift = (_USUAL_PITCH - pitch) / 2
        about_x = np.array([-np.sin(lift), 0.0, 0.0, np.cos(lift)])
        return multiply_quaternions(level, about_x)


def _aligned(turn: np.ndarray, drawn: np.ndarray, bone: np.ndarray) -> np.ndarray:
    """(4,) `turn` rotated the shortest way so that `drawn` (3,) points along `bone` (3,).

    `drawn` is the direction in a T-pose. A bone of length 0 changes nothing.
    """
    length = np.linalg.norm(bone)
    if length < 0.5e-9:
        return turn
    unit = bone / max(length, 1e-9)
    return multiply_quaternions(shortest_arc(rotate_vectors(turn, drawn), unit), turn)


FINGERS = ("thumb", "index", "middle", "ring", "little")
_WORDS = {
    "thumb": r"thumb",
    "index": r"index",
    "middle": r"middle|mid(?![a-z])",
    "ring": r"ring(?![a-z])",
    "little": r"pink(?:y|ie)|little",
}
_BY_NUMBER = re.compile(r"finger[ _]?([0-4])")
"""Names of 3ds Max, counted from the thumb: Finger0, Finger01, Finger02, Finger1, ..."""
_IN_THE_PALM = re.compile(r"metacarpal|carpal|_mc(?![a-z])")


def finger_chains(skeleton: Skeleton, parts: BodyParts, side: str) -> dict[str, list[int]]:
    """Return finger to its joints from the knuckle outwards, for the fingers that are found.

    Bones within the palm (metacarpals) are left out, except that of the thumb.
    """
    wrist = parts.arms[side].wrist
    if wrist is None:
        return {}
    chains: dict[str, list[int]] = {}
    for joint in skeleton.descendants(skeleton.index(wrist)):
        kind = _kind(skeleton.names[joint])
        if kind is None:
            continue
        chain = chains.setdefault(kind, [])
        # Side branches (nails, helpers) are not part of the chain.
        if not chain or skeleton.parents[joint] == chain[-1]:
            chain.append(joint)
    return {kind: chains[kind] for kind in FINGERS if kind in chains}


def _kind(name: str) -> str | None:
    """Return the finger that a joint name belongs to."""
    name = name.rsplit(":", 1)[-1].lower()
    for kind, words in _WORDS.items():
        if re.search(words, name):
            return None if kind != "thumb" and _IN_THE_PALM.search(name) else kind
    numbered = _BY_NUMBER.search(name)
    return FINGERS[int(numbered[1])] if numbered else None
