"""What the joint axes of a rig mean: one anatomical frame for each segment of the body.

The anatomical frames of a body that stands in a T-pose and faces +Z are all the world's axes: x to
its left, y up, z forward. They move with their segments. So a segment's frame means the same on any
rig, whatever the rig's rest pose, and a motion is carried from one to the other by them.

How they lie in a rig's joints is read off a pose in which it stands (`standing`):

- arms, legs, fingers: turned the shortest way from the T-pose's direction to the bone's. An arm
  that hangs, or is held forward, has its elbow and thumb where they then are on a person;
- hands with fingers: by the knuckles;
- feet: level and forward whichever way the bone to the toes is drawn; a motion that stands tells
  what level is better than a rest pose does (`levelled`);
- pelvis, spine, neck, head, clavicles: the body's own axes, for these bones are drawn as one likes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gesturekit.motion.body_size import body_scale
from gesturekit.motion.kinematics import forward_kinematics, global_rotations
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES, BodyParts
from gesturekit.motion.parts.end_sites import real_end_sites
from gesturekit.motion.parts.fingers import finger_chains
from gesturekit.motion.retarget.standing_pose import FORWARD, LEFT, UP, body_frame, frame
from gesturekit.motion.rotations import (
    invert_quaternions,
    mean_quaternion,
    multiply_quaternions,
    rotate_vectors,
    shortest_arc,
)
from gesturekit.motion.skeleton import Skeleton

_NO_LENGTH, _NO_WAY, _NO_END = 1e-6, 1e-3, 0.01
"""Metres on the reference body; shorter bones, ways across a hand or along a foot, and ends of
limbs have no direction."""
_DRAWN_LEVEL = np.deg2rad(10.0)
"""A foot whose bone to the toes is less steep at rest is drawn level: no person's ankle is as low
as the ball of the foot."""
_STEEP = np.deg2rad(60.0)
_USUAL_PITCH = np.deg2rad(27.0)
_STEADY = np.deg2rad(15.0)


@dataclass(frozen=True, eq=False)
class BodyFrames:
    """The segments of a rig and how their anatomical frames lie in its joints.

    Attributes:
        skeleton: the rig.
        parts: its parts.
        pose: (J, 4) local rotations in which it stands.
        joints: segment ("pelvis", "spine0", "left_elbow", "left_index0", ...) to joint.
        own: segment to (4,), the turn from the anatomical frame to the joint's frame.
        bones: segment to (joint that its bone leads to, direction in the anatomical frame); only
            segments whose direction is carried over exactly.
        toes: side to (joint, offset (3,) in its frame) of the point where the foot rolls.
        hands: side to the same of the wrist, or of where the forearm ends without one.
    """

    skeleton: Skeleton
    parts: BodyParts
    pose: np.ndarray
    joints: dict[str, int]
    own: dict[str, np.ndarray]
    bones: dict[str, tuple[int, np.ndarray]]
    toes: dict[str, tuple[int, np.ndarray]]
    hands: dict[str, tuple[int, np.ndarray]]

    def world(
        self, turned: np.ndarray, positions: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        """Segment to (..., 4), its anatomical frame in the world.

        Args:
            turned: (..., J, 4) world rotations of the joints.
            positions: (..., J, 3) of the joints; where a file moves joints, or helper joints bend
                a limb, they tell the direction of a bone better than its rest does.
        """
        found = {}
        shortest = _NO_LENGTH * body_scale(self.skeleton)
        for segment, joint in self.joints.items():
            own = multiply_quaternions(turned[..., joint, :], self.own[segment])
            if positions is not None and segment in self.bones:
                below, direction = self.bones[segment]
                bone = positions[..., below, :] - positions[..., joint, :]
                length = np.linalg.norm(bone, axis=-1, keepdims=True)
                drawn = rotate_vectors(own, np.broadcast_to(direction, bone.shape))
                bone = np.where(length > shortest, bone / np.maximum(length, shortest), drawn)
                own = multiply_quaternions(shortest_arc(drawn, bone), own)
            found[segment] = own
        return found

    def chain(self, kind: str) -> list[str]:
        """Segments "spine0", "spine1", ... or "neck0", ..., from below."""
        return [segment for segment in self.joints if segment.rstrip("0123456789") == kind]

    def leg_lengths(self) -> dict[str, float]:
        """Side to metres from hip to knee to ankle."""
        places = forward_kinematics(self.pose, np.zeros(3), self.skeleton)
        lengths = {}
        for side in SIDES:
            way = places[[self.joints[f"{side}_{part}"] for part in ("hip", "knee", "ankle")]]
            lengths[side] = float(np.linalg.norm(np.diff(way, axis=0), axis=-1).sum())
        return lengths

    def leg_length(self) -> float:
        """Metres, mean of both legs."""
        return sum(self.leg_lengths().values()) / 2

    def foot_heights(self, side: str) -> tuple[float, float]:
        """(ankle, toe point), metres above the lower of the two on a level foot."""
        if side not in self.toes:
            return 0.0, 0.0
        below = rotate_vectors(invert_quaternions(self.own[f"{side}_ankle"]), self.foot(side))[1]
        return max(-below, 0.0), max(below, 0.0)

    def foot(self, side: str) -> np.ndarray:
        """(3,) from the ankle to the toe point, metres, in the ankle's frame."""
        ankle = self.joints[f"{side}_ankle"]
        joint, offset = self.toes[side]
        places = forward_kinematics(self.pose, np.zeros(3), self.skeleton)
        turned = global_rotations(self.pose, self.skeleton)
        tip = places[joint] + rotate_vectors(turned[joint], offset)
        return rotate_vectors(invert_quaternions(turned[ankle]), tip - places[ankle])

    def levelled(self, motion: Motion, standing: dict[str, np.ndarray]) -> BodyFrames:
        """With feet as they stand in a motion, in place of as the rig draws them.

        Args:
            motion: a motion of this rig.
            standing: side to (T,) bool, frames in which that foot stands flat on the floor.
        """
        own = dict(self.own)
        turned = motion.global_rotations()
        for side in SIDES:
            if side not in self.toes or standing[side].sum() < 5:
                continue
            ankle = self.joints[f"{side}_ankle"]
            back = invert_quaternions(turned[standing[side], ankle])
            ups = rotate_vectors(back, np.broadcast_to(UP, (len(back), 3)))
            up = ups.mean(axis=0) / np.linalg.norm(ups.mean(axis=0))
            if np.quantile(np.arccos(np.clip(ups @ up, -1, 1)), 0.8) > _STEADY:
                continue  # it rolls all the time: nothing to learn
            own[f"{side}_ankle"] = frame(up, np.cross(up, self.foot(side)))
            toe = self.joints.get(f"{side}_toe")
            if toe is not None:
                foot = multiply_quaternions(turned[standing[side], ankle], own[f"{side}_ankle"])
                toes = invert_quaternions(turned[standing[side], toe])
                own[f"{side}_toe"] = mean_quaternion(multiply_quaternions(toes, foot))
        return replace(self, own=own)


def body_frames(skeleton: Skeleton, parts: BodyParts, pose: np.ndarray) -> BodyFrames:
    """Read the anatomical frames of a rig off a pose in which it stands.

    Args:
        skeleton: the rig.
        parts: its parts.
        pose: (J, 4) local rotations, as of `standing.standing_pose`.
    """
    return _Builder(skeleton, parts, pose).build()


class _Builder:
    def __init__(self, skeleton: Skeleton, parts: BodyParts, pose: np.ndarray) -> None:
        self.skeleton, self.parts, self.pose = skeleton, parts, pose
        self.scale, self.ends = body_scale(skeleton), real_end_sites(skeleton)
        self.places = forward_kinematics(pose, np.zeros(3), skeleton)
        self.turned = global_rotations(pose, skeleton)
        self.body = body_frame(skeleton, parts, pose)
        self.joints: dict[str, int] = {}
        self.frames: dict[str, np.ndarray] = {}
        self.bones: dict[str, tuple[int, np.ndarray]] = {}
        self.toes: dict[str, tuple[int, np.ndarray]] = {}
        self.hands: dict[str, tuple[int, np.ndarray]] = {}

    def build(self) -> BodyFrames:
        self._trunk()
        for side, outward in zip(SIDES, (LEFT, -LEFT)):
            self._arm(side, outward)
            self._leg(side)
        own = {
            segment: multiply_quaternions(
                invert_quaternions(self.turned[joint]), self.frames[segment]
            )
            for segment, joint in self.joints.items()
        }
        return BodyFrames(
            self.skeleton,
            self.parts,
            self.pose,
            self.joints,
            own,
            self.bones,
            self.toes,
            self.hands,
        )

    def _add(self, segment: str, joint: str | int, turn: np.ndarray) -> None:
        self.joints[segment] = joint if isinstance(joint, int) else self.skeleton.index(joint)
        self.frames[segment] = turn

    def _trunk(self) -> None:
        parts, skeleton = self.parts, self.skeleton
        self._add("pelvis", parts.pelvis, self.body)
        for k, name in enumerate(parts.spine):
            self._add(f"spine{k}", name, self.body)
        if parts.head is None:
            return
        if parts.neck is not None:
            chest, head = skeleton.index(parts.spine[-1]), skeleton.index(parts.head)
            above = [j for j in skeleton.ancestors(head) if j > chest]
            bottom = above.index(skeleton.index(parts.neck))
            for k, joint in enumerate(above[: bottom + 1][::-1]):
                self._add(f"neck{k}", joint, self.body)
        self._add("head", parts.head, self.body)

    def _limb(self, segment: str, joint: str | int, below: str | int, drawn: np.ndarray) -> None:
        """A segment whose bone goes to `below`, and in a T-pose along `drawn` of the body."""
        joint = joint if isinstance(joint, int) else self.skeleton.index(joint)
        below = below if isinstance(below, int) else self.skeleton.index(below)
        self._add(segment, joint, self._aligned(self.body, drawn, self._way(joint, below)))
        self.bones[segment] = (below, drawn)

    def _way(self, joint: int, below: int) -> np.ndarray:
        bone = self.places[below] - self.places[joint]
        return bone / max(np.linalg.norm(bone), 1e-9)

    def _aligned(self, turn: np.ndarray, drawn: np.ndarray, way: np.ndarray) -> np.ndarray:
        if np.linalg.norm(way) < 0.5:
            return turn
        return multiply_quaternions(shortest_arc(rotate_vectors(turn, drawn), way), turn)

    def _arm(self, side: str, outward: np.ndarray) -> None:
        arm = self.parts.arms[side]
        if arm.clavicle is not None:
            self._add(f"{side}_clavicle", arm.clavicle, self.body)
        self._limb(f"{side}_shoulder", arm.shoulder, arm.elbow, outward)
        if arm.wrist is None:
            elbow = self.skeleton.index(arm.elbow)
            end = self._end(elbow)
            if np.linalg.norm(end) > _NO_END * self.scale:
                back = invert_quaternions(self.turned[elbow])
                self.hands[side] = (elbow, rotate_vectors(back, end))
            way = end / max(np.linalg.norm(end), 1e-9)
            self._add(f"{side}_elbow", arm.elbow, self._aligned(self.body, outward, way))
            return
        self._limb(f"{side}_elbow", arm.elbow, arm.wrist, outward)
        self._hand(side, arm.wrist, outward)

    def _hand(self, side: str, name: str, outward: np.ndarray) -> None:
        wrist = self.skeleton.index(name)
        self.hands[side] = (wrist, np.zeros(3))
        chains = finger_chains(self.skeleton, self.parts, side)
        knuckles = [self.places[c[0]] for kind, c in chains.items() if kind != "thumb"]
        forearm = self.frames[f"{side}_elbow"]
        hand = None
        if len(knuckles) >= 2:
            way = np.mean(knuckles, axis=0) - self.places[wrist]
            thumbward = knuckles[0] - knuckles[-1]
            if min(np.linalg.norm(way), np.linalg.norm(thumbward)) > _NO_WAY * self.scale:
                # Fingers go outward and the thumb's side forward in a T-pose, the palm down.
                palm = np.cross(thumbward, way * outward[0])
                hand = frame(palm, way * outward[0])
        if hand is None:
            end = self._end(wrist)
            hand = self._aligned(forearm, outward, end / max(np.linalg.norm(end), 1e-9))
        self._add(f"{side}_wrist", wrist, hand)
        for kind, chain in chains.items():
            for k, joint in enumerate(chain):
                below = self.skeleton.children(joint)
                if len(below) == 1:
                    turn = self._aligned(hand, outward, self._way(joint, below[0]))
                    self._add(f"{side}_{kind}{k}", joint, turn)
                    self.bones[f"{side}_{kind}{k}"] = (below[0], outward)

    def _end(self, joint: int) -> np.ndarray:
        """(3,) from a joint to the end of what hangs on it, in the world."""
        sites = self.ends.get(self.skeleton.names[joint], ())
        ends = [rotate_vectors(self.turned[joint], site) for site in sites]
        ends += [self.places[j] - self.places[joint] for j in self.skeleton.children(joint)]
        return max(ends, key=np.linalg.norm, default=np.zeros(3))

    def _leg(self, side: str) -> None:
        leg = self.parts.legs[side]
        self._limb(f"{side}_hip", leg.hip, leg.knee, -UP)
        self._limb(f"{side}_knee", leg.knee, leg.ankle, -UP)
        ankle = self.skeleton.index(leg.ankle)
        if leg.toe is not None:
            toe = self.skeleton.index(leg.toe)
            self.toes[side] = (toe, np.zeros(3))
            bone = self.places[toe] - self.places[ankle]
        else:
            bone = self._end(ankle)
            if np.linalg.norm(bone) > _NO_END * self.scale:
                back = invert_quaternions(self.turned[ankle])
                self.toes[side] = (ankle, rotate_vectors(back, bone))
        level = self._level(bone)
        foot = self._pitched(level, bone)
        self._add(f"{side}_ankle", ankle, foot)
        if leg.toe is not None:
            self._add(f"{side}_toe", toe, level)

    def _level(self, bone: np.ndarray) -> np.ndarray:
        """Frame of a level foot that points where its bone does, seen from above."""
        up = rotate_vectors(self.body, UP)
        ahead = bone - (bone @ up) * up
        if np.linalg.norm(ahead) < 0.1 * np.linalg.norm(bone) + 1e-9:
            ahead = rotate_vectors(self.body, FORWARD)
        return frame(up, np.cross(up, ahead))

    def _pitched(self, level: np.ndarray, bone: np.ndarray) -> np.ndarray:
        """Frame of the foot in the pose, which may have it drawn level or pointing down."""
        _, y, z = rotate_vectors(invert_quaternions(level), bone)
        pitch = np.arctan2(-y, np.abs(z))
        if _DRAWN_LEVEL <= pitch <= _STEEP or np.linalg.norm(bone) < _NO_WAY * self.scale:
            return level
        # The pose has it lifted (or lowered) by so much against a foot that stands.
        lift = (_USUAL_PITCH - pitch) / 2
        about_x = np.array([-np.sin(lift), 0.0, 0.0, np.cos(lift)])
        return multiply_quaternions(level, about_x)
