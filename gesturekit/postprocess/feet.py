"""Feet of a rig, the spans in which they stand, and corrections that pin them there.

Constants in metres and m/s are for the reference body; callers pass the `body_scale` of the rig.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter1d

from gesturekit.motion.contacts import CONTACT_SPEED, FootPoint, foot_points
from gesturekit.motion.ik import reachable
from gesturekit.motion.parts import SIDES, require_legs
from gesturekit.motion.parts.body_size import real_end_sites
from gesturekit.motion.resampling import smoothstep
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
    lifts: np.ndarray | float,
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
    lifts = np.broadcast_to(lifts, len(places))
    pinned = []
    for start, stop in spans:
        inside = places[start:stop]
        target = np.tile(inside.mean(axis=0), (stop - start, 1))
        rolled = _rolled(inside[:, 1], start > 0, stop < len(places), fps)
        target[:, 1] = floor + np.maximum(rolled, lifts[start:stop])
        offset[start:stop] = soft_clamp(target - inside, radius)
        hold[start:stop] = 1
        pinned.append((start, stop))
    gaps = zip([(0, 0), *pinned], [*pinned, (len(places), len(places))], strict=True)
    for before, after in gaps:
        _fill_gap(offset, hold, before, after, fps, fastest)
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
