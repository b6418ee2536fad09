"""Figure: the points and limbs to draw for a motion, and the shapes of limbs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gesturekit.errors import FormatError, MotionError
from gesturekit.motion.parts import BodyParts, known_parts
from gesturekit.motion.parts.body_size import body_height, real_end_sites
from gesturekit.motion.rotations import invert_quaternions, rotate_vectors
from gesturekit.motion.skeleton import Skeleton

if TYPE_CHECKING:
    from gesturekit.motion import Motion

_UPRIGHT = 0.5
"""A body is upright if the unit vector from pelvis to shoulders has a mean y above this."""
_BUST = 0.75
"""Height that trunk, head and moving arms take in a view, as a share of the whole person's."""
FRAMINGS = {"whole": 0.0, "waist": 0.45, "face": 0.82}
"""Share of the body's height that is below a view, by framing; "waist" shows hanging hands too,
"face" may lose raised ones."""
SPEED_SMOOTHING = 0.1
"""Standard deviation of the Gaussian that hand speed is smoothed with, in seconds."""

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


def limb_shapes(skeleton: Skeleton, parts: BodyParts | None) -> dict[str, Shape | None]:
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


def tip_shape(joint: str, drawn: dict[str, Shape | None], parts: BodyParts | None) -> Shape | None:
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
    shape = drawn[joint]
    if shape is None:
        return None
    # The next one down: a foot ends in toes, a palm in a finger, anything else goes on thinner.
    following = {FOOT: TOE, PALM: FINGER}.get(shape.on(MIDDLE), shape)
    return replace(following, start=min(shape.end, following.start), side=shape.side)


@dataclass(frozen=True)
class Limb:
    """A tapered limb between two points.

    Attributes:
        ends: indices into `Figure.points`.
        radii: at each end, metres.
        side: MIDDLE, LEFT or RIGHT.
        across: indices of two points whose direction the wide axis follows; None if it is round.
        width: ratio of width to depth.
        length: median over the clip, metres.
    """

    ends: tuple[int, int]
    radii: tuple[float, float]
    side: int
    across: tuple[int, int] | None
    width: float
    length: float


@dataclass(frozen=True)
class Figure:
    """The points, limbs and curves to draw for one motion.

    Attributes:
        points: (T, P, 3) world positions in metres: the joints in the skeleton's order, then end
            sites, then added points that move with a joint (face, tip of a hand without fingers).
        fps: frames per second.
        limbs: drawn between the points.
        head: indices into `points` of the head joint, the top of the head, and a point in front of
            the joint; None if no head could be identified.
        hands: indices into `points` of the wrists, or the ends of arms without; empty if unknown.
        hand_speed: (T,) m/s, sum of both hands' speeds relative to the pelvis, smoothed by a
            Gaussian of SPEED_SMOOTHING; the mean over all joints if hands cannot be identified.
        speed_of: label of `hand_speed`: "hand speed" or "mean speed of all joints".
        height: of the body, metres; that of the whole person on a rig without legs.
        extent: height that the figure takes in a view, metres; less than `height` without legs.
        floor: height of the ground, metres; the seat of a rig without legs.
        front: mean yaw of the facing direction, radians, 0 towards +Z and positive towards +X.
    """

    points: np.ndarray
    fps: float
    limbs: tuple[Limb, ...]
    head: tuple[int, int, int] | None
    hands: tuple[int, ...]
    hand_speed: np.ndarray
    speed_of: str
    height: float
    extent: float
    floor: float
    front: float

    @property
    def head_size(self) -> float:
        """Height of the head, metres."""
        return HEAD_HEIGHT * self.height

    @property
    def top_speed(self) -> float:
        """Upper limit of the hand-speed plot, m/s.

        Limited to 1.5 times the 98th percentile, so that a single jump, such as a T-pose in frame
        0, does not flatten the rest of the curve.
        """
        usual = 1.5 * float(np.quantile(self.hand_speed, 0.98))
        return max(min(float(self.hand_speed.max()), usual), 1e-6)

    def below(self, framing: str) -> float:
        """Return how much of the figure is below a view with one of FRAMINGS, metres.

        Raises:
            FormatError: an unknown framing.
        """
        if framing not in FRAMINGS:
            raise FormatError(f"framing is {framing!r}; expected {' or '.join(FRAMINGS)}")
        return FRAMINGS[framing] * self.height if self.extent == self.height else 0.0

    @classmethod
    def of(cls, motion: Motion, plain: bool = False) -> Figure:
        """Compute the figure of a motion, on any skeleton.

        Implausible end sites are not drawn. A skeleton whose parts cannot be identified is drawn
        with plain limbs, as every skeleton is if `plain`, which also leaves out the head.
        """
        parts = known_parts(motion.skeleton)
        # Before end sites are removed, since all of them help to identify parts.
        height = _height(motion.skeleton)
        ends = real_end_sites(motion.skeleton)
        motion = replace(motion, skeleton=replace(motion.skeleton, end_sites=ends))
        points = _Points(motion)
        head = None
        if parts and parts.head and not plain:
            joint, axes = parts.head, _axes(points, parts)
            up, face = (
                points.add(points.at(joint) + HEAD_HEIGHT * height * points.fixed(joint, axis))
                for axis in axes
            )
            head = points.skeleton.index(joint), up, face
        limbs = _limbs(points, None if plain else parts, height)
        hands = _hands(points, parts)
        drawn, bust = points.stacked(), None if parts is None or parts.legs else parts
        return cls(
            points=drawn,
            fps=motion.fps,
            limbs=limbs,
            head=head,
            hands=hands,
            hand_speed=_hand_speed(points, hands, parts),
            speed_of="hand speed" if parts else "mean speed of all joints",
            height=height,
            extent=_BUST * height if bust else height,
            floor=_seat(points, bust, height) if bust else _floor(drawn),
            front=_front(points, parts) if parts else 0.0,
        )


class _Points:
    """A motion's joints, and the points added to them."""

    def __init__(self, motion: Motion) -> None:
        self.motion, self.skeleton = motion, motion.skeleton
        self.joints, self.turns = motion.positions(), motion.global_rotations()
        self.added: list[np.ndarray] = []

    def at(self, joint: str) -> np.ndarray:
        """Return the world positions (T, 3) of a joint."""
        return self.joints[:, self.skeleton.index(joint)]

    def add(self, positions: np.ndarray) -> int:
        """Add a point (T, 3) and return its index."""
        self.added.append(positions)
        return self.skeleton.n_joints + len(self.added) - 1

    def stacked(self) -> np.ndarray:
        """Return all points, (T, P, 3)."""
        return np.concatenate([self.joints, *(point[:, None] for point in self.added)], axis=1)

    def fixed(self, joint: str, direction: np.ndarray) -> np.ndarray:
        """Return directions (T, 3) that move rigidly with a joint, fitted to the given ones.

        The fit is their mean over the clip in the joint's local axes. It assumes no rest pose: a
        head that turns to both sides faces forward on average.
        """
        turn = self.turns[:, self.skeleton.index(joint)]
        local = _unit(rotate_vectors(invert_quaternions(turn), direction).mean(axis=0))
        return rotate_vectors(turn, np.broadcast_to(local, direction.shape))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def _height(skeleton: Skeleton) -> float:
    """Return the body height, metres.

    A rig without bones is as tall as its longest end site, or a millimetre.
    """
    try:
        return body_height(skeleton)
    except MotionError:
        ends = [site for sites in skeleton.end_sites.values() for site in sites]
        return max([1e-3, *(float(np.linalg.norm(end)) for end in ends)])


def _floor(drawn: np.ndarray) -> float:
    """Return the height of the ground under points (T, P, 3), metres.

    A low quantile instead of the minimum: in most recordings feet dip below the ground.
    """
    return float(np.quantile(drawn[:, :, 1].min(axis=1), 0.25))


def _seat(points: _Points, parts: BodyParts, height: float) -> float:
    """Return the lower end of a trunk without legs, metres; the still root of a rig may be lower.

    Hands that hang below it do not count.
    """
    radius = TRUNK[0][1] * height
    return float(np.quantile(points.at(parts.pelvis)[:, 1], 0.25)) - radius


def _axes(points: _Points, parts: BodyParts) -> tuple[np.ndarray, np.ndarray]:
    """Return the body's up and forward directions, unit vectors (T, 3) each."""
    left, right = (points.at(parts.arms[side].shoulder) for side in SIDES)
    trunk = _unit((left + right) / 2 - points.at(parts.pelvis))
    # If a body faces +Z, its left is +X and its up +Y.
    if trunk[:, 1].mean() < _UPRIGHT:  # on four legs: the trunk points forward
        return _unit(np.cross(trunk, left - right)), trunk
    return trunk, _unit(np.cross(left - right, trunk))


def _front(points: _Points, parts: BodyParts) -> float:
    _, forward = _axes(points, parts)
    x, _, z = forward.mean(axis=0)
    if np.hypot(x, z) < 0.2:  # no mean direction, as it turns around: use frame 0
        x, _, z = forward[0]
    return float(np.arctan2(x, z))


def _limbs(points: _Points, parts: BodyParts | None, height: float) -> tuple[Limb, ...]:
    skeleton = points.skeleton
    drawn = limb_shapes(skeleton, parts)
    pairs: list[tuple[int, int, Shape | None]] = [
        (parent, joint, drawn[skeleton.names[joint]])
        for joint, parent in enumerate(skeleton.parents)
        if parent >= 0
    ]
    toes = {leg.toe for leg in parts.legs.values()} if parts else set()
    for name, sites in points.motion.end_positions().items():
        shape = tip_shape(name, drawn, parts)
        if name in toes:  # one limb to the mean of a toe's end sites
            sites = sites.mean(axis=1, keepdims=True)
        if shape:
            joint = skeleton.index(name)
            pairs += [(joint, points.add(site), shape) for site in np.moveaxis(sites, 1, 0)]
    if parts:
        for name, side in SIDES.items():
            arm = parts.arms[name]
            if not arm.wrist:
                continue
            wrist = skeleton.index(arm.wrist)
            if not skeleton.children(wrist) and arm.wrist not in skeleton.end_sites:
                along = points.fixed(arm.wrist, _unit(points.at(arm.wrist) - points.at(arm.elbow)))
                tip = points.add(points.at(arm.wrist) + HAND_LENGTH * height * along)
                pairs.append((wrist, tip, HAND.on(side)))
    across = None
    if parts:
        right, left = (skeleton.index(parts.arms[side].shoulder) for side in ("right", "left"))
        across = right, left
    places = points.stacked()
    limbs = []
    for start, end, shape in pairs:
        length = float(np.median(np.linalg.norm(places[:, end] - places[:, start], axis=-1)))
        if shape and length > 1e-5 * height:
            limbs.append(
                Limb(
                    ends=(start, end),
                    radii=(shape.start * height, shape.end * height),
                    side=shape.side,
                    across=across if shape.width != 1 else None,
                    width=shape.width,
                    length=length,
                )
            )
    return tuple(limbs)


def _hands(points: _Points, parts: BodyParts | None) -> tuple[int, ...]:
    """Return the indices of both hands' points; without wrists, those of the forearms' ends."""
    hands = []
    for arm in parts.arms.values() if parts else ():
        if arm.wrist is None and arm.elbow in points.skeleton.end_sites:
            hands.append(points.add(points.motion.end_positions()[arm.elbow][:, 0]))
        else:
            hands.append(points.skeleton.index(arm.wrist or arm.elbow))
    return tuple(hands)


def _hand_speed(points: _Points, hands: tuple[int, ...], parts: BodyParts | None) -> np.ndarray:
    motion = points.motion
    if motion.n_frames < 2:
        return np.zeros(motion.n_frames)
    if parts:  # the root may be a still joint above the hips
        moving = points.stacked()[:, list(hands)] - points.at(parts.pelvis)[:, None]
    else:
        moving = points.joints - points.joints[:, :1]
    speed = np.linalg.norm(np.gradient(moving, axis=0), axis=-1) * motion.fps
    total = speed.sum(axis=1) if parts else speed.mean(axis=1)
    return gaussian_filter1d(total, SPEED_SMOOTHING * motion.fps, mode="nearest")
