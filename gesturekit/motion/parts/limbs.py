"""Limbs by the shape of a rig.

A human rig is a trunk with two pairs of limbs: legs at its lower end, arms farther along it, and
the head beyond. The limbs of a pair have equal bone lengths. The two longest bones of each limb are
adjacent: thigh and shank, upper arm and forearm. Feet point forward, and forward and up determine
left. If any of this is not clear, an error is raised, because a wrong guess is worse than none.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.skeleton import Skeleton
from gesturekit.wording import counted

SIDES = ("left", "right")

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


def reaches(skeleton: Skeleton) -> np.ndarray:
    """(J,) metres along bones from each joint to the farthest end below, end sites included."""
    reach, bone = _tips(skeleton), np.linalg.norm(skeleton.offsets, axis=1)
    for j in reversed(range(1, skeleton.n_joints)):
        above = skeleton.parents[j]
        reach[above] = max(reach[above], bone[j] + reach[j])
    return reach


def _tips(skeleton: Skeleton) -> np.ndarray:
    """(J,) metres from each joint to its farthest end site, 0 without any."""
    sites = [skeleton.end_sites.get(name, ()) for name in skeleton.names]
    return np.array([max(map(np.linalg.norm, own), default=0.0) for own in sites])


def _require(is_clear: bool, problem: str) -> None:
    if not is_clear:
        raise MotionError(problem)


class Limbs:
    """Limbs found by shape.

    Attributes:
        joints: part ("left_elbow", ...) to joint.
        head: None if there is none.
        pairs: joints of the limbs that are mirror images.
    """

    def __init__(self, skeleton: Skeleton) -> None:
        """Find arms and legs.

        Raises:
            MotionError: the shape is not clearly that of a person at rest; the message says why.
        """
        self._skeleton, self._place = skeleton, skeleton.rest_positions
        self._bone, self._tip = np.linalg.norm(skeleton.offsets, axis=1), _tips(skeleton)
        self._reach = reaches(skeleton)
        # Metres from a joint's parent along the longest path through the joint.
        self._whole = self._bone + self._reach
        forks = self._pairs_of_limbs()
        _require(len(forks) == 2, f"{counted(len(forks), 'pair')} of limbs of equal length, not 2")
        (pelvis, legs), (chest, arms) = forks
        is_trunk = pelvis in self._skeleton.ancestors(chest)
        _require(is_trunk, "the two pairs of limbs are not attached to one trunk")
        leg_chains = [self._chain(joint) for joint in legs]
        arm_chains = [self._chain(joint) for joint in arms]
        hips, arm_starts = (self._two_bones(chains) for chains in (leg_chains, arm_chains))
        _require(min(map(len, leg_chains)) >= hips + 3, "its legs have no ankles")
        self.joints: dict[str, int] = {}
        ankles = [chain[hips + 2] for chain in leg_chains]
        up = self._place[chest] - self._place[ankles].mean(axis=0)
        trunk = self._place[chest] - self._place[pelvis]
        stands = up @ trunk >= 0.7 * np.linalg.norm(up) * np.linalg.norm(trunk)
        _require(stands, "at rest its legs do not lie opposite its trunk")
        left = self._left(up, leg_chains, hips)
        for chains, start, parts in (
            (leg_chains, hips, ("hip", "knee", "ankle", "toe")),
            (arm_chains, arm_starts, ("shoulder", "elbow", "wrist")),
        ):
            apart = self._place[chains[0][start]] - self._place[chains[1][start]]
            is_sideways = abs(apart @ left) >= 0.5 * np.linalg.norm(apart)
            _require(is_sideways, "its limbs do not lie to its left and right at rest")
            if apart @ left < 0:
                chains.reverse()
            for side, chain in zip(("left", "right"), chains):
                self.joints |= {f"{side}_{part}": j for part, j in zip(parts, chain[start:])}
                if parts[0] == "shoulder" and start:
                    self.joints[f"{side}_clavicle"] = chain[start - 1]
        self.pairs = sorted(
            pair for a, b in (leg_chains, arm_chains) for pair in self._corresponding(a[0], b[0])
        )
        self.head = self._head(chest, arms)

    def _pairs_of_limbs(self) -> list[tuple[int, tuple[int, int]]]:
        """Return (parent, (limb, limb)) of each pair of long limbs of one shape, from the root."""
        most = max((self._whole[j] for j in self._skeleton.children(0)), default=0.0)
        least, forks = _LONG * (self._reach[0] + most), []
        for fork in range(self._skeleton.n_joints):
            long = [j for j in self._skeleton.children(fork) if self._whole[j] > least]
            few = len(long) <= _MOST_LIMBS
            alike = [pair for pair in combinations(long, 2) if self._alike(*pair)] if few else []
            several = f"more than two limbs of equal length on {self._name(fork)!r}"
            _require(few and len(alike) <= 1, several)
            forks += [(fork, pair) for pair in alike]
        return forks

    def _alike(self, a: int, b: int) -> bool:
        """Return whether two limbs have equal numbers of bones of equal lengths."""
        for left, right in self._corresponding(a, b):
            bones = self._bone[left], self._bone[right]
            if abs(bones[0] - bones[1]) > _ALIKE * max(bones) + _ROUNDING * self._reach[0]:
                return False
            if len(self._skeleton.children(left)) != len(self._skeleton.children(right)):
                return False
        return True

    def _sorted(self, joint: int) -> list[int]:
        """Return the children of a joint, ordered by lengths, which are equal on both sides."""
        return sorted(self._skeleton.children(joint), key=lambda j: (self._whole[j], self._bone[j]))

    def _corresponding(self, a: int, b: int) -> Iterator[tuple[int, int]]:
        """Yield the pairs of corresponding joints of two limbs, a joint before those below it."""
        pairs = [(a, b)]
        for pair in pairs:
            yield pair
            pairs += zip(*map(self._sorted, pair))

    def _chain(self, joint: int) -> list[int]:
        """Return the joints of a limb along its longest path."""
        chain = [joint]
        while below := self._skeleton.children(chain[-1]):
            chain.append(max(below, key=self._whole.__getitem__))
        return chain

    def _two_bones(self, chains: list[list[int]]) -> int:
        """Return the index in the chains of a pair at which the two long bones begin."""
        first = chains[0]
        bones = np.append(self._bone[first[1:]], self._tip[first[-1]])
        limb = f"the limb at {self._name(first[0])!r} has"
        _require(len(bones) > 1, f"{limb} fewer than two bones")
        start = int((bones[:-1] + bones[1:]).argmax())
        upper, lower = bones[start], bones[start + 1]
        others = np.delete(bones, [start, start + 1])
        clear = others.max(initial=0.0) * _CLEARLY <= min(upper, lower)
        _require(clear, f"{limb} no two longest bones")
        even = max(upper, lower) <= _CLEARLY**2 * min(upper, lower)
        _require(even, f"{limb} one long bone, not two")
        return start

    def _left(self, up: np.ndarray, legs: list[list[int]], hips: int) -> np.ndarray:
        """(3,) unit vector to the left, from the upward direction (3,) and the feet."""
        up = up / np.linalg.norm(up)
        ahead = np.zeros(3)
        for chain in legs:
            ankle = chain[hips + 2]
            ends = [self._place[chain[-1]] - self._place[ankle]]
            for joint in chain[hips + 2 :]:
                sites = self._skeleton.end_sites.get(self._name(joint), ())
                ends += [self._place[joint] + site - self._place[ankle] for site in sites]
            foot = max(ends, key=np.linalg.norm)
            ahead += foot - (foot @ up) * up
        shown = np.linalg.norm(ahead) >= _FORWARD * self._reach[0]
        _require(bool(shown), "its feet do not show which way is forward")
        return np.cross(up, ahead / np.linalg.norm(ahead))

    def _head(self, chest: int, arms: tuple[int, int]) -> int | None:
        """Return the head: the first joint with several children beyond the arms, or the last one.

        A last joint that only marks the top of the head is skipped; it is farther from the head
        than the head is from the neck.
        """
        beyond = [j for j in self._skeleton.children(chest) if j not in arms]
        if not beyond:
            return None
        chain = self._chain(max(beyond, key=self._whole.__getitem__))
        for joint in chain:
            if len(self._skeleton.children(joint)) > 1:
                return joint
        marks_top = self._tip[chain[-1]] < _POINT * self._reach[0] and len(chain) > 1
        before = self._bone[chain[-2]] if len(chain) > 1 else 0.0
        return chain[-2] if marks_top and self._bone[chain[-1]] > before else chain[-1]

    def _name(self, joint: int) -> str:
        return self._skeleton.names[joint]
