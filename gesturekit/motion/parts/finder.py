"""Identification of body parts: by joint names first, by the shape of the rig otherwise.

Left and right come first: a joint is on the left if its name contains a mark of the left side
("Left", "l_", ".L", a leading "L", ...) and the name with the mark of the right side exists. Then
elbows and knees are found by name, because their names are the least ambiguous ("RightShoulder" is
a clavicle in one file and an upper arm in the next), and all other parts by their position in the
tree. Limbs without informative names are identified by the shape of the rig (`limbs`). A rig
has no legs if names and the user identify none, and no chain on its trunk is long enough for one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.parts.limbs import SIDES, Limbs, reaches
from gesturekit.motion.skeleton import Skeleton
from gesturekit.wording import listed

_LEFT = (
    re.compile("left", re.IGNORECASE),
    # An "l" at the beginning of a word (start, after a sign or digit, or a capital after a
    # lower-case letter): "L_Hip", "b_l_arm", "upper_arm.L", "HandL", "lfemur".
    re.compile(r"(?<![A-Za-z])[lL]|(?<=[a-z])L(?![a-z])"),
)
_SIDE_LETTER = re.compile(r"(?<![A-Za-z])[lLrR](?![a-z])|(?<=[a-z])[LR](?![a-z])")
"""The same for either side, but only as a separate letter: "lfemur" alone has no side."""


def named_pairs(skeleton: Skeleton) -> tuple[tuple[str, str], ...]:
    """Return (left, right) names of joints that differ only by the side, in order."""
    pairs, names = dict[str, str](), set(skeleton.names)
    for name in skeleton.names:
        for match in (match for pattern in _LEFT for match in pattern.finditer(name)):
            right = {"left": "right", "LEFT": "RIGHT", "l": "r", "L": "R"}.get(match[0], "Right")
            other = name[: match.start()] + right + name[match.end() :]
            if other in names:
                pairs.setdefault(name, other)
    return tuple(pairs.items())


def named_side(name: str) -> str:
    """Return the side in a single name, "left" or "right"; "" if it has none."""
    sides = {side for side in SIDES if side in name.lower()}
    if not sides:
        letters = (match[0].lower() for match in _SIDE_LETTER.finditer(name))
        sides = {SIDES["lr".index(letter)] for letter in letters}
    return sides.pop() if len(sides) == 1 else ""


def bare_name(name: str, side: str) -> str:
    """Return a name in lower case without namespace, side, digits and signs: "forearm"."""
    name = name.rsplit(":", 1)[-1]
    if side and side in name.lower():
        name = re.sub(side, " ", name, flags=re.IGNORECASE)
    elif side:
        letter = side[0]
        marks = rf"(?<![A-Za-z])(?i:{letter})(?![a-z])|(?<=[a-z]){letter.upper()}(?![a-z])"
        name, count = re.subn(marks, " ", name)
        if not count:  # "lfemur", "LHipJoint"
            name = name[1:]
    return re.sub("[^a-z]", "", name.lower())


ARM = ("clavicle", "shoulder", "elbow", "wrist")
LEG = ("hip", "knee", "ankle", "toe")
KNOWN_PARTS = ("head", *(f"{side}_{part}" for side in SIDES for part in (*ARM, *LEG)))
"""Parts that a user can specify."""
_OPTIONAL = ("clavicle", "wrist", "toe")
_LEGS = [f"{side}_{part}" for side in SIDES for part in LEG]

_ELBOW = ("forearm", "lowerarm", "lowarm", "elbow", "radius")
_KNEE = ("knee", "shin", "calf", "tibia", "lowerleg", "lowleg", "leg")
_NOT_KNEE = ("upleg", "upperleg")
_WRIST = ("wrist", "hand", "palm")
_ANKLE = ("ankle", "foot")
_TOE = ("toe", "toes", "toebase", "ball", "foot")
_HEAD = ("head", "face", "skull")
_PELVIS = ("hips", "hip", "pelvis")
_END = ("end", "nub", "tip", "site", "headtop")
_TWIST = ("twist", "roll")
_STUB = 0.5
"""Shortest chain below the chest that may be a leg, as a share of an arm; shorter ones are stubs of
hips, end joints and helpers."""
_MANY_LEGS, _ALIKE = 6, 0.8
"""Number of chains from one joint, each at least this share of a leg's length, that are legs of an
animal with more than two."""


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
    """Joint names by body part.

    Attributes:
        pelvis: joint where the legs meet the spine; without legs, the lowest joint of the trunk.
        spine: joints above the pelvis up to the parent of the arms, in order.
        neck: the lowest joint between spine and head; None if there is none.
        head: None if the rig has none.
        arms: "left" and "right".
        legs: "left" and "right"; empty if the rig has no legs.
        fingers: joints below the wrists, except hands and end joints.
        face: joints below the head (jaw, eyes), except end joints.
        ends: leaves that only mark the end of a bone ("HeadEnd", "LeftToe_End", "Nub").
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


class PartFinder:
    """Limbs, trunk and end joints of one rig, as joint indices.

    Attributes:
        limbs: part ("left_elbow", ...) to joint; None if the rig has none.
        missing: parts that every person has, and that were not found.
        has_legs: False if the rig has arms, and nothing that could be a leg.
        pelvis, spine, neck, head: the trunk; `neck` is all joints between spine and head.
        ends: leaves that only mark the end of a bone.
    """

    def __init__(self, skeleton: Skeleton, unpaired: bool = False) -> None:
        """Find the limbs that names and the user identify.

        Args:
            skeleton: the rig.
            unpaired: a joint without a counterpart has the side in its own name.

        Raises:
            MotionError: the user specifies a part that does not exist.
        """
        for key in skeleton.parts:
            if key not in KNOWN_PARTS:
                known = ", ".join(sorted(KNOWN_PARTS))
                raise MotionError(f"no part is called {key!r}; expected {known}")
        self.skeleton, names = skeleton, skeleton.names
        self.by_hand = {key: skeleton.index(name) for key, name in skeleton.parts.items()}
        sides = {name: named_side(name) for name in names} if unpaired else {}
        for pair in named_pairs(skeleton):
            sides |= dict(zip(pair, SIDES))
        self.side = [sides.get(name, "") for name in names]
        self.bare = [bare_name(name, side) for name, side in zip(names, self.side)]
        self.ends = {
            j
            for j, bare in enumerate(self.bare)
            if bare.endswith(_END) and not skeleton.children(j)
        }
        self.limbs: dict[str, int | None] = {}
        for side in SIDES:
            self._arm(side)
            self._leg(side)
        lacking = [part for part, joint in self.limbs.items() if joint is None]
        self.missing = [part for part in lacking if not part.endswith(_OPTIONAL)]
        self.has_legs = True

    @classmethod
    def complete(cls, skeleton: Skeleton) -> PartFinder:
        """Return all parts of a rig.

        Raises:
            MotionError: parts that cannot be identified, or are implausible.
        """
        finder = cls(skeleton)
        has_arms = set(finder.missing) <= set(_LEGS)
        has_legs = any(finder.limbs[part] is not None for part in _LEGS)
        if has_arms and not has_legs and not finder._possible_legs():
            finder.has_legs, finder.missing = False, []
        guessed = bool(finder.by_hand or finder.missing)
        shape = finder._limbs_by_shape() if finder.missing else None
        for problem in implausible(skeleton, finder.limbs, guessed):
            raise MotionError(problem)
        finder._trunk(shape)
        return finder

    @classmethod
    def partial(cls, skeleton: Skeleton) -> PartFinder:
        """Return the parts that names and the user identify, for a rig that lacks some.

        Limbs that cannot be identified have None for joints. Without evidence `pelvis` and `head`
        are None, and `spine` and `neck` are empty.
        """
        finder = cls(skeleton, unpaired=True)
        for limb in (ARM, LEG):
            for side in SIDES:
                parts = {f"{side}_{part}": finder.limbs[f"{side}_{part}"] for part in limb}
                if any(implausible(skeleton, parts)):
                    finder.limbs |= {part: finder.by_hand.get(part) for part in parts}
        if finder.has_many_legs():
            finder.limbs |= dict.fromkeys(_LEGS)
            finder.missing += ["left_knee", "right_knee"]
        finder._known_trunk()
        return finder

    def limb(self, side: str, parts: Iterable[str]) -> dict[str, Any]:
        """Return the names of a limb's joints by part; None where the rig has no such joint."""
        joints = {part: self.limbs[f"{side}_{part}"] for part in parts}
        names = self.skeleton.names
        return {part: None if j is None else names[j] for part, j in joints.items()}

    def legs(self) -> dict[str, Leg]:
        """Return both legs by side."""
        return {side: Leg(**self.limb(side, LEG)) for side in SIDES}

    def has_many_legs(self) -> bool:
        """Return whether a leg that names identify is one of six or more chains from one joint."""
        skeleton = self.skeleton
        hips = [self.limbs[p] for p in ("left_hip", "right_hip") if p not in self.by_hand]
        for joint in filter(None, hips):
            above = skeleton.parents[joint]
            while above > 0 and len(skeleton.children(above)) == 1:
                joint, above = above, skeleton.parents[above]
            chains = self._reach[list(skeleton.children(above))] >= _ALIKE * self._reach[joint]
            if chains.sum() >= _MANY_LEGS:
                return True
        return False

    def missing_limbs(self) -> str:
        """Return the limbs with missing joints, in words: "arms and left leg"."""
        words = []
        for kind, limb in (("arm", ARM), ("leg", LEG)):
            sides = [s for s in SIDES if {f"{s}_{part}" for part in limb} & set(self.missing)]
            words += [f"{kind}s"] if len(sides) == 2 else [f"{side} {kind}" for side in sides]
        return " and ".join(words)

    def helpers(self) -> set[int]:
        """Return joints that only rotate about their bone."""
        return {j for j, bare in enumerate(self.bare) if bare.endswith(_TWIST)}

    def fingers(self) -> list[int]:
        """Return the joints below the wrists, except hands and end joints."""
        below = {j for wrist in self._both("wrist") for j in self.skeleton.descendants(wrist)}
        return [j for j in sorted(below - self.ends) if not self.bare[j].endswith("hand")]

    def _trunk(self, shape: Limbs | None) -> None:
        """Find pelvis, spine, neck and head from the limbs."""
        chest = self.skeleton.common_ancestor(*self._both("shoulder"))
        if self.has_legs:
            hips = self._both("hip")
            self.pelvis: int | None = self.skeleton.common_ancestor(*hips, chest)
        else:
            self.pelvis = self._lowest_of_trunk(chest)
        self.spine = self._way(self.pelvis, chest)[1:]
        if not self.spine:
            what = "arms and legs both hang" if self.has_legs else "the arms hang"
            pelvis = self.skeleton.names[self.pelvis]
            raise MotionError(f"{what} on {pelvis!r}: the rig has no spine")
        self.head = self._head(chest, shape)
        self.neck = [] if self.head is None else self._way(chest, self.head)[1:-1]
        # 3ds Max hangs arms on the neck.
        if len(self.spine) > 1 and self.bare[chest].endswith("neck"):
            self.neck.insert(0, self.spine.pop())

    def _possible_legs(self) -> list[int]:
        """Return the first joints of chains that are long enough for legs, on a rig with arms.

        Rest poses differ, so that length counts, not direction. A thigh without a knee does
        not count. Chains on the joints below the chest count from `_STUB` of an arm on; on the
        chest itself, where neck and head are too and a spine may lead downwards, if they are longer
        than an arm.
        """
        skeleton, shoulders, elbows = self.skeleton, self._both("shoulder"), self._both("elbow")
        chest = skeleton.common_ancestor(*shoulders)
        trunk = {chest, *skeleton.ancestors(chest)}
        # Forearms are about as long as upper arms, but may lack a wrist.
        arm = sum(bone_length(skeleton, *bone) for bone in zip(shoulders, elbows))
        others = {*elbows, *self._named_heads(), self.by_hand.get("head")}
        legs = []
        for above in trunk:
            for j in set(skeleton.children(above)) - trunk:
                length = self._reach[j] - _STUB * arm
                is_long = length >= 0 if above != chest else length > _STUB * arm
                is_other = above == chest and not others.isdisjoint((j, *skeleton.descendants(j)))
                if is_long and not is_other and skeleton.children(j):
                    legs.append(j)
        return sorted(legs)

    def _named_heads(self) -> list[int]:
        return [j for j, b in enumerate(self.bare) if not self.side[j] and b.endswith(_HEAD)]

    def _lowest_of_trunk(self, chest: int) -> int:
        """Return the pelvis of a rig without legs: by name, or the root."""
        below = self._way(0, chest)[:-1]
        for endings in (_PELVIS, ("root",)):
            named = [j for j in below if self.bare[j].endswith(endings)]
            if named:
                return named[-1]
        return 0

    def _known_trunk(self) -> None:
        """Find the parts of the trunk that the known limbs and the names identify."""
        skeleton, limbs = self.skeleton, self.limbs
        hips = self._both("hip")
        arms = [limbs[f"{side}_clavicle"] or limbs[f"{side}_shoulder"] for side in SIDES]
        hanging = [
            next((above for above in skeleton.ancestors(j) if not self.side[above]), 0)
            for j in arms
            if j is not None
        ]
        self.pelvis = skeleton.common_ancestor(*hips) if len(hips) == 2 else None
        chest = skeleton.common_ancestor(*hanging) if hanging else None
        nearest = min(self._named_heads(), key=lambda j: skeleton.depth[j], default=None)
        self.head = self.by_hand.get("head", nearest)
        self.spine = self._way(self.pelvis, chest)[1:]
        self.neck = self._way(chest, self.head)[1:-1]

    def _arm(self, side: str) -> None:
        of_side = [j for j, own in enumerate(self.side) if own == side]
        elbow = self._find(f"{side}_elbow", of_side, _ELBOW)
        shoulder = self._above(f"{side}_shoulder", elbow, side)
        self._above(f"{side}_clavicle", shoulder, side)
        self._find(f"{side}_wrist", self._below(elbow), _WRIST)

    def _leg(self, side: str) -> None:
        # A "leg" without a joint of its side above it is a thigh.
        of_side = [j for j, own in enumerate(self.side) if own == side]
        below = [j for j in of_side if not set(of_side).isdisjoint(self.skeleton.ancestors(j))]
        shanks = [j for j in below if not self.bare[j].endswith(_NOT_KNEE)]
        knee = self._find(f"{side}_knee", shanks, _KNEE)
        self._above(f"{side}_hip", knee, side)
        ankle = self._find(f"{side}_ankle", self._below(knee), _ANKLE)
        self._find(f"{side}_toe", self._below(ankle), _TOE)

    def _both(self, part: str) -> list[int]:
        """Return the left and the right joint of a part of limbs, as far as they are known."""
        joints = (self.limbs[f"{side}_{part}"] for side in SIDES)
        return [joint for joint in joints if joint is not None]

    @cached_property
    def _reach(self) -> np.ndarray:
        """(J,) metres along bones from each joint's parent to the farthest end below the joint."""
        return np.linalg.norm(self.skeleton.offsets, axis=1) + reaches(self.skeleton)

    def _below(self, joint: int | None) -> Iterable[int]:
        return () if joint is None else self.skeleton.descendants(joint)

    def _find(self, part: str, among: Iterable[int], endings: tuple[str, ...]) -> int | None:
        """Store and return the joint nearest the root whose bare name has one of `endings`."""
        fitting = [j for j in among if self.bare[j].endswith(endings)]
        nearest = min(fitting, key=lambda j: self.skeleton.depth[j], default=None)
        return self._settle(part, nearest)

    def _above(self, part: str, joint: int | None, side: str) -> int | None:
        """Store and return the nearest joint above on the same side, twist helpers skipped.

        If a bone is split into several joints ("upper_arm.L", "upper_arm.L.001"), the first counts.
        """
        bone = None
        for j in () if joint is None else self.skeleton.ancestors(joint):
            is_bone = self.side[j] == side and not self.bare[j].endswith(_TWIST)
            if bone is not None and (not is_bone or self.bare[j] != self.bare[bone]):
                break
            bone = j if is_bone else None
        return self._settle(part, bone)

    def _settle(self, part: str, joint: int | None) -> int | None:
        """Store a part, as specified by hand or else as given, and return its joint."""
        self.limbs[part] = self.by_hand.get(part, joint)
        return self.limbs[part]

    def _limbs_by_shape(self) -> Limbs:
        """Fill in missing limbs from the shape of the rig.

        Raises:
            MotionError: the shape is not clear either, or contradicts the names.
        """
        names = self.skeleton.names
        problem = f"cannot identify the {self.missing_limbs()}"
        first = self.missing[0]
        if all(part.endswith(LEG) for part in self.missing) and (legs := self._possible_legs()):
            problem += f", which may begin at {listed([names[j] for j in legs], 4)}"
        by_hand = (
            f"name what the rig has: --part {first}=JOINT (--rig-part for --rig), or "
            f"`parts: {{{first}: JOINT}}`"
        )
        try:
            shape = Limbs(self.skeleton)
        except MotionError as error:
            raise MotionError(f"{problem} ({error}); {by_hand}") from None
        for part, joint in self.limbs.items():
            if joint is None:
                self.limbs[part] = shape.joints.get(part)
            elif part in shape.joints and shape.joints[part] != joint:
                by_shape = f"{names[shape.joints[part]]!r} by the rig's shape"
                both = f"the {part.replace('_', ' ')} is {by_shape}, {names[joint]!r} by its name"
                raise MotionError(f"{problem}: {both}; {by_hand}")
        self.missing = []
        return shape

    def _head(self, chest: int, shape: Limbs | None) -> int | None:
        """Return the head: specified by hand, or by name, shape or position above the chest."""
        arms = [*self._both("clavicle"), *self._both("shoulder")]
        in_limbs = {*arms, *(below for j in arms for below in self.skeleton.descendants(j))}
        by_hand = self.by_hand.get("head")
        if by_hand is not None:
            if by_hand in in_limbs or chest not in self.skeleton.ancestors(by_hand):
                head, trunk = (self.skeleton.names[joint] for joint in (by_hand, chest))
                raise MotionError(f"{head!r} cannot be the head: it is not attached to {trunk!r}")
            return by_hand
        middle = [
            j
            for j in self.skeleton.descendants(chest)
            if not self.side[j] and not self.bare[j].endswith(_END) and j not in in_limbs
        ]
        named = [j for j in middle if self.bare[j].endswith(_HEAD)]
        if not named and shape is not None:
            return shape.head
        return min(named or middle[-1:], key=lambda j: self.skeleton.depth[j], default=None)

    def _way(self, top: int | None, bottom: int | None) -> list[int]:
        """Return the joints from `top` down to `bottom`, both included; none if not connected."""
        if top is None or bottom is None:
            return []
        way = [bottom, *self.skeleton.ancestors(bottom)]
        return way[: way.index(top) + 1][::-1] if top in way else []


@lru_cache(maxsize=64)  # skeletons never change
def find_parts(skeleton: Skeleton) -> BodyParts:
    """Identify the body parts of a rig, including those specified by hand (`Skeleton.parts`).

    A rig with arms has no legs if nothing on its trunk could be a leg. Chains that could be, and
    are not identified, are an error.

    Raises:
        MotionError: parts that cannot be identified, or are implausible (a knee that is not below
            the hip, a left leg twice as long as the right one, ...). The error says which joint to
            specify by hand.
    """
    finder = PartFinder.complete(skeleton)
    pelvis, head, names = finder.pelvis, finder.head, skeleton.names
    assert pelvis is not None
    below_head = () if head is None else skeleton.descendants(head)
    return BodyParts(
        pelvis=names[pelvis],
        spine=tuple(names[j] for j in finder.spine),
        neck=names[finder.neck[0]] if finder.neck else None,
        head=None if head is None else names[head],
        arms={side: Arm(**finder.limb(side, ARM)) for side in SIDES},
        legs=finder.legs() if finder.has_legs else {},
        fingers=tuple(names[j] for j in finder.fingers()),
        face=tuple(names[j] for j in below_head if j not in finder.ends),
        ends=tuple(names[j] for j in sorted(finder.ends)),
    )


def known_parts(skeleton: Skeleton) -> BodyParts | None:
    """Return `find_parts`, or None if the parts cannot be identified."""
    try:
        return find_parts(skeleton)
    except MotionError:
        return None


def find_legs(skeleton: Skeleton) -> Mapping[str, Leg] | None:
    """Return the "left" and "right" leg of any rig; None without, or if they cannot be identified.

    Unlike `find_parts`, this needs no other body parts, such as two arms or a head.
    """
    if parts := known_parts(skeleton):
        return parts.legs or None
    finder = PartFinder(skeleton)
    limbs = {part: finder.limbs[part] for part in _LEGS}
    if not limbs.keys().isdisjoint(finder.missing) or finder.has_many_legs():
        return None
    return None if any(implausible(skeleton, limbs)) else finder.legs()


def require_legs(skeleton: Skeleton) -> Mapping[str, Leg]:
    """Return `find_legs`, for what cannot be done without legs.

    Raises:
        MotionError: two legs cannot be identified, or the rig has none.
    """
    legs = find_legs(skeleton) or find_parts(skeleton).legs
    if not legs:
        raise MotionError("the rig has no legs")
    return legs


_CHAINS = (("clavicle", "shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "toe"))
_SIDES_DIFFER = 1.6
"""Largest plausible ratio of the lengths of a left and a right limb."""
_BONES_DIFFER = 3.5
"""Largest plausible ratio of thigh and shank, or of upper arm and forearm."""


def implausible(
    skeleton: Skeleton, limbs: Mapping[str, int | None], guessed: bool = False
) -> Iterator[str]:
    """Yield why limbs are not connected, or lack the proportions of a person.

    Args:
        skeleton: the rig.
        limbs: "left_elbow", ... to joint; None if the rig has none.
        guessed: limbs come from shape or from the user, so that left and right are checked too.
    """
    known = {part: joint for part, joint in limbs.items() if joint is not None}
    taken: dict[int, str] = {}
    for part, joint in known.items():
        if joint in taken:
            both = f"{skeleton.names[joint]!r} cannot be both {taken[joint]} and {part}"
            yield f"{both}; name one by hand (parts: {part}: JOINT)"
        taken[joint] = part
    for side in SIDES:
        for chain in _CHAINS:
            names = [f"{side}_{part}" for part in chain if f"{side}_{part}" in known]
            for above, below in pairwise(names):
                if known[above] not in skeleton.ancestors(known[below]):
                    yield _wrong(
                        skeleton, known, below, above, "the one does not hang on the other"
                    )
    for part, joint in known.items():
        for start in ("left_shoulder", "right_shoulder", "left_hip", "right_hip"):
            is_other_side = part.split("_")[0] != start.split("_")[0]
            if is_other_side and known.get(start) in skeleton.ancestors(joint):
                yield _wrong(skeleton, known, part, start, "the one hangs on the other")
    yield from _wrong_lengths(skeleton, known)
    if guessed and "left_hip" in known:
        yield from _wrong_sides(skeleton, known)


def _wrong_lengths(skeleton: Skeleton, known: Mapping[str, int]) -> Iterator[str]:
    """Yield implausible bone lengths."""
    for chain, name in zip((_CHAINS[0][1:], _CHAINS[1][:3]), ("arm", "leg")):
        whole = {}
        for side in SIDES:
            parts = [f"{side}_{part}" for part in chain if f"{side}_{part}" in known]
            joints = [known[part] for part in parts]
            bones = [bone_length(skeleton, *bone) for bone in pairwise(joints)]
            whole[side] = sum(bones)
            if len(bones) == 2 and 0 < min(bones) < max(bones) / _BONES_DIFFER:
                reason = f"bones of {bones[0]:.2f} and {bones[1]:.2f} m"
                yield _wrong(skeleton, known, parts[1], parts[0], reason)
        if min(whole.values()) > 0 and max(whole.values()) > _SIDES_DIFFER * min(whole.values()):
            long = f"{whole['left']:.2f} m long, the right one {whole['right']:.2f} m"
            how = f"name its joints by hand (parts: left_{chain[1]}: JOINT, ...)"
            yield f"the left {name} would be {long}; {how}"


def _wrong_sides(skeleton: Skeleton, known: Mapping[str, int]) -> Iterator[str]:
    """Yield the left hip if the toes of a rig that stands at rest contradict left and right."""
    at = {part: skeleton.rest_positions[joint] for part, joint in known.items()}
    hips = at["left_hip"] - at["right_hip"]
    trunk = at["left_shoulder"] + at["right_shoulder"] - at["left_hip"] - at["right_hip"]
    legs = sum(at[f"{side}_ankle"] - at[f"{side}_hip"] for side in SIDES)
    stands = -(trunk @ legs) >= 0.7 * np.linalg.norm(trunk) * np.linalg.norm(legs)
    ahead = np.cross(hips, trunk)
    toes = [at[f"{s}_toe"] - at[f"{s}_ankle"] for s in SIDES if f"{s}_toe" in at]
    back = [toe @ ahead < -0.3 * np.linalg.norm(toe) * np.linalg.norm(ahead) for toe in toes]
    if stands and back and all(back):
        hip = skeleton.names[known["left_hip"]]
        yield f"with {hip!r} as left hip the toes point backwards: sides exchanged?"


def bone_length(skeleton: Skeleton, above: int, below: int) -> float:
    """Return metres along the bones from a joint to one of its descendants."""
    chain = [below, *skeleton.ancestors(below)]
    return float(np.linalg.norm(skeleton.offsets[chain[: chain.index(above)]], axis=1).sum())


def _wrong(skeleton: Skeleton, known: Mapping[str, int], a: str, b: str, reason: str) -> str:
    return (
        f"{skeleton.names[known[a]]!r} cannot be the {a.replace('_', ' ')} with "
        f"{skeleton.names[known[b]]!r} as the {b.replace('_', ' ')}: {reason}; "
        f"name them by hand (parts: {a}: JOINT, ...)"
    )
