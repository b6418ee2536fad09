"""Evidence of limbs: joint names, the shape of a rig, and plausible proportions.

A human rig is a trunk with two pairs of limbs: legs at its lower end, arms farther along it, and
the head beyond. The limbs of a pair have equal bone lengths. The two longest bones of each limb are
adjacent: thigh and shank, upper arm and forearm. Feet point forward, and forward and up determine
left. If any of this is not clear, an error is raised, because a wrong guess is worse than none.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.skeleton import Skeleton
from gesturekit.wording import counted

SIDES = ("left", "right")

_LEFT_WORD = re.compile("left", re.IGNORECASE)
# An "l" at the beginning of a word (start, after a sign or digit, or a capital after a lower-case
# letter): "L_Hip", "b_l_arm", "upper_arm.L", "HandL", "lfemur".
_LEFT_LETTER = re.compile(r"(?<![A-Za-z])[lL]|(?<=[a-z])L(?![a-z])")

# The same for either side, but only as a separate letter: "lfemur" alone has no side.
_SIDE_LETTER = re.compile(r"(?<![A-Za-z])[lLrR](?![a-z])|(?<=[a-z])[LR](?![a-z])")


def named_pairs(skeleton: Skeleton) -> tuple[tuple[str, str], ...]:
    """Return (left, right) names of joints that differ only by the side, in order."""
    pairs = []
    names = set(skeleton.names)
    for name in skeleton.names:
        for other in _right_names(name):
            if other in names and other != name:
                pairs.append((name, other))
                break
    return tuple(pairs)


def _right_names(name: str) -> Iterable[str]:
    """Yield possible names of the right counterpart, if `name` is a left joint."""
    for match in _LEFT_WORD.finditer(name):
        right = {"left": "right", "LEFT": "RIGHT"}.get(match[0], "Right")
        yield name[: match.start()] + right + name[match.end() :]
    for match in _LEFT_LETTER.finditer(name):
        right = "R" if match[0] == "L" else "r"
        yield name[: match.start()] + right + name[match.end() :]


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


_ALIKE = 0.15
"""Largest relative difference of left and right bone lengths."""
_LONG = 0.25
"""Shortest limb, as a share of the longest path through the rig."""
_ROUNDING, _POINT, _FORWARD = 0.007, 0.007, 0.035
"""Shares of the rig's reach from its root (1.4 m on an adult): difference allowed between short
bones, length below which an end site is a point, and least length of a foot that points forward."""
_MOST_LIMBS = 32
"""Long limbs of one joint that are compared with one another; more are no person's."""
_CLEARLY = 1.3
"""Least ratio of a limb's two long bones to all its others, and square root of the largest ratio
between the two."""


@dataclass(frozen=True)
class Limbs:
    """Limbs found by shape.

    Attributes:
        joints: part ("left_elbow", ...) to joint.
        head: None if there is none.
        pairs: joints of the limbs that are mirror images.
    """

    joints: dict[str, int]
    head: int | None
    pairs: tuple[tuple[int, int], ...]


def _rest_places(skeleton: Skeleton) -> np.ndarray:
    """(J, 3) positions of the joints at rest, the root at the origin."""
    places = skeleton.offsets.copy()
    for j, above in enumerate(skeleton.parents):
        places[j] = places[j] + places[above] if above >= 0 else 0.0
    return places


def find_limbs(skeleton: Skeleton) -> Limbs:
    """Find arms and legs by shape.

    Raises:
        MotionError: the shape is not clearly that of a person at rest; the message says why.
    """
    return _Shape(skeleton).limbs()


class _Shape:
    """Rest positions, bone lengths and reach of a rig's joints."""

    def __init__(self, skeleton: Skeleton) -> None:
        self.skeleton = skeleton
        self.bone = np.linalg.norm(skeleton.offsets, axis=1)
        self.place = _rest_places(skeleton)
        # Longest path from each joint down to a leaf, end sites included.
        sites = skeleton.end_sites
        self.tip = np.array(
            [max(map(np.linalg.norm, sites.get(name, ())), default=0.0) for name in skeleton.names]
        )
        self.reach = self.tip.copy()
        for j in reversed(range(1, skeleton.n_joints)):
            above = skeleton.parents[j]
            self.reach[above] = max(self.reach[above], self.bone[j] + self.reach[j])

    def limbs(self) -> Limbs:
        """Return the limbs; see `find_limbs`."""
        forks = self._pairs_of_limbs()
        if len(forks) != 2:
            raise MotionError(f"{counted(len(forks), 'pair')} of limbs of equal length, not 2")
        (pelvis, legs), (chest, arms) = forks
        if pelvis not in self.skeleton.ancestors(chest):
            raise MotionError("the two pairs of limbs are not attached to one trunk")
        leg_chains = [self._chain(joint) for joint in legs]
        arm_chains = [self._chain(joint) for joint in arms]
        hips, arm_starts = (self._two_bones(chains) for chains in (leg_chains, arm_chains))
        if any(len(chain) < hips + 3 for chain in leg_chains):
            raise MotionError("its legs have no ankles")
        joints: dict[str, int] = {}
        ankles = [chain[hips + 2] for chain in leg_chains]
        up = self.place[chest] - self.place[ankles].mean(axis=0)
        trunk = self.place[chest] - self.place[pelvis]
        if up @ trunk < 0.7 * np.linalg.norm(up) * np.linalg.norm(trunk):
            raise MotionError("at rest its legs do not lie opposite its trunk")
        left = self._left(up, leg_chains, hips)
        for chains, start, parts in (
            (leg_chains, hips, ("hip", "knee", "ankle", "toe")),
            (arm_chains, arm_starts, ("shoulder", "elbow", "wrist")),
        ):
            apart = self.place[chains[0][start]] - self.place[chains[1][start]]
            if abs(apart @ left) < 0.5 * np.linalg.norm(apart):
                raise MotionError("its limbs do not lie to its left and right at rest")
            if apart @ left < 0:
                chains.reverse()
            for side, chain in zip(("left", "right"), chains):
                joints |= {f"{side}_{part}": j for part, j in zip(parts, chain[start:])}
                if parts[0] == "shoulder" and start:
                    joints[f"{side}_clavicle"] = chain[start - 1]
        pairs = [
            pair for a, b in (leg_chains, arm_chains) for pair in self._corresponding(a[0], b[0])
        ]
        return Limbs(joints, self._head(chest, arms), tuple(sorted(pairs)))

    def _pairs_of_limbs(self) -> list[tuple[int, tuple[int, int]]]:
        """Return (parent, (limb, limb)) of each pair of long limbs of one shape, from the root."""
        whole = self.reach[0] + max(
            (self.bone[j] + self.reach[j] for j in self.skeleton.children(0)), default=0.0
        )
        forks = []
        for fork in range(self.skeleton.n_joints):
            children = self.skeleton.children(fork)
            long = [j for j in children if self.bone[j] + self.reach[j] > _LONG * whole]
            few = len(long) <= _MOST_LIMBS
            alike = [pair for pair in combinations(long, 2) if self._alike(*pair)] if few else []
            if not few or len(alike) > 1:
                raise MotionError(f"more than two limbs of equal length on {self._name(fork)!r}")
            forks += [(fork, pair) for pair in alike]
        return forks

    def _alike(self, a: int, b: int) -> bool:
        """Return whether two limbs have equal numbers of bones of equal lengths."""
        for left, right in self._corresponding(a, b):
            bones = self.bone[left], self.bone[right]
            if abs(bones[0] - bones[1]) > _ALIKE * max(bones) + _ROUNDING * self.reach[0]:
                return False
            if len(self.skeleton.children(left)) != len(self.skeleton.children(right)):
                return False
        return True

    def _sorted(self, joint: int) -> list[int]:
        """Return the children of a joint, ordered by lengths, which are equal on both sides."""
        children = self.skeleton.children(joint)
        return sorted(children, key=lambda j: (self.reach[j] + self.bone[j], self.bone[j]))

    def _corresponding(self, a: int, b: int) -> Iterator[tuple[int, int]]:
        """Yield the pairs of corresponding joints of two limbs, a joint before those below it."""
        pairs = [(a, b)]
        for pair in pairs:
            yield pair
            pairs += zip(*map(self._sorted, pair))

    def _chain(self, joint: int) -> list[int]:
        """Return the joints of a limb along its longest path."""
        chain = [joint]
        while below := self.skeleton.children(chain[-1]):
            chain.append(max(below, key=lambda j: self.bone[j] + self.reach[j]))
        return chain

    def _two_bones(self, chains: list[list[int]]) -> int:
        """Return the index in the chains of a pair at which the two long bones begin."""
        first = chains[0]
        bones = np.append(self.bone[first[1:]], self.tip[first[-1]])
        if len(bones) < 2:
            raise MotionError(f"the limb at {self._name(first[0])!r} has fewer than two bones")
        start = int((bones[:-1] + bones[1:]).argmax())
        upper, lower = bones[start], bones[start + 1]
        others = np.delete(bones, [start, start + 1])
        if others.size and others.max() * _CLEARLY > min(upper, lower):
            raise MotionError(f"the limb at {self._name(first[0])!r} has no two longest bones")
        if max(upper, lower) > _CLEARLY**2 * min(upper, lower):
            raise MotionError(f"the limb at {self._name(first[0])!r} has one long bone, not two")
        return start

    def _left(self, up: np.ndarray, legs: list[list[int]], hips: int) -> np.ndarray:
        """(3,) unit vector to the left, from the upward direction (3,) and the feet."""
        up = up / np.linalg.norm(up)
        ahead = np.zeros(3)
        for chain in legs:
            ankle = chain[hips + 2]
            ends = [self.place[chain[-1]] - self.place[ankle]]
            for joint in chain[hips + 2 :]:
                sites = self.skeleton.end_sites.get(self._name(joint), ())
                ends += [self.place[joint] + site - self.place[ankle] for site in sites]
            foot = max(ends, key=np.linalg.norm)
            ahead += foot - (foot @ up) * up
        if np.linalg.norm(ahead) < _FORWARD * self.reach[0]:
            raise MotionError("its feet do not show which way is forward")
        return np.cross(up, ahead / np.linalg.norm(ahead))

    def _head(self, chest: int, arms: tuple[int, int]) -> int | None:
        """Return the head: the first joint with several children beyond the arms, or the last one.

        A last joint that only marks the top of the head is skipped; it is farther from the head
        than the head is from the neck.
        """
        beyond = [j for j in self.skeleton.children(chest) if j not in arms]
        if not beyond:
            return None
        chain = self._chain(max(beyond, key=lambda j: self.bone[j] + self.reach[j]))
        for joint in chain:
            if len(self.skeleton.children(joint)) > 1:
                return joint
        marks_top = self.tip[chain[-1]] < _POINT * self.reach[0] and len(chain) > 1
        before = self.bone[chain[-2]] if len(chain) > 1 else 0.0
        return chain[-2] if marks_top and self.bone[chain[-1]] > before else chain[-1]

    def _name(self, joint: int) -> str:
        return self.skeleton.names[joint]


_CHAINS = (("clavicle", "shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "toe"))
_SIDES_DIFFER = 1.6
"""Largest plausible ratio of the lengths of a left and a right limb."""
_BONES_DIFFER = 3.5
"""Largest plausible ratio of thigh and shank, or of upper arm and forearm."""


def check_limbs(skeleton: Skeleton, limbs: Mapping[str, int | None], guessed: bool) -> None:
    """Check that limbs are connected and have the proportions of a person.

    Args:
        skeleton: the rig.
        limbs: "left_elbow", ... to joint; None if the rig has none.
        guessed: limbs come from shape or from the user, so that left and right are checked too.

    Raises:
        MotionError: implausible parts; the message names the joints.
    """
    known = {part: joint for part, joint in limbs.items() if joint is not None}
    taken: dict[int, str] = {}
    for part, joint in known.items():
        if joint in taken:
            both = f"{skeleton.names[joint]!r} cannot be both {taken[joint]} and {part}"
            raise MotionError(f"{both}; name one by hand (parts: {part}: JOINT)")
        taken[joint] = part
    for side in SIDES:
        for chain in _CHAINS:
            names = [f"{side}_{part}" for part in chain if f"{side}_{part}" in known]
            for above, below in zip(names, names[1:]):
                if known[above] not in skeleton.ancestors(known[below]):
                    reason = "the one does not hang on the other"
                    raise _wrong(skeleton, known, below, above, reason)
    for part, joint in known.items():
        for start in ("left_shoulder", "right_shoulder", "left_hip", "right_hip"):
            is_other_side = part.split("_")[0] != start.split("_")[0]
            if is_other_side and known.get(start) in skeleton.ancestors(joint):
                raise _wrong(skeleton, known, part, start, "the one hangs on the other")
    _check_lengths(skeleton, known)
    if guessed:
        _check_sides(skeleton, known)


def _check_lengths(skeleton: Skeleton, known: Mapping[str, int]) -> None:
    """Raise MotionError for implausible bone lengths."""
    for chain, name in zip((_CHAINS[0][1:], _CHAINS[1][:3]), ("arm", "leg")):
        whole = {}
        for side in SIDES:
            parts = [f"{side}_{part}" for part in chain if f"{side}_{part}" in known]
            joints = [known[part] for part in parts]
            bones = [bone_length(skeleton, *bone) for bone in zip(joints, joints[1:])]
            whole[side] = sum(bones)
            if len(bones) == 2 and 0 < min(bones) < max(bones) / _BONES_DIFFER:
                reason = f"bones of {bones[0]:.2f} and {bones[1]:.2f} m"
                raise _wrong(skeleton, known, parts[1], parts[0], reason)
        if min(whole.values()) > 0 and max(whole.values()) > _SIDES_DIFFER * min(whole.values()):
            long = f"{whole['left']:.2f} m long, the right one {whole['right']:.2f} m"
            how = f"name its joints by hand (parts: left_{chain[1]}: JOINT, ...)"
            raise MotionError(f"the left {name} would be {long}; {how}")


def _check_sides(skeleton: Skeleton, known: Mapping[str, int]) -> None:
    """Raise MotionError if the toes of a rig that stands at rest contradict left and right."""
    if "left_hip" not in known:
        return
    places = _rest_places(skeleton)
    at = {part: places[joint] for part, joint in known.items()}
    hips = at["left_hip"] - at["right_hip"]
    trunk = at["left_shoulder"] + at["right_shoulder"] - at["left_hip"] - at["right_hip"]
    legs = sum(at[f"{side}_ankle"] - at[f"{side}_hip"] for side in SIDES)
    if -(trunk @ legs) < 0.7 * np.linalg.norm(trunk) * np.linalg.norm(legs):
        return
    ahead = np.cross(hips, trunk)
    toes = [at[f"{s}_toe"] - at[f"{s}_ankle"] for s in SIDES if f"{s}_toe" in at]
    if not toes or not np.linalg.norm(ahead):
        return
    if all(toe @ ahead < -0.3 * np.linalg.norm(toe) * np.linalg.norm(ahead) for toe in toes):
        hip = skeleton.names[known["left_hip"]]
        raise MotionError(f"with {hip!r} as left hip the toes point backwards: sides exchanged?")


def bone_length(skeleton: Skeleton, above: int, below: int) -> float:
    """Return metres along the bones from a joint to one of its descendants."""
    chain = [below, *skeleton.ancestors(below)]
    return float(np.linalg.norm(skeleton.offsets[chain[: chain.index(above)]], axis=1).sum())


def _wrong(
    skeleton: Skeleton, known: Mapping[str, int], a: str, b: str, reason: str
) -> MotionError:
    return MotionError(
        f"{skeleton.names[known[a]]!r} cannot be the {a.replace('_', ' ')} with "
        f"{skeleton.names[known[b]]!r} as the {b.replace('_', ' ')}: {reason}; "
        f"name them by hand (parts: {a}: JOINT, ...)"
    )
