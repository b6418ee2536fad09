"""Foot contacts: points of the feet that touch the floor, and labels of when they do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES, Leg, find_legs
from gesturekit.motion.parts.body_size import body_scale, real_end_sites
from gesturekit.motion.rotations import rotate_vectors
from gesturekit.motion.skeleton import Skeleton

CONTACT_SPEED = 0.2
"""m/s on the reference body; a slower foot point is in contact (eq. 1)."""
_SHORTEST_FOOT = 0.01
"""Metres on the reference body; a foot that ends closer to its ankle has no toe point."""
_FLOOR_QUANTILE = 0.05
"""Share of frames in which the lowest joint is assumed to be at or below the floor."""


@dataclass(frozen=True, eq=False)
class FootPoint:
    """Point fixed to a joint, at an offset (3,) in the joint's frame, metres."""

    joint: str
    offset: np.ndarray


def foot_points(skeleton: Skeleton) -> tuple[FootPoint, ...]:
    """Return the contact points of the left foot, then of the right; none without legs.

    The heel is the ankle joint. The toe is the toe joint, or without one the farthest end of the
    foot (a leaf or an end site on the ankle); without that there is no toe point. Implausible end
    sites are ignored (`real_end_sites`).

    A rig from a body model (`BodyModel.rig`) has its big toe, small toe and heel vertices as end
    sites of the foot joints. A foot with three or more end sites uses these instead. Each is fixed
    to the joint with the largest skinning weight, so that labels, losses and metrics use the same
    points without the skin; see `BodyModel.vertices` for the skinned ones.
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
            if joint is not None
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
    """Return the toe point, if any; `sites` (3,) are the end sites on the ankle."""
    if leg.toe is not None:
        return FootPoint(leg.toe, np.zeros(3))
    ends = [skeleton.offsets[j] for j in skeleton.children(skeleton.index(leg.ankle))]
    far = max([*ends, *sites], key=np.linalg.norm, default=np.zeros(3))
    shortest = _SHORTEST_FOOT * body_scale(skeleton)
    return FootPoint(leg.ankle, far) if np.linalg.norm(far) > shortest else None


def foot_positions(motion: Motion) -> np.ndarray:
    """(T, F, 3) world positions of the F foot points, metres."""
    points = foot_points(motion.skeleton)
    joints = [motion.skeleton.index(point.joint) for point in points]
    offsets = np.array([point.offset for point in points]).reshape(-1, 3)
    world = motion.global_rotations()[:, joints]
    return motion.positions()[:, joints] + rotate_vectors(world, offsets)


def floor_height(motion: Motion) -> float:
    """Return the height of the floor, metres: the 5th percentile of the lowest joint's height.

    It needs neither contact labels nor identified feet.
    """
    return float(np.quantile(motion.positions()[..., 1].min(axis=1), _FLOOR_QUANTILE))


def contact_labels(motion: Motion, threshold: float = CONTACT_SPEED) -> np.ndarray:
    """(T, F) contact labels: 1.0 if a foot point is slower than `threshold`, else 0.0.

    Eq. 1 of Moreno-Villamarin et al. 2024. The speed of frame k is measured since frame k - 1;
    frame 0 copies frame 1, and a single frame is in contact.

    Args:
        motion: any rig with two legs.
        threshold: m/s on the reference body; multiplied by `body_scale` of the rig.
    """
    threshold *= body_scale(motion.skeleton)
    feet = foot_positions(motion)
    speed = np.linalg.norm(np.diff(feet, axis=0), axis=2) * motion.fps
    labels = (speed < threshold).astype(np.float64)
    first = labels[:1] if len(labels) else np.ones((1, feet.shape[1]))
    return np.concatenate([first, labels])
