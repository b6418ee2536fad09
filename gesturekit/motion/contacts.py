"""Feet and the floor: where on the rig a foot touches, and when it stands still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gesturekit.motion.body_size import body_scale
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES, Leg, find_legs
from gesturekit.motion.parts.end_sites import real_end_sites
from gesturekit.motion.rotations import rotate_vectors
from gesturekit.motion.skeleton import Skeleton

CONTACT_SPEED = 0.2
"""m/s on the reference body; a foot point that is slower stands (eq. 1)."""
_SHORTEST_FOOT = 0.01
"""Metres on the reference body; a foot that ends closer to its ankle has no toe point."""
_ON_THE_FLOOR = 0.05


@dataclass(frozen=True, eq=False)
class FootPoint:
    """A point that is fixed to a joint: its name, and an offset (3,) in its frame, metres."""

    joint: str
    offset: np.ndarray


def foot_points(skeleton: Skeleton) -> tuple[FootPoint, ...]:
    """Return the points where the left foot touches the floor, then the right; none without legs.

    Heel and toe. The heel is the ankle joint. The toe is the toe joint, or where the
    rig has none the farthest end of the foot (a leaf or an end site on the ankle); without that
    there is no toe point. End sites that no foot can have do not count (`end_sites`).

    With a body model, big toe, small toe and heel: `BodyModel.rig` puts those vertices on the foot
    joints as end sites, and three or more of them on a foot are what touches the floor. They are
    fixed to the joint they are weighted to most, so that labels, losses and measurements see the
    same points and none needs the skin; see `BodyModel.vertices` for the skinned ones.
    """
    legs = find_legs(skeleton)
    if legs is None:
        return ()
    ends = real_end_sites(skeleton)
    points = []
    for side in SIDES:
        soles = [
            FootPoint(joint, site)
            for joint in (legs[side].toe, legs[side].ankle)
            for site in ends.get(joint, ())
        ]
        if len(soles) >= 3:
            points += soles
            continue
        points.append(FootPoint(legs[side].ankle, np.zeros(3)))
        toe = _toe(skeleton, legs[side], ends.get(legs[side].ankle, ()))
        if toe is not None:
            points.append(toe)
    return tuple(points)


def _toe(skeleton: Skeleton, leg: Leg, sites: Sequence[np.ndarray]) -> FootPoint | None:
    if leg.toe is not None:
        return FootPoint(leg.toe, np.zeros(3))
    ends = [skeleton.offsets[j] for j in skeleton.children(skeleton.index(leg.ankle))]
    far = max([*ends, *sites], key=np.linalg.norm, default=np.zeros(3))
    shortest = _SHORTEST_FOOT * body_scale(skeleton)
    return FootPoint(leg.ankle, far) if np.linalg.norm(far) > shortest else None


def foot_positions(motion: Motion) -> np.ndarray:
    """(T, F, 3) world positions of the foot points, metres."""
    points = foot_points(motion.skeleton)
    joints = [motion.skeleton.index(point.joint) for point in points]
    offsets = np.array([point.offset for point in points]).reshape(-1, 3)
    turned = motion.global_rotations()[:, joints]
    return motion.positions()[:, joints] + rotate_vectors(turned, offsets)


def floor_height(motion: Motion) -> float:
    """Metres: where the lowest joint of a motion is when it is on the floor.

    For motions that nobody has labelled and rigs whose feet cannot be told: the lowest joint is
    there in a twentieth of the frames at the least, and hardly ever below.
    """
    return float(np.quantile(motion.positions()[..., 1].min(axis=1), _ON_THE_FLOOR))


def contact_labels(motion: Motion, threshold: float = CONTACT_SPEED) -> np.ndarray:
    """(T, F) 1.0 where a foot point is slower than `threshold`, else 0.0.

    Eq. 1 of Moreno-Villamarin et al. 2024. The speed of frame k is that since frame k - 1; frame
    0 copies frame 1, and a single frame stands.

    Args:
        motion: any rig with two legs.
        threshold: m/s on the reference body; it is multiplied by `body_scale` of the rig.
    """
    threshold *= body_scale(motion.skeleton)
    feet = foot_positions(motion)
    speed = np.linalg.norm(np.diff(feet, axis=0), axis=-1) * motion.fps
    labels = (speed < threshold).astype(np.float64)
    first = labels[:1] if len(labels) else np.ones((1, feet.shape[1]))
    return np.concatenate([first, labels])
