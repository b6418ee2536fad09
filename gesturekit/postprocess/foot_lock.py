"""Foot locking: remove the sliding of standing feet.

1. Find the contact spans of heel and ball of each foot, from the contact labels predicted by the
   model, or from speed and height (`contact_frames`).
2. Subtract slow sliding that is common to the standing feet from the hip path (`horizontal_drift`).
3. Pin each point at its mean position on the floor in each span, and blend the correction in and
   out (`pin`). A foot is never pulled down in flight: it rolls onto and off the floor as
   before. While the heel lifts, only the ball is pinned; a flat foot is pinned at both and rotated
   as a whole.
4. Raise feet that would sink deeper than before, and lower the hips if a leg is too short.
5. Solve hips and knees by two-bone IK (`gesturekit.motion.ik`). The ankle keeps the
   orientation of the foot, and the toes keep theirs.

Frames without contact do not change. Constants in metres and m/s are for the reference body and
are multiplied by `body_scale`.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter1d

from gesturekit.errors import MotionError
from gesturekit.motion.contacts import CONTACT_SPEED, foot_points
from gesturekit.motion.ik import (
    HIP_DROP_SECONDS,
    STRETCH,
    Reach,
    bend_limbs,
    reachable,
    smooth_upper_envelope,
    too_high,
)
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES, find_legs, leg_length, require_legs
from gesturekit.motion.parts.body_size import body_scale, real_end_sites
from gesturekit.motion.resampling import smoothstep
from gesturekit.motion.rotations import (
    IDENTITY,
    invert_quaternions,
    multiply_quaternions,
    normalize_quaternions,
    rotate_vectors,
    shortest_arc,
)
from gesturekit.motion.skeleton import Skeleton, forward_kinematics, global_rotations


class Anchor(NamedTuple):
    """Point of the foot that is pinned while it stands.

    Attributes:
        joint: joint that the point is fixed to.
        offset: (3,) in the joint's frame, metres.
        columns: columns of the contact labels that belong to the point.
    """

    joint: int
    offset: np.ndarray
    columns: list[int]


class Foot(NamedTuple):
    """One leg and its foot.

    Attributes:
        limb: joints of hip, knee and ankle.
        toe: joint that the toes rotate about; None without one.
        anchors: rear contact point and front contact point, about which the foot rolls; the rear
            one alone if the foot is a single point.
        sole: points (joint, offset) that must not sink into the floor, those of the toes last.
        n_toes: number of sole points that belong to the toes.
    """

    limb: list[int]
    toe: int | None
    anchors: list[Anchor]
    sole: list[tuple[int, np.ndarray]]
    n_toes: int


def find_feet(skeleton: Skeleton) -> tuple[list[int], Skeleton, list[Foot]]:
    """Return the joints of both legs with all above them, a rig of these, and the feet on it.

    Raises:
        MotionError: no legs, or none that can be identified; see
            `gesturekit.motion.parts.require_legs`.
    """
    legs, feet = require_legs(skeleton), []
    ankles = [skeleton.index(legs[side].ankle) for side in SIDES]
    near = [(j, *skeleton.ancestors(j), *skeleton.descendants(j)) for j in ankles]
    kept = sorted(set().union(*near))
    place = {joint: k for k, joint in enumerate(kept)}
    rig = Skeleton(
        names=tuple(skeleton.names[j] for j in kept),
        parents=tuple(place.get(skeleton.parents[j], -1) for j in kept),
        offsets=skeleton.offsets[kept],
    )
    points, ends = foot_points(skeleton), real_end_sites(skeleton)
    for leg in (legs[side] for side in SIDES):
        limb = [rig.index(name) for name in (leg.hip, leg.knee, leg.ankle)]
        ankle, toe = limb[2], None if leg.toe is None else rig.index(leg.toe)
        front = [k for k, point in enumerate(points) if point.joint == leg.toe]
        back = [k for k, point in enumerate(points) if point.joint == leg.ankle]
        if toe is None and len(back) > 1:
            # All points are fixed to the ankle, so the nearest is the heel.
            back.sort(key=lambda k: float(np.linalg.norm(points[k].offset)))
            back, front = back[:1], back[1:]
        heel, ball = (
            np.mean([points[k].offset for k in which] or [np.zeros(3)], axis=0)
            for which in (back, front)
        )
        anchors = [Anchor(ankle, heel, back or front)]
        if toe is not None:
            anchors.append(Anchor(toe, np.zeros(3), front or back))
        elif front:
            anchors.append(Anchor(ankle, ball, front))
        toes = set() if toe is None else {toe, *rig.descendants(toe)}
        below = (ankle, *rig.descendants(ankle))
        sole = [(ankle, points[k].offset) for k in back]
        sole += [(j, np.zeros(3)) for j in below[1:]]
        sole += [(j, site) for j in below for site in ends.get(rig.names[j], ())]
        sole.sort(key=lambda point: point[0] in toes)
        feet.append(Foot(limb, toe, anchors, sole, sum(joint in toes for joint, _ in sole)))
    return kept, rig, feet


_MAX_CORRECTION = 0.1
"""Largest correction of a foot, as a share of the leg length."""
_MAX_TURN = 0.15
"""Largest difference between corrections of heel and ball, as a share of the foot length."""
_LIFT = 0.01
"""Metres; a heel that is higher while the ball stands is really lifted."""
_MAX_DROP = 0.05
"""Largest lowering of the hips, as a share of the leg length."""
_NOTHING = 1e-7
"""Metres, and sines of half angles, that count as no change."""

Goal = tuple[np.ndarray, np.ndarray]
"""Correction of a foot in the world: (T, 3) movement of its ankle, (T, 4) rotation."""


def lock_feet(
    motion: Motion, contacts: np.ndarray | None = None, *, keep_path: bool = False
) -> Motion:
    """Remove the sliding of standing feet.

    Args:
        motion: T frames of any rig; one without two identifiable legs does not change.
        contacts: (T, F) labels of the points of `gesturekit.motion.contacts.foot_points`, above 0.5
            if a point stands; None decides by speed and height.
        keep_path: keep the hip path even if both feet slide with it, for motion that follows a
            requested path.

    Returns:
        The motion with corrected legs and, if both feet slid together, a corrected hip path.
        Frames without contact keep their pose bit for bit.

    Raises:
        MotionError: labels of another shape.
    """
    if find_legs(motion.skeleton) is None:
        return motion
    return _FootLock(motion, contacts).locked(keep_path)


class _FootLock:
    """Foot locking of one motion; only the legs and the joints above them are computed.

    `places` and `stands` hold, for each foot and each of its anchors, the world positions (T, 3),
    and the contact mask (T,) and height of the floor, metres.
    """

    def __init__(self, motion: Motion, contacts: np.ndarray | None) -> None:
        self.motion, self.fps = motion, motion.fps
        self.kept, self.skeleton, self.feet = find_feet(motion.skeleton)
        self.rotations = motion.rotations[:, self.kept]
        moving = motion.joint_translations.items()
        moving = {name: path for name, path in moving if name in self.skeleton.names}
        self.world = global_rotations(self.rotations, self.skeleton)
        self.positions = forward_kinematics(
            self.rotations, motion.translation, self.skeleton, moving
        )
        self.radius = _MAX_CORRECTION * leg_length(motion.skeleton)
        self.scale = body_scale(motion.skeleton)
        self.nothing = _NOTHING * self.scale
        columns = max(k for foot in self.feet for anchor in foot.anchors for k in anchor.columns)
        self.labels = None if contacts is None else np.asarray(contacts, dtype=np.float64)
        if self.labels is not None and self.labels.shape != (motion.n_frames, columns + 1):
            need = f"({motion.n_frames}, {columns + 1})"
            raise MotionError(f"contacts have shape {self.labels.shape}; expected {need}")
        self.places = [[self._place(*anchor[:2]) for anchor in foot.anchors] for foot in self.feet]
        self.stands = []
        for foot, places in zip(self.feet, self.places):
            labels = [None] * len(places)
            if self.labels is not None:
                labels = [self.labels[:, anchor.columns].mean(axis=1) for anchor in foot.anchors]
            own = zip(places, labels)
            self.stands.append([contact_frames(at, self.fps, self.scale, each) for at, each in own])

    def _place(self, joint: int, offset: np.ndarray) -> np.ndarray:
        """(T, 3) world positions of a point at an offset (3,) in a joint's frame, metres."""
        return self.positions[:, joint] + rotate_vectors(self.world[:, joint], offset)

    def locked(self, keep_path: bool) -> Motion:
        """Return the corrected motion; see `lock_feet`."""
        either = [np.any([mask for mask, _ in foot], axis=0) for foot in self.stands]
        standing = np.stack(either, axis=1)
        if not standing.any():
            return self.motion
        shift = np.zeros((self.motion.n_frames, 3))
        if not keep_path:
            left, right = (np.mean(places, axis=0) for places in self.places)
            shift -= horizontal_drift(left, right, standing, self.fps)
            heights = []
            for places, stands in zip(self.places, self.stands):
                above = [place[:, 1] - floor for place, (_, floor) in zip(places, stands)]
                # The ball takes precedence, because the heel may be lifted.
                heights.append(np.where(stands[-1][0], above[-1], above[0]))
            shift[:, 1] -= height_error(np.stack(heights, axis=1), standing, self.fps)
        goals = [self._goal(side, shift) for side in (0, 1)]
        shift[:, 1] -= self._hip_drop(goals, shift)
        return self._posed(goals, shift)

    def _goal(self, side: int, shift: np.ndarray) -> Goal:
        """Return the correction that keeps heel and ball of a foot in place while they stand.

        `shift` (T, 3) moves the hips.
        """
        ankle = self.positions[:, self.feet[side].limb[2]] + shift
        places = [place + shift for place in self.places[side]]
        along = places[-1] - places[0]
        length = max(float(np.linalg.norm(along, axis=1).mean()), self.nothing)
        max_turn = _MAX_TURN * length
        offsets, holds = self._pinned(places, self.stands[side], length, max_turn)
        turn = np.tile(IDENTITY, (len(ankle), 1))
        moved = offsets[0]
        if len(places) > 1:
            # A correction of only one anchor moves the foot as a whole.
            heel = offsets[0] + (1 - holds[0]) * offsets[1]
            ball = offsets[1] + (1 - holds[1]) * offsets[0]
            # If the two pins need too large a turn, or do not match the length of the foot, the
            # ball takes precedence, because people turn on it.
            first = holds[1]
            excess = ball - heel - soft_clamp(ball - heel, max_turn)
            heel, ball = heel + first * excess, ball - (1 - first) * excess
            turn = shortest_arc(_unit(along), _unit(along + ball - heel))
            about_heel = heel + rotate_vectors(turn, ankle - places[0]) - (ankle - places[0])
            about_ball = ball + rotate_vectors(turn, ankle - places[1]) - (ankle - places[1])
            moved = first * about_ball + (1 - first) * about_heel
        moved = moved + shift
        moved[:, 1] += self._lift(side, (moved, turn))
        return moved, turn

    def _pinned(
        self,
        places: list[np.ndarray],
        stands: list[tuple[np.ndarray, float]],
        length: float,
        max_turn: float,
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return, for each anchor, its corrections (T, 3) and the weight (T, 1) of its pin.

        `places` are each anchor's world positions (T, 3), `stands` its contact mask (T,) and floor
        height; `max_turn` is the foot's largest turn, in metres at its length.
        """
        # Direction of the foot on the ground, also while its heel is lifted.
        level = (places[-1] - places[0]) * [1, 0, 1]
        level *= length / np.maximum(np.linalg.norm(level, axis=1, keepdims=True), length / 2)
        offsets, holds, lifts = list[np.ndarray](), list[np.ndarray](), np.zeros(len(level))
        # The ball first, because the heel may be lifted while the ball stands.
        for place, (mask, floor) in zip(places[::-1], stands[::-1], strict=True):
            if self.labels is None:
                mask = include_landing(mask, place, floor, self.fps, self.scale)
            spans = split_at_movement(
                contact_spans(mask, self.fps),
                np.stack([place, level], axis=1),
                self.fps,
                np.array([self.radius, max_turn]),
            )
            fastest = FASTEST * self.scale
            offset, hold = pin(place, spans, floor, self.fps, self.radius, fastest, lifts)
            offsets.insert(0, offset)
            holds.insert(0, hold[:, None])
            height = np.maximum(places[0][:, 1] + offset[:, 1] - stands[0][1], 0)
            # Lower heights are noise, and suppressed.
            lifts = hold * (height**3 / (height**2 + (_LIFT * self.scale) ** 2))
        return offsets, holds

    def _lift(self, side: int, goal: Goal) -> np.ndarray:
        """(T,) lift of the foot that keeps its points from sinking deeper than before, metres."""
        foot, (moved, turn) = self.feet[side], goal
        before = np.stack([self._place(*point) for point in foot.sole], axis=1)
        flat = np.any([mask for mask, _ in self.stands[side]], axis=0)
        floors = np.median(before[flat, :, 1], axis=0) if flat.any() else before[..., 1].max(axis=0)
        ankle = self.positions[:, foot.limb[2], None]
        after = ankle + moved[:, None] + rotate_vectors(turn[:, None], before - ankle)
        if foot.toe is not None:
            toe = self.positions[:, foot.toe, None]
            at = ankle + moved[:, None] + rotate_vectors(turn[:, None], toe - ankle)
            tips = np.s_[:, len(foot.sole) - foot.n_toes :]
            after[tips] = at + rotate_vectors(_yaw(turn)[:, None], before[tips] - toe)
        deeper = np.minimum(before[..., 1], floors) - after[..., 1]
        return np.maximum(deeper.max(axis=1), 0)

    def _hip_drop(self, goals: list[Goal], shift: np.ndarray) -> np.ndarray:
        """(T,) smooth lowering of the hips that brings both feet within reach, metres."""
        low = np.zeros(len(shift))
        for foot, (moved, _) in zip(self.feet, goals):
            hip, knee, ankle = (self.positions[:, j] for j in foot.limb)
            length = np.linalg.norm(knee - hip, axis=1) + np.linalg.norm(ankle - knee, axis=1)
            most = np.maximum(np.linalg.norm(ankle - hip, axis=1), STRETCH * length)
            low = np.maximum(low, too_high(hip + shift - ankle - moved, most))
        low = np.where(low > self.nothing, low, 0)
        low = reachable(low, _MAX_DROP * length, 0 * low, 0.5)
        return smooth_upper_envelope(low, round(HIP_DROP_SECONDS * self.fps))

    def _posed(self, goals: list[Goal], shift: np.ndarray) -> Motion:
        """Return the motion with legs solved for the goals and hips moved by `shift` (T, 3)."""
        changed, limbs = np.linalg.norm(shift, axis=1) > self.nothing, []
        # Ankles and toes keep their world rotations, turned with the foot.
        for foot, (moved, turn) in zip(self.feet, goals):
            changed |= np.linalg.norm(moved, axis=1) > self.nothing
            changed |= np.linalg.norm(turn[:, :3], axis=1) > _NOTHING
            places = self.positions[:, foot.limb]
            ankle = multiply_quaternions(turn, self.world[:, foot.limb[2]])
            target = places[:, 2] + moved
            limbs.append(Reach(foot.limb[:2], foot.limb[2], places + shift[:, None], target, ankle))
        rotations = bend_limbs(self.skeleton, self.rotations, self.world, limbs, hinge=True)
        world = global_rotations(rotations, self.skeleton)
        for foot, (_, turn) in zip(self.feet, goals):
            if foot.toe is not None:
                back = invert_quaternions(world[:, self.skeleton.parents[foot.toe]])
                toe = multiply_quaternions(_yaw(turn), self.world[:, foot.toe])
                rotations[:, foot.toe] = multiply_quaternions(back, toe)
        locked = self.motion.rotations.copy()
        locked[:, self.kept] = np.where(changed[:, None, None], rotations, self.rotations)
        return self._shifted(replace(self.motion, rotations=locked), shift)

    def _shifted(self, motion: Motion, shift: np.ndarray) -> Motion:
        """Return the whole motion with the body moved by `shift` (T, 3) at its carrying joint."""
        names, moving = self.skeleton.names, dict(motion.joint_translations)
        above = [set(self.skeleton.ancestors(foot.limb[0])) for foot in self.feet]
        carrier = max((j for j in above[0] & above[1] if names[j] in moving), default=0)
        if not carrier:
            return replace(motion, translation=motion.translation + shift)
        back = invert_quaternions(self.world[:, self.skeleton.parents[carrier]])
        moving[names[carrier]] = moving[names[carrier]] + rotate_vectors(back, shift)
        return replace(motion, joint_translations=moving)


def _yaw(turn: np.ndarray) -> np.ndarray:
    """(..., 4) components of rotations about the vertical."""
    return normalize_quaternions(turn * [0.0, 1.0, 0.0, 1.0])


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)


_STEADY = 0.2
"""Seconds (standard deviation) over which foot speeds are smoothed before they are compared."""
_SWAY = 1.0
"""Seconds (standard deviation); faster movement is sway, which the legs absorb, and not drift."""


def horizontal_drift(
    left: np.ndarray, right: np.ndarray, stands: np.ndarray, fps: float
) -> np.ndarray:
    """(T, 3) horizontal distance that the standing feet have slid so far, without sway, metres.

    If both feet stand, the drift is the common part of their velocities; if one stands, it is that
    foot's velocity. Zero in frame 0.

    Args:
        left: (T, 3) positions of the left foot, metres.
        right: (T, 3) positions of the right foot, metres.
        stands: (T, 2) bool, true if the left or right foot stands.
        fps: frames per second.
    """
    both = np.stack([left, right], axis=1)
    standing = np.zeros(stands.shape)
    standing[1:] = stands[1:] & stands[:-1]
    steps = np.diff(both, axis=0, prepend=both[:1]) * [1, 0, 1] * standing[..., None]
    weight = gaussian_filter1d(standing, _STEADY * fps, axis=0, mode="constant")[..., None]
    steady = gaussian_filter1d(steps, _STEADY * fps, axis=0, mode="constant")
    steady /= np.maximum(weight, 1e-6)
    return gaussian_smoothed(np.cumsum(_common(steady, standing), axis=0), _SWAY * fps)


def height_error(heights: np.ndarray, stands: np.ndarray, fps: float) -> np.ndarray:
    """(T,) smoothed height above the floor that is common to the standing feet, metres.

    `heights` (T, 2) are above the feet's standing heights, metres; `stands` as in
    `horizontal_drift`.
    """
    standing = stands.astype(float)
    common = _common(heights[..., None] * standing[..., None], standing)
    weight = gaussian_smoothed(standing.max(axis=1), _SWAY * fps)
    return gaussian_smoothed(common[:, 0], _SWAY * fps) / np.maximum(weight, 0.5)


def _common(both: np.ndarray, standing: np.ndarray) -> np.ndarray:
    """(T, D) common part of two vectors (T, 2, D), one a foot.

    If both feet stand, it points along the mean and is as long as the shorter of the projections
    onto it. If one stands, it is that foot's vector.
    """
    alone = (both * standing[..., None]).sum(axis=1)
    mean = both.mean(axis=1)
    direction = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    least = (both * direction[:, None]).sum(axis=2).min(axis=1)
    together = direction * np.maximum(least, 0)[:, None]
    return np.where(standing.all(axis=1, keepdims=True), together, alone)


Span = tuple[int, int]
"""First frame, and the frame after the last."""

EDGE_SPEED = 0.4
"""m/s; a point just above the floor that is slower is landing or leaving."""
MAX_LABEL_SPEED = 0.6
"""m/s; a predicted contact of a faster foot is ignored."""
TREMBLE_SECONDS = 1 / 30
"""Seconds (standard deviation) of the smoothing that removes trembling from foot speed."""
NEAR = 0.03
"""Metres; a point farther from its standing height is not on the floor."""
SHORTEST = 0.1
"""Seconds; shorter spans are noise, and so are shorter gaps between them."""


def point_speed(positions: np.ndarray, fps: float) -> np.ndarray:
    """(T,) speed of a point (T, 3) since the previous frame, m/s; frame 0 copies frame 1."""
    speed = np.zeros(len(positions))
    speed[1:] = np.linalg.norm(np.diff(positions, axis=0), axis=1) * fps
    speed[0] = speed[min(1, len(speed) - 1)]
    return speed


def gaussian_smoothed(path: np.ndarray, frames: float) -> np.ndarray:
    """(T, ...) Gaussian smoothing, padded by point reflection so that linear drift is kept.

    `frames` is the standard deviation.
    """
    margin = round(4 * frames)
    around = ((margin, margin),) + ((0, 0),) * (path.ndim - 1)
    padded = np.pad(path, around, mode="reflect", reflect_type="odd")
    return gaussian_filter1d(padded, frames, axis=0)[margin : margin + len(path)]


def contact_frames(
    positions: np.ndarray, fps: float, scale: float, labels: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """Find the frames in which a point of a foot is on the floor, and its height there.

    Args:
        positions: (T, 3) positions of the point, metres.
        fps: frames per second.
        scale: `body_scale` of the body.
        labels: (T,) predicted contact, above 0.5 if it stands. Without labels the speed decides:
            the lower of the point's and of its smoothed positions'.

    Returns:
        (T,) bool, and the height of the floor under the point: the median over the frames in which
        it stands, which is robust to steps and jumps. For a point that never stands it is the 10th
        percentile of its height.
    """
    speed = point_speed(positions, fps)
    if labels is None:
        steady = gaussian_smoothed(positions, TREMBLE_SECONDS * fps)
        speed = np.minimum(speed, point_speed(steady, fps))
    speed /= scale
    if labels is None:
        stands = speed < CONTACT_SPEED
    else:
        stands = (labels > 0.5) & (speed < MAX_LABEL_SPEED)
    height = positions[:, 1]
    floor = float(np.median(height[stands]) if stands.any() else np.quantile(height, 0.1))
    return stands & (np.abs(height - floor) < NEAR * scale), floor


def include_landing(
    stands: np.ndarray, positions: np.ndarray, floor: float, fps: float, scale: float
) -> np.ndarray:
    """(T,) bool, true if a point stands, lands or leaves.

    A foot crosses `CONTACT_SPEED` some frames after it lands and before it leaves. Up to `SHORTEST`
    before and after are added in which the point is slow and low. `stands` (T,) and `floor` are
    results of `contact_frames`, which takes the other arguments too.
    """
    low = np.abs(positions[:, 1] - floor) < NEAR / 2 * scale
    settles = stands | (low & (point_speed(positions, fps) < EDGE_SPEED * scale))
    frames = max(round(SHORTEST * fps), 1)
    return binary_dilation(stands, iterations=frames, mask=settles)


def contact_spans(stands: np.ndarray, fps: float) -> list[Span]:
    """Return the spans of a mask (T,), with short gaps closed and short spans removed."""
    shortest = max(round(SHORTEST * fps), 1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], stands.astype(np.int8), [0]])))
    spans: list[Span] = []
    for start, stop in edges.reshape(-1, 2).tolist():
        if spans and start - spans[-1][1] < shortest:
            start = spans.pop()[0]
        spans.append((start, stop))
    return [span for span in spans if span[1] - span[0] >= shortest]


def split_at_movement(
    spans: list[Span], positions: np.ndarray, fps: float, radius: np.ndarray
) -> list[Span]:
    """Split spans until the points stay within a radius of their mean positions.

    A foot that shuffles or turns stands at several places in turn. A span that is too wide is cut
    at its fastest frame, but never into pieces that are too short.

    Args:
        spans: spans in which the foot stands.
        positions: (T, N, 3) positions of N points, metres.
        fps: frames per second.
        radius: (N,) metres.
    """
    shortest = max(round(2 * SHORTEST * fps), 2)
    shares = positions / np.asarray(radius)[:, None]
    speed = np.max([point_speed(share, fps) for share in np.moveaxis(shares, 1, 0)], axis=0)
    kept, left = [], spans[::-1]
    while left:
        start, stop = left.pop()
        inside = shares[start:stop]
        away = np.linalg.norm(inside - inside.mean(axis=0), axis=2).max()
        if away <= 1 or stop - start < 2 * shortest:
            kept.append((start, stop))
            continue
        cut = start + shortest + int(speed[start + shortest : stop - shortest + 1].argmax())
        left += [(cut, stop), (start, cut)]
    return kept


BLEND = 0.15
"""Least time in seconds over which a correction is blended in and out."""
FASTEST = 0.3
"""Largest speed of a correction while it is blended, m/s on the reference body; large corrections
take longer than `BLEND`."""
_SOFTNESS = 0.25
"""Last share of the radius over which a correction is compressed."""


def pin(
    places: np.ndarray,
    spans: list[Span],
    floor: float,
    fps: float,
    radius: float,
    fastest: float,
    lifts: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Pin a point at its mean position on the floor in each span.

    A point that descends to the floor at the beginning of a span, or rises at its end, keeps its
    height there: pulling a foot in flight down to the floor would make it slide.

    Args:
        places: (T, 3) positions of the point, metres.
        spans: spans in which it stands, in order.
        floor: height of the point when it stands.
        fps: frames per second.
        radius: largest correction, metres; larger ones are compressed.
        fastest: m/s, `FASTEST` times the `body_scale` of the rig.
        lifts: (T,) intended height above the floor, such as that of a lifted heel, metres.

    Returns:
        (T, 3) corrections to add to `places`, and (T,) weight of the pin: 1 in spans, 0 far away.
    """
    offset, hold = np.zeros_like(places), np.zeros(len(places))
    for start, stop in spans:
        inside = places[start:stop]
        target = np.tile(inside.mean(axis=0), (stop - start, 1))
        rolled = _rolled(inside[:, 1], start > 0, stop < len(places), fps)
        target[:, 1] = floor + np.maximum(rolled, lifts[start:stop])
        offset[start:stop] = soft_clamp(target - inside, radius)
        hold[start:stop] = 1
    for gap in pairwise([(0, 0), *spans, (len(places), len(places))]):
        _fill_gap(offset, hold, *gap, fps, fastest)
    return offset, hold


def _rolled(height: np.ndarray, lands: bool, leaves: bool, fps: float) -> np.ndarray:
    """(T,) height above the floor that a point keeps in a span as it descends and rises, metres.

    `height` is (T,); `lands` and `leaves`: the motion shows the beginning and the end of the span.
    """
    above = np.maximum(height - np.median(height), 0)
    near = 1 - smoothstep(np.clip(np.arange(len(above)) / (BLEND * fps) - 1, 0, 1))
    landing = near * np.minimum.accumulate(above) * lands
    leaving = near[::-1] * np.minimum.accumulate(above[::-1])[::-1] * leaves
    return np.maximum(landing, leaving)


def soft_clamp(offset: np.ndarray, radius: float) -> np.ndarray:
    """(T, 3) offsets limited to length `radius`; those far below it do not change."""
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    allowed = reachable(length, np.array(radius), np.array(0.0), _SOFTNESS)
    return offset * (allowed / np.maximum(length, 1e-9))


def _fill_gap(
    offset: np.ndarray, hold: np.ndarray, before: Span, after: Span, fps: float, fastest: float
) -> None:
    """Fill the gap between two spans in place, by blending to zero and back or straight across.

    Changes the corrections `offset` (T, 3) and the pin's weight `hold` (T,). A gap too short for a
    straight blend at `fastest` m/s is extended into both spans, by half of each at most.
    """
    n_frames = len(offset)
    start, stop = before[1], after[0]
    first = offset[start - 1] if start else np.zeros(3)
    last = offset[stop] if stop < n_frames else np.zeros(3)
    out = _frames(first, fps, fastest) if start else 0
    into = _frames(last, fps, fastest) if stop < n_frames else 0
    if stop - start >= out + into:
        for edge, step, count, span in ((start, 1, out, before), (stop - 1, -1, into, after)):
            outside = edge + step * np.arange(count)
            share = 1 - smoothstep((1 + np.arange(count)) / (count + 1))
            from_span = first if step > 0 else last
            offset[outside] = from_span * share[:, None]
            hold[outside] = share
            if from_span[1] < 0:
                # Lower the foot only while it stands; pulled to the floor in flight it would slide.
                offset[outside, 1] = 0
                count = min(count, (span[1] - span[0]) // 2)
                inside = edge - step * (1 + np.arange(count))
                offset[inside, 1] *= smoothstep((1 + np.arange(count)) / (count + 1))
        return
    if not start or stop == n_frames:
        # No span on one side: keep the correction of the other.
        frames = np.arange(start, stop)
        offset[frames], hold[frames] = (last, 1.0) if not start else (first, 1.0)
        return
    missing = _frames(last - first, fps, fastest) - (stop - start)
    if missing > 0:
        start -= min(-(-missing // 2), (before[1] - before[0]) // 2)
        stop += min(-(-missing // 2), (after[1] - after[0]) // 2)
        first, last = offset[start - 1], offset[stop]
    share = smoothstep((1 + np.arange(stop - start)) / (stop - start + 1))[:, None]
    offset[start:stop] = first + share * (last - first)
    hold[start:stop] = 1


def _frames(change: np.ndarray, fps: float, fastest: float) -> int:
    """Return the frames over which to blend a correction (3,).

    The largest slope of `smoothstep` is 1.5 times its mean slope.
    """
    seconds = max(BLEND, 1.5 * float(np.linalg.norm(change)) / fastest)
    return max(round(seconds * fps), 1)
