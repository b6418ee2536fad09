"""Hand movement: metrics that compare how much, how far and how variedly the hands move.

All of them use body-centred motion: positions of upper-body joints relative to the pelvis, turned
in each frame so that the shoulders face +Z, at 25 fps, in metres. The hands are the wrist joints.
Thresholds in m/s are for a body of 1.7 m and grow with `body_scale`, like those of foot contacts;
all other lengths are the body's own. A rig that ends at the elbows has its hands at the forearms'
end sites.

Several motions are pooled: frames of all clips have equal weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from gesturekit.errors import EvaluationError, MotionError
from gesturekit.evaluation.metrics.inputs import at_rate, check_frames
from gesturekit.evaluation.metrics.physical import wrist_positions
from gesturekit.motion import Motion
from gesturekit.motion.parts import SIDES, body_joints, find_parts, upper_body
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.root_path import headings_of_sides
from gesturekit.motion.skeleton import GROUND, Skeleton

FPS = 25.0
"""Frame rate of all metrics of hand movement."""
SIGMA = 1.0
"""Standard deviation of the Gaussian that smooths velocities, frames."""
REST = 0.1
"""A hand rests below this speed, m/s on the reference body."""
STILL = 0.02
"""A hand is nearly still below this speed, m/s on the reference body."""
RANGE_WINDOW, RANGE_HOP = 2.0, 1.0
"""Windows of `HandMovement.range`, seconds."""
CALM_WINDOW, CALM_HOP = 5.0, 2.5
"""Windows of `calm_and_lively`, seconds."""

_NO_MOVEMENT = 1e-6  # m/s; less is rounding

Motions = Motion | Sequence[Motion]


@dataclass(frozen=True, eq=False)
class Hands:
    """Hands of a motion at 25 fps: all that metrics of hand movement need of it.

    Attributes:
        paths: (T, 2, 3) body-centred positions of the left and the right wrist, metres.
        scale: size of the body relative to the reference body.
    """

    paths: np.ndarray
    scale: float

    @classmethod
    def of(cls, motion: Motion | Hands) -> Hands:
        """Return the hands of a motion; see `hand_paths`."""
        if isinstance(motion, Hands):
            return motion
        return cls(hand_paths(motion), body_scale(motion.skeleton))

    @cached_property
    def speed(self) -> np.ndarray:
        """(T, 2) speed of both hands, m/s; see `hand_speed`."""
        return np.linalg.norm(velocities(self.paths), axis=-1)


Moving = TypeVar("Moving", bound="Motion | Hands")
HandMotions = Motions | Hands | Sequence[Hands]
"""Motions, or their hands alone."""
LEAST_SEEDS = 9
"""Seeds from which an interval between two ranks covers 80 %: those of the lowest and highest."""
NOMINAL = 80.0
"""Percent of clips between the ranks if the model is calibrated."""
_LEVEL_FLOOR = 0.01  # m/s, added to speeds before the logarithm
_BLIND_DRAWS = 1000


@dataclass(frozen=True)
class HandMovement:
    """Amount and variety of hand movement, over all frames and both hands.

    Attributes:
        q10, q50, q90, q99: quantiles of the hand speed, m/s.
        rest: share of (frame, hand) slower than `REST`.
        near_still: share of (frame, hand) slower than `STILL`.
        reach: sum over both hands of det(covariance of the hand's position)^(1/6), metres.
        range: standard deviation over mean of the hand speed's means over 2 s (hop 1 s): contrast
            of calm and lively stretches. NaN with fewer than two such windows or no movement.

    Examples:
        Hands that never move:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (75, rig.n_joints, 1))
        >>> found = hand_movement(gk.Motion(rig, still, np.zeros((75, 3)), 25))
        >>> round(found.q99, 6), found.rest, found.near_still, round(found.reach, 6)
        (0.0, 1.0, 1.0, 0.0)
    """

    q10: float
    q50: float
    q90: float
    q99: float
    rest: float
    near_still: float
    reach: float
    range: float


@dataclass(frozen=True)
class CalmAndLively:
    """Result of `calm_and_lively`.

    Attributes:
        r: Pearson's r of recorded and generated mean hand speed over windows.
        slope: slope of the least-squares line, generated over recorded.
        n: number of windows.

    Examples:
        A recording against itself:

        >>> recording = gk.load("demo").generate(seconds=12)
        >>> found = calm_and_lively(recording, [recording])
        >>> round(found.r, 6), round(found.slope, 6), found.n
        (1.0, 1.0, 3)
    """

    r: float
    slope: float
    n: int


def upper_joints(skeleton: Skeleton) -> tuple[str, ...]:
    """Return the names of spine, neck, head and arm joints (no fingers, face or end joints).

    Raises:
        MotionError: body parts that cannot be identified.

    Examples:
        >>> upper_joints(gk.load("demo").skeleton)[:6]
        ('Spine', 'Spine1', 'Spine2', 'Neck', 'Head', 'LeftShoulder')
    """
    known = set(body_joints(skeleton))
    return tuple(name for name in upper_body(skeleton) if name in known)


def body_centred(motion: Motion, joints: Sequence[str] | None = None) -> np.ndarray:
    """Return joint positions relative to the pelvis, turned so that the shoulders face +Z.

    The heading of a frame is perpendicular to the horizontal line through both shoulder joints;
    where that line is upright (the body lies on one side), it is interpolated.

    Args:
        motion: any frame rate; it is resampled to 25 fps.
        joints: names; None for `upper_joints`.

    Returns:
        (T, J, 3) metres.

    Raises:
        MotionError: a missing joint, or a rig whose pelvis and shoulders cannot be identified.

    Examples:
        A place in the world does not count:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (2, rig.n_joints, 1))
        >>> motion = gk.Motion(rig, still, [(0, 1, 0), (3, 1, 2)], 25)
        >>> body_centred(motion, ["LeftHand"]).round(2).tolist()
        [[[0.71, 0.46, 0.0]], [[0.71, 0.46, 0.0]]]
    """
    skeleton = motion.skeleton
    names = upper_joints(skeleton) if joints is None else joints
    positions = at_rate(motion, FPS).positions()
    points = positions[:, [skeleton.index(name) for name in names]]
    return _centred(points, positions, skeleton)


def _centred(points: np.ndarray, positions: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return world points (T, N, 3) in the body's axes, given the joints' positions (T, J, 3)."""
    parts = find_parts(skeleton)
    shoulders = [positions[:, skeleton.index(parts.arms[side].shoulder)] for side in SIDES]
    angle = headings_of_sides(shoulders[0] - shoulders[1])[:, None]
    pelvis = positions[:, skeleton.index(parts.pelvis), None]
    centred = points - pelvis
    x, z = (centred[..., axis] for axis in GROUND)
    sin, cos = np.sin(angle), np.cos(angle)
    return np.stack([cos * x - sin * z, centred[..., 1], sin * x + cos * z], axis=-1)


def hand_paths(motion: Motion) -> np.ndarray:
    """Return (T, 2, 3) body-centred positions of the left and the right wrist at 25 fps, metres.

    Raises:
        MotionError: a rig without wrists, or whose parts cannot be identified.

    Examples:
        A body with its arms held out to the sides:

        >>> rig = gk.load("demo").skeleton
        >>> motion = gk.Motion(rig, np.tile([0.0, 0, 0, 1], (1, rig.n_joints, 1)), [(5, 1, 0)], 25)
        >>> hand_paths(motion).round(2).tolist()
        [[[0.71, 0.46, 0.0], [-0.71, 0.46, 0.0]]]
    """
    motion = at_rate(motion, FPS)
    return _centred(wrist_positions(motion), motion.positions(), motion.skeleton)


def hand_speed(motion: Motion) -> np.ndarray:
    """Return (T, 2) speed of the left and the right hand at 25 fps, relative to the body, m/s.

    The velocity (central differences) is smoothed by a Gaussian of one frame.

    Raises:
        MotionError: a rig without wrists, or a motion of fewer than 2 frames at 25 fps.

    Examples:
        The same movement of a body of twice the size:

        >>> motion = gk.load("demo").generate(seconds=2)
        >>> np.allclose(hand_speed(motion.scaled(2)), 2 * hand_speed(motion))
        True
    """
    return Hands.of(motion).speed


def velocities(paths: np.ndarray) -> np.ndarray:
    """Return velocities of paths (T, ...) at 25 fps, smoothed by a Gaussian of one frame, m/s.

    Raises:
        MotionError: fewer than 2 frames.
    """
    from scipy.ndimage import gaussian_filter1d

    check_frames(paths, 2, FPS)
    steps = np.gradient(paths, 1 / FPS, axis=0)
    return gaussian_filter1d(steps, SIGMA, axis=0, mode="nearest")


def hand_movement(motions: HandMotions) -> HandMovement:
    """Measure how much, how far and how variedly the hands move.

    Args:
        motions: one motion, or several, pooled.

    Raises:
        MotionError: no motion, a rig without wrists, or fewer than 2 frames at 25 fps.

    Examples:
        The same movement of a body of twice the size reaches twice as far:

        >>> motion = gk.load("demo").generate(seconds=4)
        >>> round(hand_movement(motion.scaled(2)).reach / hand_movement(motion).reach, 6)
        2.0
    """
    hands = [Hands.of(motion) for motion in as_list(motions)]
    speeds = [one.speed for one in hands]
    q10, q50, q90, q99 = map(float, np.quantile(np.concatenate(speeds), (0.1, 0.5, 0.9, 0.99)))
    relative = np.concatenate([one.speed / one.scale for one in hands])
    rest, near_still = (float((relative < limit).mean()) for limit in (REST, STILL))
    reach = _reach(np.concatenate([one.paths for one in hands]))
    means = np.concatenate([_window_means(speed, RANGE_WINDOW, RANGE_HOP) for speed in speeds])
    moves = len(means) > 1 and means.mean() > _NO_MOVEMENT
    contrast = float(means.std() / means.mean()) if moves else np.nan
    return HandMovement(q10, q50, q90, q99, rest, near_still, reach, contrast)


def calm_and_lively(recorded: HandMotions, generated: Sequence[HandMotions]) -> CalmAndLively:
    """Compare calm and lively stretches of recorded and generated motion.

    Mean hand speed in windows of 5 s (hop 2.5 s), windows of all recordings pooled.

    Args:
        recorded: R recordings.
        generated: for each recording, the motion generated for it or several samples, whose speeds
            are averaged. Only frames that recording and sample both have are compared.

    Raises:
        MotionError: fewer than 3 windows, or recordings of constant speed.

    Examples:
        The same movement of a body of twice the size:

        >>> recording = gk.load("demo").generate(seconds=12)
        >>> found = calm_and_lively(recording, [recording.scaled(2)])
        >>> round(found.r, 6), round(found.slope, 6)
        (1.0, 2.0)
    """
    recorded = as_list(recorded)
    x, y = [], []
    for recording, samples in zip(recorded, generated, strict=True):
        speeds = [Hands.of(one).speed for one in (recording, *as_list(samples))]
        n = min(map(len, speeds))
        own, *others = (_window_means(speed[:n], CALM_WINDOW, CALM_HOP) for speed in speeds)
        x.append(own)
        y.append(np.mean(others, axis=0))
    x, y = np.concatenate(x), np.concatenate(y)
    if len(x) < 3 or len(x) * x.var() < 1e-12:
        raise MotionError(
            f"calm and lively stretches need at least 3 windows of {CALM_WINDOW:g} s (hop "
            f"{CALM_HOP:g} s) of different mean speed; the recordings have {len(x)}"
        )
    x, y = x - x.mean(), y - y.mean()
    slope = float(x @ y / (x @ x))
    r = float(x @ y / np.sqrt((x @ x) * (y @ y))) if y @ y > 1e-12 else 0.0
    return CalmAndLively(r, slope, len(x))


def as_list(motions: Moving | Sequence[Moving]) -> list[Moving]:
    """Return one or several motions as a list.

    Raises:
        MotionError: there is none.
    """
    motions = [motions] if isinstance(motions, Motion | Hands) else list(motions)
    if not motions:
        raise MotionError("no motion to measure")
    return motions


def _window_means(speed: np.ndarray, seconds: float, hop: float) -> np.ndarray:
    """Return (N,) means over windows of speed (T, 2); windows that are not full are left out."""
    width = round(seconds * FPS)
    starts = window_starts(len(speed), width, hop * FPS)
    sums = np.concatenate([[0.0], np.cumsum(speed.mean(axis=1))])
    return (sums[starts + width] - sums[starts]) / width


def window_starts(n_frames: int, width: int, hop: float) -> np.ndarray:
    """Return (N,) first frames of all full windows, `hop` frames apart, rounded down."""
    count = int(np.floor((n_frames - width) / hop)) + 1
    return np.floor(np.arange(max(0, count)) * hop).astype(int)


def _reach(paths: np.ndarray) -> float:
    """Return the reach of hands (T, 2, 3), metres; see `HandMovement`."""
    centred = paths - paths.mean(axis=0)
    covariance = np.einsum("thi,thj->hij", centred, centred) / len(paths)
    return float((np.maximum(np.linalg.det(covariance), 0.0) ** (1 / 6)).sum())


HAND_KEYS = (
    *("hand_q10", "hand_q50", "hand_q90", "hand_q99"),
    *("rest", "near_still", "reach", "speed_range"),
)
"""Keys of `definitions` of the fields of `HandMovement`."""


def hand_values(motion: HandMotions) -> dict[str, float]:
    """Return {key of `definitions`: value} of the hand movement of motions, pooled.

    A value that is not defined is NaN.

    Raises:
        MotionError: as `hand_movement`.

    Examples:
        Hands that never move:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (75, rig.n_joints, 1))
        >>> found = hand_values(gk.Motion(rig, still, np.zeros((75, 3)), 25))
        >>> round(found["hand_q50"], 6), found["rest"]
        (0.0, 100.0)
    """
    values = dict(zip(HAND_KEYS, astuple(hand_movement(motion)), strict=True))
    return values | {key: 100.0 * values[key] for key in ("rest", "near_still")}


@dataclass(frozen=True)
class Calibration:
    """Recorded levels of clips beside those of many seeds.

    Speech does not tell everything about a motion. A calibrated model draws the rest, so that the
    recorded clip is one more draw: its rank among those of many seeds is uniform.

    Attributes:
        coverage: percent of clips whose recorded level lies within the ranks that cover `NOMINAL`
            percent, such as the second lowest and the second highest of 19 seeds.
        spread: standard deviation between the seeds of a clip, over that between recorded clips.
        sharpness: mean width of those intervals, over that of draws from the speaker's clips, which
            ignore the speech; 1 for such draws, less for a model that listens.
        clips: number of clips.
        seeds: number of seeds that are used.
    """

    coverage: float
    spread: float
    sharpness: float
    clips: int
    seeds: int


def hand_level(motion: Motion | Hands) -> float:
    """Return the level of a clip: the logarithm of its mean hand speed, relative to the body.

    Raises:
        MotionError: a rig without wrists, or fewer than 2 frames at 25 fps.

    Examples:
        Hands that never move, ln(0.01):

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (75, rig.n_joints, 1))
        >>> round(hand_level(gk.Motion(rig, still, np.zeros((75, 3)), 25)), 2)
        -4.61
    """
    hands = Hands.of(motion)
    return float(np.log((hands.speed / hands.scale).mean() + _LEVEL_FLOOR))


def calibration(
    levels: Sequence[Sequence[float]], recorded: Sequence[float], speaker: Sequence[float] = ()
) -> Calibration:
    """Compare the levels of many seeds with the recorded ones.

    Only ranks are used: quantiles interpolated between few seeds cover less than they say.

    Args:
        levels: for each clip, those of S seeds. Of S, the largest of 9, 19, 29 ... that all clips
            have are used.
        recorded: level of each recorded clip.
        speaker: levels of the speaker's clips in training, as long as these; by default `recorded`.

    Raises:
        EvaluationError: fewer than 9 seeds of a clip, or fewer than two clips.

    Examples:
        Two of four clips lie between the second lowest and the second highest of 19 seeds:

        >>> found = calibration([range(19)] * 4, [-3, 2, 9, 30])
        >>> found.coverage, found.seeds
        (50.0, 19)
    """
    fewest = min(map(len, levels), default=0)
    if fewest < LEAST_SEEDS or len(levels) < 2:
        raise EvaluationError(
            f"{len(levels)} clips of {fewest} samples: calibration needs two clips or more of "
            f"{LEAST_SEEDS} samples or more each (render --samples 19)"
        )
    seeds = (fewest + 1) // 10 * 10 - 1
    rank = (seeds + 1) // 10  # so many of the seeds' S + 1 gaps lie outside, at each end
    drawn = np.sort([list(own)[:seeds] for own in levels], axis=1)
    own = np.asarray(recorded, float)
    low, high = drawn[:, rank - 1], drawn[:, seeds - rank]
    usual = np.asarray(speaker if len(speaker) > 1 else recorded, float)
    blind = np.sort(np.random.default_rng(0).choice(usual, (_BLIND_DRAWS, seeds)), axis=1)
    width = (blind[:, seeds - rank] - blind[:, rank - 1]).mean()
    return Calibration(
        coverage=100.0 * float(((low <= own) & (own <= high)).mean()),
        spread=float(drawn.std(axis=1, ddof=1).mean() / max(own.std(ddof=1), 1e-9)),
        sharpness=float((high - low).mean() / max(width, 1e-9)),
        clips=len(own),
        seeds=seeds,
    )
