"""Feet of a rig: joints, contact anchors, and points of the sole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gesturekit.motion.contacts import FootPoint, foot_points
from gesturekit.motion.parts import SIDES, require_legs
from gesturekit.motion.parts.body_size import real_end_sites
from gesturekit.motion.rotations import rotate_vectors
from gesturekit.motion.skeleton import Skeleton


@dataclass(frozen=True, eq=False)
class Anchor:
    """Point of the foot that is pinned while it stands.

    Attributes:
        joint: joint that the point is fixed to.
        offset: (3,) in the joint's frame, metres.
        columns: columns of the contact labels that belong to the point.
    """

    joint: int
    offset: np.ndarray
    columns: tuple[int, ...]

    def positions(self, joints: np.ndarray, world: np.ndarray) -> np.ndarray:
        """(T, 3) world positions, from those (T, J, 3) and world rotations (T, J, 4) of joints."""
        return joints[:, self.joint] + rotate_vectors(world[:, self.joint], self.offset)


@dataclass(frozen=True, eq=False)
class Foot:
    """One leg and its foot.

    Attributes:
        hip: joint of the hip.
        knee: joint of the knee.
        ankle: joint of the ankle.
        toe: joint that the toes rotate about; None without one.
        heel: rear contact point.
        ball: front contact point, about which the foot rolls; None if the foot is a single point.
        sole: points (joint, offset) that must not sink into the floor, those of the toes last.
        n_toes: number of sole points that belong to the toes.
    """

    hip: int
    knee: int
    ankle: int
    toe: int | None
    heel: Anchor
    ball: Anchor | None
    sole: tuple[tuple[int, np.ndarray], ...]
    n_toes: int

    @property
    def joints(self) -> tuple[int, ...]:
        """All joints of the leg that move, or that carry a point of the sole."""
        moving = [*self.limb, self.toe, *(joint for joint, _ in self.sole)]
        return tuple(sorted({joint for joint in moving if joint is not None}))

    def renumbered(self, index: Mapping[int, int]) -> Foot:
        """Return the foot with other joint indices: {old index: new index}."""
        return replace(
            self,
            hip=index[self.hip],
            knee=index[self.knee],
            ankle=index[self.ankle],
            toe=None if self.toe is None else index[self.toe],
            heel=replace(self.heel, joint=index[self.heel.joint]),
            ball=None if self.ball is None else replace(self.ball, joint=index[self.ball.joint]),
            sole=tuple((index[joint], offset) for joint, offset in self.sole),
        )

    @property
    def limb(self) -> list[int]:
        """Joints of hip, knee and ankle."""
        return [self.hip, self.knee, self.ankle]

    @property
    def anchors(self) -> list[Anchor]:
        """Heel and ball, or the heel alone."""
        return [self.heel] if self.ball is None else [self.heel, self.ball]

    def sole_positions(self, positions: np.ndarray, world: np.ndarray) -> np.ndarray:
        """(T, N, 3) world positions of the N points of the sole, metres.

        Args:
            positions: (T, J, 3) positions of the joints, metres.
            world: (T, J, 4) world rotations of the joints.
        """
        joints = [joint for joint, _ in self.sole]
        offsets = np.stack([offset for _, offset in self.sole])
        return positions[:, joints] + rotate_vectors(world[:, joints], offsets)


def feet_of_legs(skeleton: Skeleton) -> tuple[list[int], list[Foot]]:
    """Return the joints of both legs with all above them, in order, and the feet among these.

    The joints of the feet are places in that list, for a rig that has no others.

    Raises:
        MotionError: as `find_feet`.
    """
    feet = find_feet(skeleton)
    legs = {joint for foot in feet for joint in foot.joints}
    kept = sorted(legs.union(*map(skeleton.ancestors, legs)))
    index = {joint: place for place, joint in enumerate(kept)}
    return kept, [foot.renumbered(index) for foot in feet]


def find_feet(skeleton: Skeleton) -> list[Foot]:
    """Return the left and the right foot of a rig.

    Raises:
        MotionError: no legs, or none that can be identified; see
            `gesturekit.motion.parts.require_legs`.
    """
    legs, feet = require_legs(skeleton), []
    points, ends = foot_points(skeleton), real_end_sites(skeleton)
    for side in SIDES:
        leg = legs[side]
        ankle = skeleton.index(leg.ankle)
        toe = None if leg.toe is None else skeleton.index(leg.toe)
        front = [k for k, point in enumerate(points) if point.joint == leg.toe]
        back = [k for k, point in enumerate(points) if point.joint == leg.ankle]
        if toe is None and len(back) > 1:
            # All points are fixed to the ankle, so the nearest is the heel.
            back.sort(key=lambda k: float(np.linalg.norm(points[k].offset)))
            back, front = back[:1], back[1:]
        ball = Anchor(ankle, _middle(points, front), tuple(front)) if front else None
        if toe is not None:
            ball = Anchor(toe, np.zeros(3), tuple(front or back))
        toes = {toe, *skeleton.descendants(toe)} if toe is not None else set()
        sole = [(skeleton.index(points[k].joint), points[k].offset) for k in back]
        below = (ankle, *skeleton.descendants(ankle))
        sole += [(j, np.zeros(3)) for j in below if j != ankle and j not in toes]
        tips = [(j, np.zeros(3)) for j in below if j in toes]
        for j in below:
            sites = [(j, site) for site in ends.get(skeleton.names[j], ())]
            (tips if j in toes else sole).extend(sites)
        heel = Anchor(ankle, _middle(points, back), tuple(back or front))
        hip, knee = skeleton.index(leg.hip), skeleton.index(leg.knee)
        feet.append(Foot(hip, knee, ankle, toe, heel, ball, (*sole, *tips), len(tips)))
    return feet


def _middle(points: tuple[FootPoint, ...], which: list[int]) -> np.ndarray:
    """(3,) mean offset of some of the points, metres; zeros for none."""
    return np.mean([points[k].offset for k in which] or [np.zeros(3)], axis=0)
