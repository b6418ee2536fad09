"""Figure: the points and limbs to draw for a motion, in the page and in pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gesturekit.errors import FormatError, MotionError
from gesturekit.motion.parts import BodyParts, find_parts
from gesturekit.motion.parts.body_size import body_height, real_end_sites
from gesturekit.motion.rotations import invert_quaternions, rotate_vectors
from gesturekit.viewer import anatomy
from gesturekit.viewer.anatomy import Shape

if TYPE_CHECKING:
    from gesturekit.motion import Motion, Skeleton

_UPRIGHT = 0.5
"""A body is upright if the unit vector from pelvis to shoulders has a mean y above this."""
_BUST = 0.75
"""Height that trunk, head and moving arms take in a view, as a share of the whole person's."""
FRAMINGS = {"whole": 0.0, "waist": 0.45}
"""Share of the body's height that is below a view, by framing; "waist" shows hanging hands too."""
SPEED_SMOOTHING = 0.1
"""Standard deviation of the Gaussian that hand speed is smoothed with, in seconds."""


@dataclass(frozen=True)
class Limb:
    """A tapered limb between two points.

    Attributes:
        ends: indices into `Figure.points`.
        radii: at each end, metres.
        side: `anatomy.MIDDLE`, `LEFT` or `RIGHT`.
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
class Head:
    """Position and orientation of the head.

    Attributes:
        base, up, face: indices into `Figure.points`: head joint, top of the head, and a point in
            front of the joint.
        size: height of the head, metres.
    """

    base: int
    up: int
    face: int
    size: float


@dataclass(frozen=True)
class Figure:
    """The points, limbs and curves to draw for one motion.

    Attributes:
        points: (T, P, 3) world positions in metres: the joints in the skeleton's order, then end
            sites, then added points that move with a joint (face, tip of a hand without fingers).
        fps: frames per second.
        limbs: drawn between the points.
        head: None if no head could be identified.
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
    head: Head | None
    hands: tuple[int, ...]
    hand_speed: np.ndarray
    speed_of: str
    height: float
    extent: float
    floor: float
    front: float

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
        try:
            parts = find_parts(motion.skeleton)
        except MotionError:
            parts = None
        # Before end sites are removed, since all of them help to identify parts.
        height = _height(motion.skeleton)
        ends = real_end_sites(motion.skeleton)
        motion = replace(motion, skeleton=replace(motion.skeleton, end_sites=ends))
        points = _Points(motion)
        head = (
            _head(points, parts, parts.head, height) if parts and parts.head and not plain else None
        )
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
        own = _unit(rotate_vectors(invert_quaternions(turn), direction).mean(axis=0))
        return rotate_vectors(turn, np.broadcast_to(own, direction.shape))


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
    radius = anatomy.TRUNK[0][1] * height
    return float(np.quantile(points.at(parts.pelvis)[:, 1], 0.25)) - radius


def _axes(points: _Points, parts: BodyParts) -> tuple[np.ndarray, np.ndarray]:
    """Return the body's up and forward directions, unit vectors (T, 3) each."""
    left, right = (points.at(parts.arms[side].shoulder) for side in anatomy.SIDES)
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


def _head(points: _Points, parts: BodyParts, joint: str, height: float) -> Head:
    size = anatomy.HEAD_HEIGHT * height
    place = points.at(joint)
    up, forward = (points.fixed(joint, axis) for axis in _axes(points, parts))
    return Head(
        base=points.skeleton.index(joint),
        up=points.add(place + size * up),
        face=points.add(place + size * forward),
        size=size,
    )


def _limbs(points: _Points, parts: BodyParts | None, height: float) -> tuple[Limb, ...]:
    skeleton = points.skeleton
    drawn = anatomy.shapes(skeleton, parts)
    pairs: list[tuple[int, int, Shape | None]] = [
        (parent, joint, drawn[skeleton.names[joint]])
        for joint, parent in enumerate(skeleton.parents)
        if parent >= 0
    ]
    toes = {leg.toe for leg in parts.legs.values()} if parts else set()
    for name, sites in points.motion.end_positions().items():
        shape = anatomy.tip(name, drawn, parts)
        if name in toes:  # one limb to the mean of a toe's end sites
            sites = sites.mean(axis=1, keepdims=True)
        if shape:
            joint = skeleton.index(name)
            pairs += [(joint, points.add(site), shape) for site in np.moveaxis(sites, 1, 0)]
    if parts:
        for name, side in anatomy.SIDES.items():
            arm = parts.arms[name]
            if not arm.wrist:
                continue
            wrist = skeleton.index(arm.wrist)
            if not skeleton.children(wrist) and arm.wrist not in skeleton.end_sites:
                along = points.fixed(arm.wrist, _unit(points.at(arm.wrist) - points.at(arm.elbow)))
                tip = points.add(points.at(arm.wrist) + anatomy.HAND_LENGTH * height * along)
                pairs.append((wrist, tip, anatomy.HAND.on(side)))
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
    found = []
    for arm in parts.arms.values() if parts else ():
        if arm.wrist is None and arm.elbow in points.skeleton.end_sites:
            found.append(points.add(points.motion.end_positions()[arm.elbow][:, 0]))
        else:
            found.append(points.skeleton.index(arm.wrist or arm.elbow))
    return tuple(found)


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
