"""Arms and legs told from the shape of a rig alone, where its joint names say nothing.

A human rig is a trunk with two pairs of limbs: one pair where the trunk begins (legs), one farther
along it (arms), with the head beyond. The limbs of a pair are as long as each other, bone by bone.
In each limb the two longest bones follow one another: thigh and shank, upper arm and forearm. Feet
say where is forward, and that, with the way from legs to head, what is left. Where any of this is
not plainly so, nothing is told: a wrong guess is worse than none.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.skeleton import Skeleton
from gesturekit.wording import counted

_ALIKE = 0.15
"""Lengths of left and right bones differ by less than this share."""
_LONG = 0.25
"""A limb is longer than this share of the longest way through the rig."""
_ROUNDING, _POINT, _FORWARD = 0.007, 0.007, 0.035
"""Shares of how far the rig reaches from its root (1.4 m on an adult): by which short bones may
differ and be alike, below which an end site has no length, and which feet point ahead by."""
_CLEARLY = 1.3
"""The two long bones of a limb are longer than any other by this factor, and than each other by
no more than its square."""


@dataclass(frozen=True)
class Limbs:
    """What the shape tells: part ("left_elbow", ...) to joint, the head, and mirrored joints."""

    joints: dict[str, int]
    head: int | None
    pairs: tuple[tuple[int, int], ...]


def find_limbs(skeleton: Skeleton) -> Limbs:
    """Tell arms and legs by shape.

    Raises:
        MotionError: the shape is not plainly that of a person at rest; says what is not.
    """
    return _Shape(skeleton).limbs()


class _Shape:
    def __init__(self, skeleton: Skeleton) -> None:
        self.skeleton = skeleton
        self.bone = np.linalg.norm(skeleton.offsets, axis=1)
        self.place = skeleton.offsets.copy()
        for j, above in enumerate(skeleton.parents):
            self.place[j] = skeleton.offsets[j] + self.place[above] if above >= 0 else 0.0
        # How far each joint's bones reach, end sites and all that hangs on it counted in.
        sites = skeleton.end_sites
        self.tip = np.array(
            [max(map(np.linalg.norm, sites.get(name, ())), default=0.0) for name in skeleton.names]
        )
        self.reach = self.tip.copy()
        for j in reversed(range(1, skeleton.n_joints)):
            above = skeleton.parents[j]
            self.reach[above] = max(self.reach[above], self.bone[j] + self.reach[j])

    def limbs(self) -> Limbs:
        forks = self._pairs_of_limbs()
        if len(forks) != 2:
            raise MotionError(f"{counted(len(forks), 'pair')} of limbs of equal length, not 2")
        (pelvis, legs), (chest, arms) = forks
        if pelvis not in self.skeleton.ancestors(chest):
            raise MotionError("the two pairs of limbs do not hang on one trunk")
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
        pairs = [pair for chains in (leg_chains, arm_chains) for pair in self._mirrored(*chains)]
        return Limbs(joints, self._head(chest, arms), tuple(sorted(pairs)))

    def _pairs_of_limbs(self) -> list[tuple[int, tuple[int, int]]]:
        """(joint they hang on, (limb, limb)) for each pair of long limbs, from the root."""
        whole = self.reach[0] + max(
            (self.bone[j] + self.reach[j] for j in self.skeleton.children(0)), default=0.0
        )
        found = []
        for fork in range(self.skeleton.n_joints):
            long = [
                j
                for j in self.skeleton.children(fork)
                if self.bone[j] + self.reach[j] > _LONG * whole
            ]
            alike = [pair for pair in combinations(long, 2) if self._alike(*pair)]
            if len(alike) > 1:
                raise MotionError(f"more than two limbs of equal length on {self._name(fork)!r}")
            found += [(fork, pair) for pair in alike]
        return found

    def _alike(self, a: int, b: int) -> bool:
        """Whether two limbs have bones of equal lengths in equal numbers."""
        near = _ALIKE * max(self.bone[a], self.bone[b]) + _ROUNDING * self.reach[0]
        if abs(self.bone[a] - self.bone[b]) > near:
            return False
        below = [self._sorted(joint) for joint in (a, b)]
        return len(below[0]) == len(below[1]) and all(map(self._alike, *below))

    def _sorted(self, joint: int) -> list[int]:
        children = self.skeleton.children(joint)
        # By what can be told of either side alike: how far they reach, and how far off they are.
        return sorted(children, key=lambda j: (self.reach[j] + self.bone[j], self.bone[j]))

    def _mirrored(self, a: int | list[int], b: int | list[int]) -> list[tuple[int, int]]:
        """(joint, joint) for all of two limbs that are alike."""
        if isinstance(a, list) and isinstance(b, list):
            a, b = a[0], b[0]
        pairs = [(a, b)]
        for below in zip(*(self._sorted(joint) for joint in (a, b))):
            pairs += self._mirrored(*below)
        return pairs

    def _chain(self, joint: int) -> list[int]:
        """Joints from the start of a limb along its longest way."""
        chain = [joint]
        while self.skeleton.children(chain[-1]):
            chain.append(
                max(self.skeleton.children(chain[-1]), key=lambda j: self.bone[j] + self.reach[j])
            )
        return chain

    def _two_bones(self, chains: list[list[int]]) -> int:
        """Where in the chains of a pair the two long bones begin."""
        first = chains[0]
        bones = np.append(self.bone[first[1:]], self.tip[first[-1]])
        if len(bones) < 2:
            raise MotionError(f"the limb at {self._name(first[0])!r} has fewer than two bones")
        start = int((bones[:-1] + bones[1:]).argmax())
        upper, lower = bones[start], bones[start + 1]
        others = np.delete(bones, [start, start + 1])
        if others.size and others.max() * _CLEARLY > min(upper, lower):
            raise MotionError(f"no two bones of the limb at {self._name(first[0])!r} stand out")
        if max(upper, lower) > _CLEARLY**2 * min(upper, lower):
            raise MotionError(f"the limb at {self._name(first[0])!r} has one long bone, not two")
        return start

    def _left(self, up: np.ndarray, legs: list[list[int]], hips: int) -> np.ndarray:
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
            raise MotionError("its feet do not say where is forward")
        return np.cross(up, ahead / np.linalg.norm(ahead))

    def _head(self, chest: int, arms: tuple[int, int]) -> int | None:
        """Beyond the arms, the joint that a face hangs on, or else the last but for a mark of the
        top, which is farther from the head than that is from the neck."""
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
