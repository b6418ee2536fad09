"""Physical plausibility: speed, acceleration and jerk, feet, and joint limits.

Derivatives are frame differences, as in the GENEA challenges, or independent of the frame rate. On
captured motion differences measure noise and grow with the frame rate: 30 and 60 fps of one
recording differ several times over. To compare frame rates, paths are low-passed first (4th-order
Butterworth, forwards and backwards); the derivative is that of the quintic spline through them,
which does not depend on the positions of the frames.

A foot point touches the ground when it is near its standing height. That height is estimated from
the frames in which the point is at rest, so that neither the floor of a file nor the position of
the ankle joint in the foot has to be known; a generated motion uses the heights of its recording.

Rigs differ in their joint axes, so anatomical tables of Euler angles do not apply. Instead, joint
limits are learned from recordings: ranges of each component of the rotation vector relative to a
joint's mean rotation.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from gesturekit.corpus.alignment import arm_speed
from gesturekit.errors import MotionError
from gesturekit.evaluation.metrics.inputs import check_frames
from gesturekit.motion import Motion
from gesturekit.motion.contacts import contact_labels, foot_positions
from gesturekit.motion.model_joints import first_moving_joint
from gesturekit.motion.parts import body_joints, find_parts, is_upper_body
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import (
    invert_quaternions,
    mean_quaternion,
    multiply_quaternions,
    rotation_vector_from_quaternion,
)

CUTOFF = 6.0
"""Hz; the -6 dB frequency of the low-pass, above the frequencies of gestures."""
BINS = np.linspace(0.0, 0.49, 50)
"""Edges of GENEA's histogram bins, m/s on the reference body."""
NEAR = 0.025
"""H of Zhang et al. 2018: height above standing from which a foot point is in the air, metres on
the reference body."""
MEAN_FRAMES = 100_000
"""Frames of recordings that the mean rotations of `JointLimits` are taken of."""
MARGIN = np.deg2rad(5.0)
"""Radians by which a joint may exceed its recorded range."""
FAR = np.deg2rad(30.0)
"""Radians beyond its limits from which a joint is far beyond them."""

_ORDER = 4
_DEGREE = 5


def wrist_speed(motion: Motion) -> np.ndarray:
    """Return the mean speed of both wrists in the world, from each frame to the next.

    Alexanderson et al. 2023 (section 5.3) plot its distribution.

    Returns:
        (T - 1,) metres per second.

    Raises:
        MotionError: fewer than 2 frames, or see `wrist_positions`.

    Examples:
        A body that is carried along at 1 m/s:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (30, rig.n_joints, 1))
        >>> carried = gk.Motion(rig, still, [(0, 0, k / 30) for k in range(30)], 30)
        >>> round(float(wrist_speed(carried).mean()), 6)
        1.0
    """
    steps = derivative(wrist_positions(motion), motion.fps, 1, None)
    return np.linalg.norm(steps, axis=-1).mean(axis=1)


def wrist_positions(motion: Motion) -> np.ndarray:
    """Return the (T, 2, 3) world positions of the left and the right wrist, metres.

    On a rig that ends at the elbows, they are those of the forearms' end sites.

    Raises:
        MotionError: arms that cannot be identified, or a forearm without an end.
    """
    skeleton, places = motion.skeleton, []
    for side, arm in find_parts(skeleton).arms.items():
        if arm.wrist is not None:
            places.append(motion.positions(arm.wrist))
        elif arm.elbow in skeleton.end_sites:
            places.append(motion.end_positions()[arm.elbow][:, 0])
        else:
            raise MotionError(f"the rig has no {side} wrist, and so no hand to measure")
    return np.stack(places, axis=1)


def joint_speed(motion: Motion, joints: Sequence[str] | None = None) -> np.ndarray:
    """Return the speed of joints in the world, from each frame to the next.

    Args:
        motion: any frame rate.
        joints: names; None for the body joints (no fingers, no end joints).

    Returns:
        (T - 1, J) metres per second.

    Raises:
        MotionError: fewer than 2 frames, or joints that cannot be identified.

    Examples:
        A joint that moves by 0.1 m, then by 0.2 m, in frames of 1/30 s:

        >>> rig = gk.Skeleton(("hips",), (-1,), [[0, 0, 0]])
        >>> still = np.tile([0.0, 0, 0, 1], (3, 1, 1))
        >>> motion = gk.Motion(rig, still, [(0, 0, 0), (0.1, 0, 0), (0.1, 0.2, 0)], 30)
        >>> joint_speed(motion, ["hips"]).round(6).tolist()
        [[3.0], [6.0]]
    """
    steps = derivative(joint_paths(motion, joints), motion.fps, 1, None)
    return np.linalg.norm(steps, axis=-1)


def relative_speed(motion: Motion, joints: Sequence[str] | None = None) -> np.ndarray:
    """Return (T - 1, J) `joint_speed` divided by `body_scale`: m/s on the reference body."""
    return joint_speed(motion, joints) / body_scale(motion.skeleton)


@dataclass
class SpeedHistogram:
    """Histogram of joint speeds as in the GENEA challenges, in bins of 1 cm/s up to 49 cm/s.

    Attributes:
        counts: (49,) values in each bin, m/s on the reference body.
        beyond: number of faster values, which are not in the distribution.

    Examples:
        3 m/s is beyond the last bin:

        >>> histogram = SpeedHistogram.of([np.array([0.002, 0.005, 0.015, 3.0])])
        >>> histogram.counts[:3].tolist(), histogram.beyond
        ([2, 1, 0], 1)
    """

    counts: np.ndarray = field(default_factory=lambda: np.zeros(len(BINS) - 1, dtype=np.int64))
    beyond: int = 0

    @classmethod
    def of(cls, speeds: Iterable[np.ndarray]) -> SpeedHistogram:
        """Return the histogram of the speeds (any shape) of several clips."""
        counted = ((np.histogram(part, BINS)[0], np.size(part)) for part in speeds)
        return cls.sum_of(cls(counts, int(size - counts.sum())) for counts, size in counted)

    @classmethod
    def sum_of(cls, histograms: Iterable[SpeedHistogram]) -> SpeedHistogram:
        """Return the sum of histograms."""
        whole = cls()
        for histogram in histograms:
            whole.counts += histogram.counts
            whole.beyond += histogram.beyond
        return whole


def hellinger(one: SpeedHistogram, other: SpeedHistogram) -> float:
    """Return the Hellinger distance sqrt(1 - Σ sqrt(h₁ h₂)): 0 for equal, 1 for disjoint ones.

    Speeds of all joints are pooled, as in genea_numerical_evaluations.

    Raises:
        MotionError: an empty histogram.

    Examples:
        Equal histograms, and two that have no bin in common:

        >>> slow, fast = (SpeedHistogram.of([np.array([speed])]) for speed in (0.105, 0.305))
        >>> hellinger(slow, slow), round(hellinger(slow, fast), 6)
        (0.0, 1.0)
    """
    if not one.counts.sum() or not other.counts.sum():
        raise MotionError(f"no joint is slower than {BINS[-1]:g} m/s, so that none is counted")
    roots = [np.sqrt(h.counts / h.counts.sum()) for h in (one, other)]
    # 1 - Σ sqrt(h1 h2) = Σ (sqrt h1 - sqrt h2)² / 2, which is exactly 0 for equal ones.
    return float(np.linalg.norm(roots[0] - roots[1]) / np.sqrt(2.0))


def speed_distance(motion: Motion, recording: Motion, joints: Sequence[str]) -> float:
    """Return `hellinger` of the joint speeds of a motion and its recording.

    Raises:
        MotionError: see `hellinger`.

    Examples:
        A recording against itself, and a body that never moves against one at 0.3 m/s:

        >>> rig = gk.Skeleton(("hips",), (-1,), [[0, 1, 0]])
        >>> still, path = np.tile([0.0, 0, 0, 1], (9, 1, 1)), np.arange(9)[:, None] * [0.0101, 0, 0]
        >>> stands, goes = (gk.Motion(rig, still, speed * path, 30) for speed in (0, 1))
        >>> speed_distance(goes, goes, ["hips"]), round(speed_distance(stands, goes, ["hips"]), 6)
        (0.0, 1.0)
    """
    both = (SpeedHistogram.of([relative_speed(m, joints)]) for m in (motion, recording))
    return hellinger(*both)


def acceleration(
    motion: Motion, *, cutoff: float | None = None, joints: Sequence[str] | None = None
) -> float:
    """Return the mean acceleration of the body joints (no fingers, no end joints), m/s².

    Without a cutoff: |Δ²p|·fps² in world space, averaged over frames and joints, the average
    acceleration of the GENEA challenges (genea_numerical_evaluations) in metres. It depends on the
    frame rate. With a cutoff (Hz): that of the low-passed motion (`derivative`), which can be
    compared across frame rates.

    Raises:
        MotionError: fewer than 3 frames (6 with a cutoff), or joints that cannot be identified.

    Examples:
        Along t² metres the acceleration is 2 m/s²:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (30, rig.n_joints, 1))
        >>> motion = gk.Motion(rig, still, [(0, 0, (k / 30) ** 2) for k in range(30)], 30)
        >>> round(acceleration(motion), 6)
        2.0
    """
    return _mean_derivative(motion, 2, cutoff, joints)


def jerk(
    motion: Motion, *, cutoff: float | None = None, joints: Sequence[str] | None = None
) -> float:
    """Return the mean jerk of the body joints (no fingers, no end joints), m/s³.

    Without a cutoff: |Δ³p|·fps³ in world space, averaged over frames and joints, the average jerk
    of the GENEA challenges (genea_numerical_evaluations) in metres. It also measures the noise of
    captured motion and grows with the frame rate: compare at one frame rate, or give a cutoff (Hz)
    to take the jerk of the low-passed motion (`derivative`).

    Raises:
        MotionError: fewer than 4 frames (6 with a cutoff), or joints that cannot be identified.

    Examples:
        Along t³ metres the jerk is 6 m/s³:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (30, rig.n_joints, 1))
        >>> motion = gk.Motion(rig, still, [(0, 0, (k / 30) ** 3) for k in range(30)], 30)
        >>> round(jerk(motion), 6)
        6.0
    """
    return _mean_derivative(motion, 3, cutoff, joints)


def max_speed(motion: Motion) -> float:
    """Return the largest speed of any body joint between two neighbouring frames, m/s.

    People of 1.7 m stay below about 10 m/s; more is a jump.

    Raises:
        MotionError: fewer than 2 frames, or body parts that cannot be identified.

    Examples:
        A jump of half a metre from one frame to the next at 30 fps:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (2, rig.n_joints, 1))
        >>> round(max_speed(gk.Motion(rig, still, [(0, 0, 0), (0, 0, 0.5)], 30)), 6)
        15.0
    """
    return float(joint_speed(motion).max())


def arm_speed_ratio(motion: Motion, recording: Motion) -> float:
    """Return the mean arm speed of a motion divided by that of a recording.

    Raises:
        MotionError: the recording's arms do not move.

    Examples:
        A recording that is played twice as fast:

        >>> from dataclasses import replace
        >>> recording = gk.load("demo").generate(seconds=2)
        >>> round(arm_speed_ratio(replace(recording, fps=2 * recording.fps), recording), 6)
        2.0
    """
    return _ratio(float(arm_speed(motion).mean()), float(arm_speed(recording).mean()), "arm speed")


def jerk_ratio(motion: Motion, recording: Motion) -> float:
    """Return the jerk of a motion divided by that of a recording, both at one frame rate.

    Raises:
        MotionError: the frame rates differ, or the recording does not move.

    Examples:
        The same movement of a body of twice the size:

        >>> recording = gk.load("demo").generate(seconds=2)
        >>> round(jerk_ratio(recording.scaled(2), recording), 6)
        2.0
    """
    if abs(motion.fps - recording.fps) > 1e-3 * recording.fps:
        raise MotionError(
            f"jerk at {motion.fps:g} fps cannot be compared with jerk at {recording.fps:g} fps; "
            "resample one of them"
        )
    return _ratio(jerk(motion), jerk(recording), "jerk")


def _ratio(value: float, reference: float, what: str) -> float:
    if reference == 0.0:
        raise MotionError(f"the recording's {what} is zero; there is nothing to compare with")
    return value / reference


def joint_paths(motion: Motion, joints: Sequence[str] | None = None) -> np.ndarray:
    """Return (T, J, 3) world positions of joints, metres; None takes the body joints.

    Raises:
        MotionError: a missing joint, or body parts that cannot be identified.
    """
    names = body_joints(motion.skeleton) if joints is None else joints
    return motion.positions()[:, [motion.skeleton.index(name) for name in names]]


def _mean_derivative(
    motion: Motion, order: int, cutoff: float | None, joints: Sequence[str] | None
) -> float:
    values = derivative(joint_paths(motion, joints), motion.fps, order, cutoff)
    return float(np.linalg.norm(values, axis=-1).mean())


def standing_heights(motion: Motion) -> np.ndarray:
    """Return the standing height of each foot point: the median over frames in contact.

    For a point without contact, the 10 % quantile of its heights.

    Returns:
        (F,) metres, in the order of `gesturekit.motion.contacts.foot_points`.

    Raises:
        MotionError: no legs, or none that can be identified.

    Examples:
        Of two bodies, one stands half a metre above the other; both hop for 5 of 30 frames:

        >>> rig = gk.load("demo").skeleton
        >>> still, hop = np.tile([0.0, 0, 0, 1], (30, rig.n_joints, 1)), np.zeros((30, 3))
        >>> hop[10:15, 1] = 0.2
        >>> low, high = (gk.Motion(rig, still, hop + [0, floor, 0], 30) for floor in (0, 0.5))
        >>> (standing_heights(high) - standing_heights(low)).round(6).tolist()
        [0.5, 0.5, 0.5, 0.5]
    """
    points = zip(_feet(motion)[..., 1].T, contact_labels(motion).T > 0, strict=True)
    return np.array([np.median(y[on]) if on.any() else np.quantile(y, 0.1) for y, on in points])


def foot_skate(motion: Motion, heights: np.ndarray | None = None) -> float:
    """Return the mean horizontal speed of the foot points near the ground, m/s.

    v·(2 - 2^(h/H)), h the height above standing clipped to 0 ... H = 2.5 cm on the reference
    body, averaged over frames and foot points: the foot skate of Zhang et al. 2018 (MANN), as a
    speed instead of a length per frame, so that it does not depend on the frame rate.

    Args:
        motion: at least 2 frames.
        heights: (F,) standing heights, metres; None takes the motion's own.

    Raises:
        MotionError: fewer than 2 frames, or no legs, or none that can be identified.

    Examples:
        A standing body that slides at 1 m/s:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (30, rig.n_joints, 1))
        >>> slide = gk.Motion(rig, still, [(0, 0, k / 30) for k in range(30)], 30)
        >>> round(foot_skate(slide), 6)
        1.0
    """
    feet = _feet(motion)
    steps = derivative(feet[..., [0, 2]], motion.fps, 1, None)
    above = 0.5 * (feet[1:, :, 1] + feet[:-1, :, 1]) - _standing(motion, heights)
    above = above / (NEAR * body_scale(motion.skeleton))
    weight = 2.0 - 2.0 ** np.clip(above, 0.0, 1.0)
    return float((np.linalg.norm(steps, axis=-1) * weight).mean())


def floor_penetration(motion: Motion, heights: np.ndarray | None = None) -> float:
    """Return the mean depth of the foot points below their standing heights, metres.

    Args:
        motion: any number of frames.
        heights: (F,) standing heights, metres; None takes the motion's own, which cannot
            detect that the whole body is too low.

    Raises:
        MotionError: no legs, or none that can be identified.

    Examples:
        A body that stands 3 cm lower than its recording:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (30, rig.n_joints, 1))
        >>> high, low = (gk.Motion(rig, still, np.full((30, 3), y), 30) for y in (0, -0.03))
        >>> round(floor_penetration(low, standing_heights(high)), 6)
        0.03
    """
    depth = _standing(motion, heights) - _feet(motion)[..., 1]
    return float(np.maximum(depth, 0.0).mean())


def feet_above_floor(motion: Motion, heights: np.ndarray | None = None) -> float:
    """Return the height of the lowest foot point above its standing height, metres.

    The 5 % quantile over frames: 0 where a foot is on the ground in 5 % of them. The ground is at
    height 0 where standing heights are below it, as of recordings relative to a camera.

    Args:
        motion: any number of frames.
        heights: (F,) standing heights, metres; None takes the motion's own, which cannot
            detect that the whole body is too high.

    Raises:
        MotionError: no legs, or none that can be identified.

    Examples:
        A body that floats half a metre above the floor of its recording:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (30, rig.n_joints, 1))
        >>> low, high = (gk.Motion(rig, still, np.full((30, 3), y), 30) for y in (1, 1.5))
        >>> round(feet_above_floor(high, standing_heights(low)), 6)
        0.5
    """
    ground = np.maximum(_standing(motion, heights), 0.0)
    lowest = (_feet(motion)[..., 1] - ground).min(axis=1)
    return max(0.0, float(np.quantile(lowest, 0.05)))


def bone_length_change(motion: Motion, joints: Sequence[str] | None = None) -> float:
    """Return the largest standard deviation over time of a bone's length, over its mean length.

    Bones end at joints below the first one that moves, and are 1 cm long or more.

    Args:
        motion: any number of frames.
        joints: names of the joints; None takes the body joints.

    Raises:
        MotionError: body parts that cannot be identified.

    Examples:
        A forearm that is 0.2 m long in one half of the frames, and 0.3 m in the other:

        >>> rig = gk.Skeleton(("elbow", "wrist"), (-1, 0), [[0, 0, 0], [0, 0.2, 0]])
        >>> moving = {"wrist": [(0, 0.2, 0), (0, 0.3, 0)]}
        >>> still = np.tile([0.0, 0, 0, 1], (2, 2, 1))
        >>> walk = [(0, 0, 0), (1, 0, 0)]
        >>> motion = gk.Motion(rig, still, walk, 30, joint_translations=moving)
        >>> round(bone_length_change(motion, rig.names), 6)
        0.2
    """
    rig, names = motion.skeleton, body_joints(motion.skeleton) if joints is None else joints
    below = {rig.names[j] for j in rig.descendants(first_moving_joint([motion]))} & set(names)
    places = [places for name, places in motion.joint_translations.items() if name in below]
    lengths = [np.linalg.norm(path, axis=-1) for path in places]
    return max((float(a.std() / a.mean()) for a in lengths if a.mean() > 0.01), default=0.0)


def _feet(motion: Motion) -> np.ndarray:
    """Return the (T, F, 3) foot points, metres; raise a MotionError if there are none."""
    feet = foot_positions(motion)
    if not feet.shape[1]:
        legs = "legs" if is_upper_body(motion.skeleton) else "two legs that can be identified"
        raise MotionError(f"the rig has no {legs}")
    return feet


def _standing(motion: Motion, heights: np.ndarray | None) -> np.ndarray:
    return standing_heights(motion) if heights is None else heights


@dataclass(frozen=True, eq=False)
class JointLimits:
    """The rotation range of each joint.

    Attributes:
        joints: names of J joints.
        mean: (J, 4) mean local rotations, quaternions.
        low: (J, 3) lower limits of the rotation vector from the mean, radians, with margin.
        high: (J, 3) upper limits.

    Examples:
        A joint that never turned may turn by 5° either way about each axis:

        >>> rig = gk.Skeleton(("head",), (-1,), [[0, 0, 0]])
        >>> still = gk.Motion(rig, np.tile([0.0, 0, 0, 1], (30, 1, 1)), np.zeros((30, 3)), 30)
        >>> limits = JointLimits.fit([still], ["head"])
        >>> np.degrees(limits.high).round(6).tolist()
        [[5.0, 5.0, 5.0]]
    """

    joints: tuple[str, ...]
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def fit(cls, motions: Iterable[Motion], joints: Sequence[str]) -> JointLimits:
        """Learn the limits from recordings of one rig, in bounded memory.

        The limits are exact; the mean rotations, from which they are measured, are those of the
        first `MEAN_FRAMES` frames (and the rest of their recording).

        Args:
            motions: recordings; iterated once.
            joints: names of the joints; leave out the root, which has no limits.

        Raises:
            MotionError: no motions, or a joint that one of them lacks.
        """
        rotations, first = (_rotations(motion, joints) for motion in motions), list[np.ndarray]()
        for part in rotations:
            first.append(part)
            if sum(map(len, first)) > MEAN_FRAMES:
                break
        if not first:
            raise MotionError("no recording to learn joint limits from")
        columns = np.concatenate(first).swapaxes(0, 1)
        mean = np.stack([mean_quaternion(column) for column in columns])
        low, high = np.inf, -np.inf
        for part in chain(first, rotations):
            away = _away(part, mean)
            low = np.minimum(low, away.min(axis=0))
            high = np.maximum(high, away.max(axis=0))
        return cls(tuple(joints), mean, low - MARGIN, high + MARGIN)

    def without(self, names: Collection[str | None]) -> JointLimits:
        """Return the limits of the other joints."""
        kept = [j for j, name in enumerate(self.joints) if name not in names]
        joints = tuple(self.joints[j] for j in kept)
        return JointLimits(joints, self.mean[kept], self.low[kept], self.high[kept])


def joint_limit_share(motion: Motion, limits: JointLimits) -> float:
    """Return the fraction of joints and frames beyond the limits on any axis, 0 to 1.

    Raises:
        MotionError: the motion lacks a joint of the limits.

    Examples:
        A joint that never turned in the recording is turned by 20° in a quarter of the frames:

        >>> rig = gk.Skeleton(("head",), (-1,), [[0, 0, 0]])
        >>> turns = np.tile([0.0, 0, 0, 1], (40, 1, 1))
        >>> limits = JointLimits.fit([gk.Motion(rig, turns, np.zeros((40, 3)), 30)], ["head"])
        >>> turns[30:, 0, 2:] = np.sin(np.deg2rad(10)), np.cos(np.deg2rad(10))
        >>> joint_limit_share(gk.Motion(rig, turns, np.zeros((40, 3)), 30), limits)
        0.25
    """
    return float(_beyond(motion, limits).mean())


def worst_joint(motion: Motion, upper_limits: JointLimits) -> float:
    """Return the largest fraction of frames, over joints, in which one is far beyond its limits.

    Far is `FAR` or more; 0 to 1. A head that is turned round is one of many joints.

    Args:
        motion: a motion that has the joints.
        upper_limits: limits of the joints to ask; reports take those of the upper body.

    Raises:
        MotionError: the motion lacks a joint of the limits.

    Examples:
        A joint that never turned in the recording is turned by 20° and by 60°:

        >>> rig = gk.Skeleton(("head",), (-1,), [[0, 0, 0]])
        >>> turns = np.tile([0.0, 0, 0, 1], (40, 1, 1))
        >>> limits = JointLimits.fit([gk.Motion(rig, turns, np.zeros((40, 3)), 30)], ["head"])
        >>> for frames, half in ((slice(10), 10), (slice(30, 40), 30)):
        ...     turns[frames, 0, 2:] = np.sin(np.deg2rad(half)), np.cos(np.deg2rad(half))
        >>> worst_joint(gk.Motion(rig, turns, np.zeros((40, 3)), 30), limits)
        0.25
    """
    return float(_beyond(motion, upper_limits, FAR).mean(axis=0).max(initial=0.0))


def _beyond(motion: Motion, limits: JointLimits, margin: float = 0.0) -> np.ndarray:
    """Return (T, J) True where a joint is beyond its limits by more than a margin, radians."""
    away = _away(_rotations(motion, limits.joints), limits.mean)
    return np.maximum(limits.low - away, away - limits.high).max(axis=-1) > margin


def _rotations(motion: Motion, joints: Sequence[str]) -> np.ndarray:
    return motion.rotations[:, [motion.skeleton.index(name) for name in joints]]


def _away(rotations: np.ndarray, mean: np.ndarray) -> np.ndarray:
    return rotation_vector_from_quaternion(
        multiply_quaternions(invert_quaternions(mean), rotations)
    )


def derivative(paths: np.ndarray, fps: float, order: int, cutoff: float | None) -> np.ndarray:
    """Return the time derivative of paths.

    Args:
        paths: (T, ...) positions, metres.
        fps: frames per second.
        order: 1 for velocity, 2 for acceleration, 3 for jerk.
        cutoff: Hz of the low-pass; None for differences of neighbouring frames, unfiltered.

    Returns:
        (T - order, ...) differences, or (T, ...) of the smoothed paths; m/s^order.

    Raises:
        MotionError: too few frames, or a cutoff at or above half the frame rate.
    """
    check_frames(paths, _DEGREE + 1 if cutoff is not None else order + 1, fps)
    if cutoff is None:
        return np.diff(paths, n=order, axis=0) * fps**order
    from scipy.interpolate import make_interp_spline

    times = np.arange(len(paths)) / fps
    return make_interp_spline(times, low_passed(paths, fps, cutoff), k=_DEGREE)(times, order)


def low_passed(paths: np.ndarray, fps: float, cutoff: float = CUTOFF) -> np.ndarray:
    """Low-pass paths (T, ...) at `cutoff` Hz without delay.

    Raises:
        MotionError: the cutoff is at or above half the frame rate.
    """
    from scipy.signal import butter, sosfiltfilt

    if not 0 < cutoff < fps / 2:
        raise MotionError(
            f"cutoff {cutoff:g} Hz cannot be filtered at {fps:g} fps; it must lie between 0 and "
            f"{fps / 2:g} Hz"
        )
    sos = butter(_ORDER, cutoff, fs=fps, output="sos")
    # Half a second of reflection at either end, at any frame rate.
    pad = min(len(paths) - 1, round(0.5 * fps))
    return sosfiltfilt(sos, paths, axis=0, padlen=pad)
