"""Which joint is which part of the body, told from names and from what hangs on what.

Left and right are found first: a joint whose name holds a mark of the left side ("Left", "l_",
".L", a leading "L", ...) and whose counterpart with the mark of the right side exists. Then the
elbows and knees are found by name, as their names are the least ambiguous ("RightShoulder" is a
collar bone in one file and an upper arm in the next), and all else by its place in the tree.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.skeleton import Skeleton

SIDES = ("left", "right")

_ELBOW = ("forearm", "lowerarm", "lowarm", "elbow", "radius")
_KNEE = ("knee", "shin", "calf", "tibia", "lowerleg", "lowleg", "leg")
_NOT_KNEE = ("upleg", "upperleg")
_WRIST = ("wrist", "hand")
_ANKLE = ("ankle", "foot")
_TOE = ("toe", "toes", "toebase", "ball", "foot")
_HEAD = ("head", "face")
_END = ("end", "nub", "tip", "site", "headtop")
_TWIST = ("twist", "roll")


@dataclass(frozen=True)
class Arm:
    """Joint names of one arm; None where the rig has no such joint."""

    clavicle: str | None
    shoulder: str
    elbow: str
    wrist: str | None


@dataclass(frozen=True)
class Leg:
    """Joint names of one leg; None where the rig has no such joint."""

    hip: str
    knee: str
    ankle: str
    toe: str | None


@dataclass(frozen=True)
class BodyParts:
    """Joint names by part of the body.

    Attributes:
        pelvis: where the legs meet the spine.
        spine: joints above the pelvis up to the one that the arms hang on, in order.
        neck: the lowest joint between spine and head; None where the head sits on the spine.
        head: None where the rig has none.
        arms: "left" and "right".
        legs: "left" and "right".
        fingers: all that hangs on the wrists, but for hands and end joints.
        face: all that hangs on the head (jaw, eyes), but for end joints.
        ends: leaves that only mark where a bone stops ("HeadEnd", "LeftToe_End", "Nub").
    """

    pelvis: str
    spine: tuple[str, ...]
    neck: str | None
    head: str | None
    arms: Mapping[str, Arm]
    legs: Mapping[str, Leg]
    fingers: tuple[str, ...]
    face: tuple[str, ...]
    ends: tuple[str, ...]


def left_right_pairs(skeleton: Skeleton) -> tuple[tuple[str, str], ...]:
    """(left, right) names of the joints that are each other's mirror image, left joints in order.

    A joint without a counterpart lies in the middle of the body.
    """
    pairs = []
    names = set(skeleton.names)
    for name in skeleton.names:
        for other in _right_names(name):
            if other in names and other != name:
                pairs.append((name, other))
                break
    return tuple(pairs)


def find_parts(skeleton: Skeleton, overrides: Mapping[str, str] | None = None) -> BodyParts:
    """Name the parts of a rig.

    Args:
        skeleton: the rig.
        overrides: joints named by hand, such as {"left_elbow": "Joint12"}. Keys are `head` and
            left_ or right_ with clavicle, shoulder, elbow, wrist, hip, knee, ankle or toe.

    Raises:
        MotionError: parts that cannot be told, with what to name by hand.
    """
    return _Finder(skeleton, overrides or {}).parts()


def body_joints(skeleton: Skeleton) -> tuple[str, ...]:
    """Names of all joints but fingers, face and end joints, in the skeleton's order."""
    parts = find_parts(skeleton)
    left_out = {*parts.fingers, *parts.face, *parts.ends}
    return tuple(name for name in skeleton.names if name not in left_out)


def upper_body(skeleton: Skeleton) -> tuple[str, ...]:
    """Names of the first joint of the spine and all below it: spine, neck, head, arms, hands."""
    first = skeleton.index(find_parts(skeleton).spine[0])
    return tuple(skeleton.names[j] for j in (first, *skeleton.descendants(first)))


def leg_length(skeleton: Skeleton) -> float:
    """Length of thigh and shank, metres, mean of both sides."""
    legs = find_parts(skeleton).legs.values()
    bones = [skeleton.index(name) for leg in legs for name in (leg.knee, leg.ankle)]
    return float(np.linalg.norm(skeleton.offsets[bones], axis=1).sum() / 2)


def arm_joints(skeleton: Skeleton) -> tuple[str, str, str, str]:
    """Names of left shoulder, left elbow, right shoulder, right elbow (upper and lower arms)."""
    arms = find_parts(skeleton).arms
    left, right = arms["left"], arms["right"]
    return left.shoulder, left.elbow, right.shoulder, right.elbow


class _Finder:
    def __init__(self, skeleton: Skeleton, overrides: Mapping[str, str]) -> None:
        self.skeleton = skeleton
        self.overrides = {key: skeleton.index(name) for key, name in overrides.items()}
        known = {"head"} | {
            f"{side}_{part}"
            for side in SIDES
            for part in (*Arm.__dataclass_fields__, *Leg.__dataclass_fields__)
        }
        for key in overrides:
            if key not in known:
                raise MotionError(f"no part is called {key!r}; expected {', '.join(sorted(known))}")
        self.side = [""] * skeleton.n_joints
        for pair in left_right_pairs(skeleton):
            for side, name in zip(SIDES, pair):
                self.side[skeleton.index(name)] = side
        self.bare = [_bare(name, side) for name, side in zip(skeleton.names, self.side)]
        self.missing: list[str] = []

    def parts(self) -> BodyParts:
        joints: dict[str, dict[str, int | None]] = {}
        for side in SIDES:
            joints[side] = self._arm(side) | self._leg(side)
        if self.missing:
            raise MotionError(
                f"cannot tell {', '.join(self.missing)} from the joint names "
                f"{', '.join(self.skeleton.names[:8])}, ...; name them by hand: "
                f"find_parts(skeleton, overrides={{{self.missing[0]!r}: 'joint name', ...}})"
            )
        chest = self._meeting(joints["left"]["shoulder"], joints["right"]["shoulder"])
        pelvis = self._meeting(joints["left"]["hip"], joints["right"]["hip"])
        pelvis = self._meeting(pelvis, chest)
        spine = [j for j in self._way_down(pelvis, chest) if j != pelvis]
        if not spine:
            raise MotionError(
                f"arms and legs both hang on {self.skeleton.names[pelvis]!r}: the rig has no spine"
            )
        head = self._head(chest)
        above = [] if head is None else self._way_down(chest, head)[1:-1]
        if len(spine) > 1 and self.bare[chest].endswith("neck"):  # 3ds Max hangs arms on the neck
            above.insert(0, spine.pop())
        neck = above[0] if above else None
        ends = self._ends()
        wrists = [joints[side]["wrist"] for side in SIDES]
        below_wrists = {j for w in wrists if w is not None for j in self.skeleton.descendants(w)}
        below_head = set() if head is None else set(self.skeleton.descendants(head))
        name = self._name
        return BodyParts(
            pelvis=name(pelvis),
            spine=tuple(name(j) for j in spine),
            neck=name(neck),
            head=name(head),
            arms={
                s: Arm(**{k: name(joints[s][k]) for k in Arm.__dataclass_fields__}) for s in SIDES
            },
            legs={
                s: Leg(**{k: name(joints[s][k]) for k in Leg.__dataclass_fields__}) for s in SIDES
            },
            fingers=tuple(
                name(j) for j in sorted(below_wrists - ends) if not self.bare[j].endswith("hand")
            ),
            face=tuple(name(j) for j in sorted(below_head - ends)),
            ends=tuple(name(j) for j in sorted(ends)),
        )

    def _name(self, joint: int | None) -> str | None:
        return None if joint is None else self.skeleton.names[joint]

    def _arm(self, side: str) -> dict[str, int | None]:
        of_side = [j for j, s in enumerate(self.side) if s == side]
        elbow = self._find(f"{side}_elbow", of_side, _ELBOW)
        shoulder = self._above(f"{side}_shoulder", elbow, side)
        clavicle = self._above(f"{side}_clavicle", shoulder, side, required=False)
        wrist = self._find(f"{side}_wrist", self._below(elbow), _WRIST, required=False)
        return {"clavicle": clavicle, "shoulder": shoulder, "elbow": elbow, "wrist": wrist}

    def _leg(self, side: str) -> dict[str, int | None]:
        of_side = [j for j, s in enumerate(self.side) if s == side]
        knee = self._find(f"{side}_knee", of_side, _KNEE, but=_NOT_KNEE)
        hip = self._above(f"{side}_hip", knee, side)
        ankle = self._find(f"{side}_ankle", self._below(knee), _ANKLE)
        toe = self._find(f"{side}_toe", self._below(ankle), _TOE, required=False)
        return {"hip": hip, "knee": knee, "ankle": ankle, "toe": toe}

    def _below(self, joint: int | None) -> Iterable[int]:
        return () if joint is None else self.skeleton.descendants(joint)

    def _find(
        self,
        part: str,
        among: Iterable[int],
        endings: tuple[str, ...],
        but: tuple[str, ...] = (),
        required: bool = True,
    ) -> int | None:
        """The joint nearest the root whose bare name ends like one of `endings`."""
        if part in self.overrides:
            return self.overrides[part]
        fitting = [
            j for j in among if self.bare[j].endswith(endings) and not self.bare[j].endswith(but)
        ]
        if fitting:
            return min(fitting, key=lambda j: self.skeleton.depth[j])
        if required:
            self.missing.append(part)
        return None

    def _above(self, part: str, joint: int | None, side: str, required: bool = True) -> int | None:
        """The nearest joint above of the same side; helpers that only twist a bone do not count."""
        if part in self.overrides:
            return self.overrides[part]
        if joint is not None:
            for above in self.skeleton.ancestors(joint):
                if self.side[above] == side and not self.bare[above].endswith(_TWIST):
                    return above
        if required and joint is not None:
            self.missing.append(part)
        return None

    def _head(self, chest: int) -> int | None:
        if "head" in self.overrides:
            return self.overrides["head"]
        middle = [
            j
            for j in self.skeleton.descendants(chest)
            if not self.side[j] and not self.bare[j].endswith(_END)
        ]
        named = [j for j in middle if self.bare[j].endswith(_HEAD)]
        return min(named or middle[-1:], key=lambda j: self.skeleton.depth[j], default=None)

    def _ends(self) -> set[int]:
        return {
            j
            for j in range(self.skeleton.n_joints)
            if self.skeleton.is_leaf(j) and self.bare[j].endswith(_END)
        }

    def _meeting(self, a: int, b: int) -> int:
        """The lowest joint that both hang on (or are)."""
        of_a = {a, *self.skeleton.ancestors(a)}
        return next(j for j in (b, *self.skeleton.ancestors(b)) if j in of_a)

    def _way_down(self, top: int, bottom: int) -> list[int]:
        """Joints from `top` to `bottom`, both included."""
        way = [bottom, *self.skeleton.ancestors(bottom)]
        return way[: way.index(top) + 1][::-1] if top in way else []


_LEFT_WORD = re.compile("left", re.IGNORECASE)
# An "l" that stands where a word begins (start, after a sign or digit, or a capital after a small
# letter): "L_Hip", "b_l_arm", "upper_arm.L", "HandL", "lfemur".
_LEFT_LETTER = re.compile(r"(?<![A-Za-z])[lL]|(?<=[a-z])L(?![a-z])")


def _right_names(name: str) -> Iterable[str]:
    """What the right counterpart of `name` may be called, if `name` is of the left."""
    for match in _LEFT_WORD.finditer(name):
        right = {"left": "right", "LEFT": "RIGHT"}.get(match[0], "Right")
        yield name[: match.start()] + right + name[match.end() :]
    for match in _LEFT_LETTER.finditer(name):
        right = "R" if match[0] == "L" else "r"
        yield name[: match.start()] + right + name[match.end() :]


def _bare(name: str, side: str) -> str:
    """Small letters of a name without name space, side, digits and signs: "forearm"."""
    name = name.rsplit(":", 1)[-1]
    if side:
        letter = side[0]
        marks = rf"{side}|(?<![A-Za-z])(?i:{letter})(?![a-z])|(?<=[a-z]){letter.upper()}(?![a-z])"
        name, count = re.subn(marks, " ", name, flags=re.IGNORECASE if side in name.lower() else 0)
        if not count:  # "lfemur", "LHipJoint"
            name = name[1:]
    return re.sub("[^a-z]", "", name.lower())
