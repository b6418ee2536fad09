"""Identification of body parts: by joint names first, by the shape of the rig otherwise.

Left and right come first: a joint is on the left if its name contains a mark of the left side
("Left", "l_", ".L", a leading "L", ...) and the name with the mark of the right side exists. Then
elbows and knees are found by name, because their names are the least ambiguous ("RightShoulder" is
a clavicle in one file and an upper arm in the next), and all other parts by their position in the
tree. Limbs without informative names are identified by the shape of the rig (`limbs`). A rig
has no legs if names and the user identify none, and no chain on its trunk is long enough for one.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.parts.limbs import (
    SIDES,
    Limbs,
    bare_name,
    bone_length,
    check_limbs,
    find_limbs,
    named_pairs,
    named_side,
)
from gesturekit.motion.skeleton import Skeleton
from gesturekit.wording import listed

ARM = ("clavicle", "shoulder", "elbow", "wrist")
LEG = ("hip", "knee", "ankle", "toe")
KNOWN_PARTS = ("head", *(f"{side}_{part}" for side in SIDES for part in (*ARM, *LEG)))
"""Parts that a user can specify."""
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


class PartFinder:
    """Limbs, trunk and end joints of one rig, as joint indices.

    Attributes:
        limbs: part ("left_elbow", ...) to joint; None if the rig has none.
        missing: parts that every person has, and that were not found.
        has_legs: False if the rig has arms, and nothing that could be a leg.
        pelvis, spine, neck, head: the trunk; `neck` is all joints between spine and head.
        ends: leaves that only mark the end of a bone.
    """

    def __init__(self, skeleton: Skeleton) -> None:
        """Read side and bone of each joint from its name, and the parts specified by hand."""
        for key in skeleton.parts:
            if key not in KNOWN_PARTS:
                known = ", ".join(sorted(KNOWN_PARTS))
                raise MotionError(f"no part is called {key!r}; expected {known}")
        self.skeleton = skeleton
        self.by_hand = {key: skeleton.index(name) for key, name in skeleton.parts.items()}
        self.side = [""] * skeleton.n_joints
        for pair in named_pairs(skeleton):
            for side, name in zip(SIDES, pair):
                self.side[skeleton.index(name)] = side
        self.bare = [bare_name(name, side) for name, side in zip(skeleton.names, self.side)]
        self.missing: list[str] = []
        self.has_legs = True
        self.limbs: dict[str, int | None] = {}
        self.ends = {
            j
            for j in range(skeleton.n_joints)
            if skeleton.is_leaf(j) and self.bare[j].endswith(_END)
        }

    @classmethod
    def complete(cls, skeleton: Skeleton) -> PartFinder:
        """Return all parts of a rig.

        Raises:
            MotionError: parts that cannot be identified, or are implausible.
        """
        finder = cls(skeleton)
        for side in SIDES:
            finder._arm(side)
            finder._leg(side)
        finder.has_legs = not finder._is_legless()
        if not finder.has_legs:
            finder.missing.clear()
        guessed = bool(finder.by_hand or finder.missing)
        shape = finder._limbs_by_shape() if finder.missing else None
        check_limbs(skeleton, finder.limbs, guessed)
        finder._trunk(shape)
        return finder

    @classmethod
    def of_legs(cls, skeleton: Skeleton) -> PartFinder | None:
        """Return both legs, by name or by hand, of a rig whose other parts cannot be identified."""
        finder = cls(skeleton)
        for side in SIDES:
            finder._leg(side)
        if finder.missing or finder.has_many_legs():
            return None
        try:
            check_limbs(skeleton, finder.limbs, guessed=False)
        except MotionError:
            return None
        return finder

    @classmethod
    def partial(cls, skeleton: Skeleton) -> PartFinder:
        """Return the parts that names and the user identify, for a rig that lacks some.

        Limbs that cannot be identified have None for joints. Without evidence `pelvis` and `head`
        are None, and `spine` and `neck` are empty.
        """
        finder = cls(skeleton)
        # A limb without a counterpart has no pair of names, so its side comes from its own name.
        for j, name in enumerate(skeleton.names):
            if not finder.side[j] and (side := named_side(name)):
                finder.side[j], finder.bare[j] = side, bare_name(name, side)
        for side in SIDES:
            finder._arm(side)
            finder._leg(side)
            for limb in (ARM, LEG):
                parts = {f"{side}_{part}": finder.limbs[f"{side}_{part}"] for part in limb}
                try:
                    check_limbs(skeleton, parts, guessed=False)
                except MotionError:
                    finder.limbs |= {p: finder.by_hand.get(p) for p in parts}
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

    def has_many_legs(self) -> bool:
        """Return whether a leg that names identify is one of six or more chains from one joint."""
        skeleton = self.skeleton
        hips = [self.limbs[p] for p in ("left_hip", "right_hip") if p not in self.by_hand]
        for joint in filter(None, hips):
            above = skeleton.parents[joint]
            while above > 0 and len(skeleton.children(above)) == 1:
                joint, above = above, skeleton.parents[above]
            least = _ALIKE * _reach(skeleton, joint)
            chains = [j for j in skeleton.children(above) if _reach(skeleton, j) >= least]
            if len(chains) >= _MANY_LEGS:
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
        wrists = [self.limbs[f"{side}_wrist"] for side in SIDES]
        below = {j for w in wrists if w is not None for j in self.skeleton.descendants(w)}
        return [j for j in sorted(below - self.ends) if not self.bare[j].endswith("hand")]

    def _trunk(self, shape: Limbs | None) -> None:
        """Find pelvis, spine, neck and head from the limbs."""
        name = self.skeleton.names
        chest = self._meeting(self._joint("left_shoulder"), self._joint("right_shoulder"))
        if self.has_legs:
            pelvis = self._meeting(self._joint("left_hip"), self._joint("right_hip"))
            self.pelvis: int | None = self._meeting(pelvis, chest)
        else:
            self.pelvis = self._lowest_of_trunk(chest)
        self.spine = [j for j in self._way_down(self.pelvis, chest) if j != self.pelvis]
        if not self.spine:
            what = "arms and legs both hang" if self.has_legs else "the arms hang"
            raise MotionError(f"{what} on {name[self.pelvis]!r}: the rig has no spine")
        self.head = self._head(chest, shape)
        self.neck = [] if self.head is None else self._way_down(chest, self.head)[1:-1]
        # 3ds Max hangs arms on the neck.
        if len(self.spine) > 1 and self.bare[chest].endswith("neck"):
            self.neck.insert(0, self.spine.pop())

    def _is_legless(self) -> bool:
        """Return whether the rig has both arms, and nothing that could be a leg."""
        known = set(self.missing) <= set(_LEGS) and all(self.limbs[p] is None for p in _LEGS)
        return known and not self._possible_legs()

    def _possible_legs(self) -> list[int]:
        """Return the first joints of chains that are long enough for legs, on a rig with arms.

        Rest poses differ, so that length counts, not direction. A thigh without a knee does
        not count. Chains on the joints below the chest count from `_STUB` of an arm on; on the
        chest itself, where neck and head are too and a spine may lead downwards, if they are longer
        than an arm.
        """
        skeleton = self.skeleton
        shoulders = [self._joint(f"{side}_shoulder") for side in SIDES]
        elbows = [self._joint(f"{side}_elbow") for side in SIDES]
        chest = self._meeting(*shoulders)
        trunk = {chest, *skeleton.ancestors(chest)}
        # Forearms are about as long as upper arms, but may lack a wrist.
        arm = sum(bone_length(skeleton, *bone) for bone in zip(shoulders, elbows))
        others = {*elbows, *self._named_heads(), self.by_hand.get("head")}
        legs = []
        for above in trunk:
            for j in set(skeleton.children(above)) - trunk:
                length = _reach(skeleton, j) - _STUB * arm
                is_long = length >= 0 if above != chest else length > _STUB * arm
                is_other = above == chest and not others.isdisjoint((j, *skeleton.descendants(j)))
                if is_long and not is_other and not skeleton.is_leaf(j):
                    legs.append(j)
        return sorted(legs)

    def _named_heads(self) -> list[int]:
        return [j for j, b in enumerate(self.bare) if not self.side[j] and b.endswith(_HEAD)]

    def _lowest_of_trunk(self, chest: int) -> int:
        """Return the pelvis of a rig without legs: by name, or the root."""
        below = self._way_down(0, chest)[:-1]
        for endings in (_PELVIS, ("root",)):
            named = [j for j in below if self.bare[j].endswith(endings)]
            if named:
                return named[-1]
        return 0

    def _known_trunk(self) -> None:
        """Find the parts of the trunk that the known limbs and the names identify."""
        limbs, side = self.limbs, self.side
        hips = [j for s in SIDES if (j := limbs[f"{s}_hip"]) is not None]
        arms = [limbs[f"{s}_clavicle"] or limbs[f"{s}_shoulder"] for s in SIDES]
        hanging = [
            next((above for above in self.skeleton.ancestors(j) if not side[above]), 0)
            for j in arms
            if j is not None
        ]
        pelvis = self._meeting(*hips) if len(hips) == 2 else None
        chest = self._meeting(hanging[0], hanging[-1]) if hanging else None
        way = [] if pelvis is None or chest is None else self._way_down(pelvis, chest)
        self.pelvis, self.spine, self.neck = pelvis, way[1:], []
        nearest = min(self._named_heads(), key=lambda j: self.skeleton.depth[j], default=None)
        self.head = self.by_hand.get("head", nearest)
        if self.head is not None and chest is not None:
            self.neck = self._way_down(chest, self.head)[1:-1]

    def _arm(self, side: str) -> None:
        of_side = [j for j, s in enumerate(self.side) if s == side]
        elbow = self._find(f"{side}_elbow", of_side, _ELBOW)
        shoulder = self._above(f"{side}_shoulder", elbow, side)
        self._above(f"{side}_clavicle", shoulder, side, required=False)
        self._find(f"{side}_wrist", self._below(elbow), _WRIST, required=False)

    def _leg(self, side: str) -> None:
        # A "leg" without a joint of its side above it is a thigh.
        below = set[int]()
        for j, above in enumerate(self.skeleton.parents):
            if above in below or (above >= 0 and self.side[above] == side):
                below.add(j)
        below_hip = [j for j in sorted(below) if self.side[j] == side]
        knee = self._find(f"{side}_knee", below_hip, _KNEE, but=_NOT_KNEE)
        self._above(f"{side}_hip", knee, side)
        ankle = self._find(f"{side}_ankle", self._below(knee), _ANKLE)
        self._find(f"{side}_toe", self._below(ankle), _TOE, required=False)

    def _joint(self, part: str) -> int:
        """Return a joint of a limb that `check_limbs` requires."""
        joint = self.limbs[part]
        assert joint is not None
        return joint

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
        """Store and return the joint nearest the root whose bare name has one of `endings`."""
        fitting = [
            j for j in among if self.bare[j].endswith(endings) and not self.bare[j].endswith(but)
        ]
        nearest = min(fitting, key=lambda j: self.skeleton.depth[j], default=None)
        return self._settle(part, nearest, required)

    def _above(self, part: str, joint: int | None, side: str, required: bool = True) -> int | None:
        """Store and return the nearest joint above on the same side, twist helpers skipped.

        If a bone is split into several joints ("upper_arm.L", "upper_arm.L.001"), the first counts.
        """
        bone = None
        for j in () if joint is None else self.skeleton.ancestors(joint):
            is_bone = self.side[j] == side and not self.bare[j].endswith(_TWIST)
            if bone is not None and (not is_bone or self.bare[j] != self.bare[bone]):
                break
            bone = j if is_bone else None
        return self._settle(part, bone, required)

    def _settle(self, part: str, joint: int | None, required: bool) -> int | None:
        """Store a part, as specified by hand or else as given, and return its joint."""
        joint = self.by_hand.get(part, joint)
        if joint is None and required:
            self.missing.append(part)
        self.limbs[part] = joint
        return joint

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
            shape = find_limbs(self.skeleton)
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
        starts = [self.limbs[f"{side}_{part}"] for side in SIDES for part in ARM[:2]]
        arms = [joint for joint in starts if joint is not None]
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

    def _meeting(self, a: int, b: int) -> int:
        """Return the lowest common ancestor of two joints, themselves included."""
        of_a = {a, *self.skeleton.ancestors(a)}
        return next(j for j in (b, *self.skeleton.ancestors(b)) if j in of_a)

    def _way_down(self, top: int, bottom: int) -> list[int]:
        """Return the joints from `top` down to `bottom`, both included; none if not connected."""
        way = [bottom, *self.skeleton.ancestors(bottom)]
        return way[: way.index(top) + 1][::-1] if top in way else []


def _reach(skeleton: Skeleton, joint: int) -> float:
    """Return metres along bones from a joint's parent to the farthest end below the joint."""
    bones = np.linalg.norm(skeleton.offsets, axis=1)
    away = {joint: float(bones[joint])}
    farthest = away[joint]
    for j in (joint, *skeleton.descendants(joint)):  # parents come before their children
        away.setdefault(j, away.get(skeleton.parents[j], 0.0) + float(bones[j]))
        ends = map(np.linalg.norm, skeleton.end_sites.get(skeleton.names[j], ()))
        farthest = max(farthest, away[j] + float(max(ends, default=0.0)))
    return farthest
