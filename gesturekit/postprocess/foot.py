"""A foot of a rig: its joints, the two places where it stands, and all that must not sink."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gesturekit.motion.contacts import FootPoint, foot_points
from gesturekit.motion.parts import SIDES, find_legs, find_parts
from gesturekit.motion.parts.end_sites import real_end_sites
from gesturekit.motion.rotations import rotate_vectors
from gesturekit.motion.skeleton import Skeleton


@dataclass(frozen=True, eq=False)
class Anchor:
    """A place on the foot that stands: a joint, an offset (3,) in its frame, and which columns of
    the contact labels tell about it."""

    joint: int
    offset: np.ndarray
    columns: tuple[int, ...]

    def places(self, positions: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """(T, 3) of joints at (T, J, 3), turned by (T, J, 4)."""
        return positions[:, self.joint] + rotate_vectors(turned[:, self.joint], self.offset)


@dataclass(frozen=True, eq=False)
class Foot:
    """One leg and its foot.

    Attributes:
        limb: hip, knee and ankle, as joints.
        toe: the joint that the toes turn about, None without one.
        heel: where the foot stands at its back.
        ball: where it stands, and rolls, at its front; None on a foot that is a mere point.
        sole: points (joint, offset) that must not sink into the floor, those of the toes last.
        n_toes: how many of them belong to the toes.
    """

    limb: tuple[int, int, int]
    toe: int | None
    heel: Anchor
    ball: Anchor | None
    sole: tuple[tuple[int, np.ndarray], ...]
    n_toes: int

    def sole_places(self, positions: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """(T, N, 3) of the points of the sole, metres."""
        joints = [joint for joint, _ in self.sole]
        offsets = np.stack([offset for _, offset in self.sole])
        return positions[:, joints] + rotate_vectors(turned[:, joints], offsets)


def feet_of(skeleton: Skeleton) -> tuple[Foot, Foot]:
    """The left and the right foot of a rig.

    Raises:
        MotionError: legs that cannot be told; see `gesturekit.motion.parts.find_parts`.
    """
    left, right = _feet(skeleton)
    return left, right


def _feet(skeleton: Skeleton) -> Iterator[Foot]:
    legs = find_legs(skeleton) or find_parts(skeleton).legs
    points, ends = foot_points(skeleton), real_end_sites(skeleton)
    for side in SIDES:
        leg = legs[side]
        ankle = skeleton.index(leg.ankle)
        toe = None if leg.toe is None else skeleton.index(leg.toe)
        own = [k for k, point in enumerate(points) if point.joint in (leg.ankle, leg.toe)]
        front = [k for k in own if points[k].joint == leg.toe]
        back = [k for k in own if k not in front] or front[:1]
        if toe is None and len(back) > 1:
            # All of them hang on the ankle: the nearest is the heel.
            back.sort(key=lambda k: float(np.linalg.norm(points[k].offset)))
            back, front = back[:1], back[1:]
        if toe is not None:
            ball = Anchor(toe, np.zeros(3), tuple(front or back))
        else:
            ball = Anchor(ankle, _middle(points, front), tuple(front)) if front else None
        toes = {toe, *skeleton.descendants(toe)} if toe is not None else set()
        sole = [(skeleton.index(points[k].joint), points[k].offset) for k in back]
        below = (ankle, *skeleton.descendants(ankle))
        sole += [(j, np.zeros(3)) for j in below if j != ankle and j not in toes]
        tips = [(j, np.zeros(3)) for j in below if j in toes]
        for j in below:
            sites = [(j, site) for site in ends.get(skeleton.names[j], ())]
            (tips if j in toes else sole).extend(sites)
        yield Foot(
            limb=(skeleton.index(leg.hip), skeleton.index(leg.knee), ankle),
            toe=toe,
            heel=Anchor(ankle, _middle(points, back), tuple(back)),
            ball=ball,
            sole=(*sole, *tips),
            n_toes=len(tips),
        )


def _middle(points: tuple[FootPoint, ...], which: list[int]) -> np.ndarray:
    return np.mean([points[k].offset for k in which], axis=0)
