"""Anatomy: thickness and body side of each drawn limb."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gesturekit.motion.parts import BodyParts
from gesturekit.motion.skeleton import Skeleton

MIDDLE, LEFT, RIGHT = 0, 1, 2
"""The side a limb is on; the page and the pictures colour by it."""

SIDES = {"left": LEFT, "right": RIGHT}


@dataclass(frozen=True)
class Shape:
    """Shape of a limb in units of the body's height.

    Attributes:
        start, end: radii at its ends.
        width: ratio of width to depth.
        side: MIDDLE, LEFT or RIGHT.
    """

    start: float
    end: float
    width: float = 1.0
    side: int = MIDDLE

    def on(self, side: int) -> Shape:
        """Return the shape on another side."""
        return replace(self, side=side)


# An average adult's mannequin, not anybody in particular.
TRUNK = ((0.0, 0.055), (0.35, 0.050), (0.7, 0.060), (1.0, 0.034))
"""Radii along the way from pelvis to neck: hips, waist, chest, collar."""
TRUNK_WIDTH = 1.45
NECK = Shape(0.031, 0.027)
HIP = Shape(0.048, 0.049)
THIGH = Shape(0.048, 0.030)
SHIN = Shape(0.030, 0.019)
FOOT = Shape(0.022, 0.017)
TOE = Shape(0.016, 0.010)
CLAVICLE = Shape(0.034, 0.030)
UPPER_ARM = Shape(0.029, 0.021)
FOREARM = Shape(0.021, 0.014)
PALM = Shape(0.0125, 0.0085)
HAND = Shape(0.014, 0.011)
FINGER = Shape(0.0062, 0.0046)
PLAIN = Shape(0.011, 0.008)
"""A limb of a skeleton whose parts are not known."""

HAND_LENGTH = 0.095
HEAD_HEIGHT = 0.142


def shapes(skeleton: Skeleton, parts: BodyParts | None) -> dict[str, Shape | None]:
    """Return joint name -> shape of the limb from its parent to it; None for "not drawn".

    Joints that are on no chain from one known part to another (twist joints beside a limb, props)
    are drawn plain.
    """
    out: dict[str, Shape | None] = dict.fromkeys(skeleton.names, PLAIN)
    if parts is None:
        return out

    def below(name: str, shape: Shape | None) -> None:
        for joint in skeleton.descendants(skeleton.index(name)):
            out[skeleton.names[joint]] = shape

    def between(top: str, bottom: str, shape: Shape | None) -> None:
        joint, stop = skeleton.index(bottom), skeleton.index(top)
        while joint not in (stop, -1):
            out[skeleton.names[joint]] = shape
            joint = skeleton.parents[joint]

    # From the root down to the pelvis: a marker on the ground in some files, no part of a body.
    between(skeleton.names[0], parts.pelvis, None)
    chest = parts.spine[-1] if parts.spine else parts.pelvis
    collar = parts.neck or parts.head or chest
    out |= _trunk(skeleton, parts.pelvis, collar)
    if parts.head:
        between(collar, parts.head, NECK)
        below(parts.head, None)  # eyes, jaw, crown: the head is drawn as a whole
    for name, side in SIDES.items():
        arm, leg = parts.arms[name], parts.legs.get(name)
        between(chest, arm.shoulder, CLAVICLE)
        between(arm.shoulder, arm.elbow, UPPER_ARM.on(side))
        if arm.wrist:
            below(arm.wrist, FINGER.on(side))
            for joint in skeleton.children(skeleton.index(arm.wrist)):
                out[skeleton.names[joint]] = PALM.on(side)
            between(arm.elbow, arm.wrist, FOREARM.on(side))
        else:
            below(arm.elbow, FOREARM.on(side))
        if leg is None:
            continue
        between(parts.pelvis, leg.hip, HIP)
        below(leg.ankle, TOE.on(side))
        for joint in skeleton.children(skeleton.index(leg.ankle)):
            out[skeleton.names[joint]] = FOOT.on(side)
        between(leg.hip, leg.knee, THIGH.on(side))
        between(leg.knee, leg.ankle, SHIN.on(side))
    return out


def _trunk(skeleton: Skeleton, pelvis: str, collar: str) -> dict[str, Shape]:
    """Shapes from the pelvis up, each as thick at its start as the one below at its end."""
    top, joints = skeleton.index(collar), list[int]()
    while top not in (skeleton.index(pelvis), -1):
        joints.insert(0, top)
        top = skeleton.parents[top]
    lengths = np.linalg.norm(skeleton.offsets[joints], axis=-1) if joints else np.empty(0)
    way = np.concatenate([[0.0], np.cumsum(lengths)]) / max(float(lengths.sum()), 1e-9)
    places, thickness = np.array(TRUNK).T
    radii = np.interp(way, places, thickness)
    return {
        skeleton.names[joint]: Shape(float(radii[k]), float(radii[k + 1]), width=TRUNK_WIDTH)
        for k, joint in enumerate(joints)
    }


def tip(joint: str, drawn: dict[str, Shape | None], parts: BodyParts | None) -> Shape | None:
    """Return the shape of the limb from a joint to its end site; None for "not drawn"."""
    if parts is None:
        return PLAIN
    if joint == parts.head:
        return None
    for name, side in SIDES.items():
        if joint == parts.arms[name].wrist:
            return HAND.on(side)
        if joint == parts.arms[name].elbow:
            return FOREARM.on(side)
        leg = parts.legs.get(name)
        if leg and joint == leg.ankle:  # a heel needs no limb beside the foot
            return None if leg.toe else FOOT.on(side)
    own = drawn[joint]
    if own is None:
        return None
    # The next one down: a foot ends in toes, a palm in a finger, anything else goes on thinner.
    following = {FOOT: TOE, PALM: FINGER}.get(own.on(MIDDLE), own)
    return replace(following, start=min(own.end, following.start), side=own.side)
