"""Generated against recorded windows of motion: two-sample accuracy, within reach, copying.

A window is 1 s of body-centred motion (`hands.body_centred`): positions of the upper-body joints,
and their velocities times 0.2 s. The distance of two windows is the root of the mean over frames
and joints of the squared difference of both, metres. Windows begin every 0.5 s.

A whole body can be new where each arm is copied from another place. Windows of one arm are the
local rotations of its shoulder and elbow; their distance is the root mean square of the angles
between these.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.evaluation.metrics.diagonals import frame_distances, lower_to_nearest
from gesturekit.evaluation.metrics.hands import (
    FPS,
    Motions,
    as_list,
    body_centred,
    upper_joints,
    velocities,
    window_starts,
)
from gesturekit.evaluation.metrics.inputs import at_rate
from gesturekit.motion import Motion
from gesturekit.motion.parts import SIDES, find_parts, left_right_pairs

WINDOW, HOP = 1.0, 0.5
"""Length of windows, and the time between their starts, seconds."""
VELOCITY_SECONDS = 0.2
"""Factor on velocities, in seconds, that weights them against positions."""
APART = 3.0
"""Windows of one clip that begin at most this many seconds apart are not independent."""
STRETCHES = (0.9, 1.0, 1.1)
"""Durations, relative to the original, of the time-stretched copies of training motion."""
DRAWS = 20
"""Random subsamples, over which two-sample accuracy and share within reach are averaged."""
MOST_WINDOWS = 2000
"""Largest number of windows of either set that are compared; more are subsampled."""
LOW_QUANTILE = 0.05
"""Quantile of the distances that shows single copied windows."""

ARM_STEP = 3
"""Every which frame of a window is compared of arms."""
ARM_KEYS = {side: f"copying_{side}" for side in SIDES}
"""Keys of `definitions` by side."""

_BLOCK, _ARM_BLOCK = 2000, 4000  # windows that are in memory at a time


@dataclass(frozen=True, eq=False)
class MotionWindows:
    """Windows of motion, cut from the frames when needed.

    Attributes:
        frames: (T, D') positions and velocities of each clip, scaled.
        clips: (N,) index of the clip of each window.
        first: (N,) first frame of each window within its clip.
        step: number of frames from each that a window has to the next.

    Examples:
        Windows of 1 s that begin every 0.5 s, rounded down to frames of 25 fps:

        >>> windows = motion_windows(gk.load("demo").generate(seconds=2))
        >>> len(windows), windows.starts.round(2).tolist()
        (3, [0.0, 0.48, 1.0])
    """

    frames: Sequence[np.ndarray]
    clips: np.ndarray
    first: np.ndarray
    step: int = 1

    def __len__(self) -> int:
        return len(self.clips)

    @property
    def starts(self) -> np.ndarray:
        """(N,) start within the clip, seconds."""
        return self.first / FPS

    @property
    def values(self) -> np.ndarray:
        """(N, D) rows whose Euclidean distance is the distance of windows, for bodies in metres."""
        return self.rows(np.arange(len(self)))

    def rows(self, kept: np.ndarray) -> np.ndarray:
        """Return the rows (K, D) of `values` of some windows, (K,) indices."""
        at = zip(self.clips[kept], self.first[kept])
        return np.stack([self.frames[c][i : i + _WIDTH : self.step].ravel() for c, i in at])


@dataclass(frozen=True)
class Copying:
    """Distances of windows to the nearest training window, metres; see `copying`.

    Attributes:
        median: median over the generated windows.
        low: their 5 % quantile.
        held_out_median: median over recorded windows that are not in the training set.
        held_out_low: their 5 % quantile.

    Examples:
        Half as far from the training motion as recordings that are not in it:

        >>> Copying(median=0.1, low=0.04, held_out_median=0.2, held_out_low=0.05).median_ratio
        0.5
    """

    median: float
    low: float
    held_out_median: float
    held_out_low: float

    @property
    def median_ratio(self) -> float:
        """`median` over `held_out_median`; far below 1 the model copies."""
        return self.median / self.held_out_median

    @property
    def low_ratio(self) -> float:
        """`low` over `held_out_low`; far below 1 the model copies occasionally."""
        return self.low / self.held_out_low


def motion_windows(
    motions: Motions, joints: Sequence[str] | None = None, *, mirrored: bool = False
) -> MotionWindows:
    """Cut motions into windows of 1 s that begin every 0.5 s (rounded down to frames of 25 fps).

    Args:
        motions: one motion, or several. Clips shorter than 1 s have no window.
        joints: names of the upper-body joints to compare; None for those of the first motion.
            Windows can only be compared with windows of the same joints.
        mirrored: exchange left and right; joints without a counterpart among `joints` keep both.

    Raises:
        MotionError: all clips are too short, a joint is missing, or body parts cannot be
            identified.

    Examples:
        Two clips of 2 s have three windows each:

        >>> model = gk.load("demo")
        >>> clips = [model.generate(seconds=2, seed=seed) for seed in (0, 1)]
        >>> motion_windows(clips).clips.tolist()
        [0, 0, 0, 1, 1, 1]
    """
    motions = as_list(motions)
    joints = upper_joints(motions[0].skeleton) if joints is None else joints
    copies = (_with_mirrored(motion, joints) for motion in motions)
    return _cut([_frames(paths[-1 if mirrored else 0]) for paths in copies], HOP)


def _cut(frames: Sequence[np.ndarray], hop: float, step: int = 1) -> MotionWindows:
    """Return the windows of clips (T, D) that begin every `hop` seconds."""
    first = [window_starts(len(clip), _WIDTH, hop * FPS) for clip in frames]
    if not any(map(len, first)):
        raise MotionError(f"no clip is as long as a window of {WINDOW:g} s")
    clips = np.repeat(np.arange(len(frames)), [len(starts) for starts in first])
    return MotionWindows(frames, clips, np.concatenate(first), step)


def two_sample_accuracy(one: MotionWindows, other: MotionWindows, *, seed: int = 0) -> float:
    """Return the leave-one-out accuracy of a 1-nearest-neighbour classifier of two sets (1-NN).

    0.5: the sets are indistinguishable; 1: no window resembles the other set. Values well below 0.5
    mean that one set copies the other: the nearest window of a copy is its original. The larger set
    is subsampled to the size of the smaller one; the accuracy is the mean over 20 seeded draws.
    (Lopez-Paz and Oquab 2017.)

    Raises:
        MotionError: a set of fewer than 2 windows, or windows of different joints.

    Examples:
        The nearest window of a copy is its original; bodies of 10 times the size are distinguished:

        >>> motion = gk.load("demo").generate(seconds=5)
        >>> one, large = motion_windows(motion), motion_windows(motion.scaled(10))
        >>> two_sample_accuracy(one, one), two_sample_accuracy(one, large)
        (0.0, 1.0)
    """
    right, drawn = two_sample_votes(one, other, seed=seed)
    return float(right.sum() / drawn.sum())


def two_sample_votes(
    one: MotionWindows, other: MotionWindows, *, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Classify windows as `two_sample_accuracy` does.

    Returns:
        (N + M,) number of draws in which each window was classified right, and in which it was
        drawn; those of `one` first.

    Raises:
        MotionError: a set of fewer than 2 windows, or windows of different joints.
    """
    _check_sets(one, other, least=2)
    size = min(len(one), len(other), MOST_WINDOWS)
    rng = np.random.default_rng(seed)
    kept = [_kept(windows, rng) for windows in (one, other)]
    values = np.concatenate([one.rows(kept[0]), other.rows(kept[1])])
    distances = frame_distances(values, values, squared=True)
    np.fill_diagonal(distances, np.inf)
    first = len(kept[0])
    place = np.concatenate([kept[0], len(one) + kept[1]])
    label = np.arange(2 * size) < size
    right, drawn = np.zeros((2, len(one) + len(other)))
    for _ in range(DRAWS if first != len(kept[1]) else 1):
        sides = [rng.choice(len(side), size, replace=False) for side in kept]
        chosen = np.concatenate([sides[0], first + sides[1]])
        nearest = distances[np.ix_(chosen, chosen)].argmin(axis=1)
        right[place[chosen]] += label[nearest] == label
        drawn[place[chosen]] += 1
    return right, drawn


def within_reach(generated: MotionWindows, recorded: MotionWindows, *, seed: int = 0) -> float:
    """Return the share of recorded windows that have a generated window nearby.

    Near is below the median distance of a recorded window to its nearest recorded neighbour that
    begins more than 3 s away or is of another clip. If there are more generated than recorded
    windows, the share is the mean over 20 seeded draws of as many, because more samples would
    come near to more windows.

    Raises:
        MotionError: no recorded window has a neighbour more than 3 s away, or windows of different
            joints.

    Examples:
        All of a copy is within reach, nothing of a body of 10 times the size:

        >>> motion = gk.load("demo").generate(seconds=5)
        >>> one, large = motion_windows(motion), motion_windows(motion.scaled(10))
        >>> within_reach(one, one), within_reach(large, one)
        (1.0, 0.0)
    """
    _check_sets(generated, recorded)
    rng = np.random.default_rng(seed)
    generated, recorded = subsample(generated, rng), subsample(recorded, rng)
    rows = recorded.values
    own = frame_distances(rows, rows)
    gap = np.abs(recorded.starts[:, None] - recorded.starts)
    own[(gap <= APART) & (recorded.clips[:, None] == recorded.clips)] = np.inf
    nearest = own.min(axis=1)
    nearest = nearest[np.isfinite(nearest)]
    if not len(nearest):
        raise MotionError(f"the recordings are too short: no two windows are {APART:g} s apart")
    distances = frame_distances(rows, generated.values)
    draws = [np.arange(len(generated))]
    if len(generated) > len(recorded):
        draws = [rng.choice(len(generated), len(recorded), replace=False) for _ in range(DRAWS)]
    found = np.stack([distances[:, drawn].min(axis=1) for drawn in draws])
    return float((found < np.median(nearest)).mean())


def copying(
    generated: Motions,
    held_out: Motions,
    training: Motions,
    joints: Sequence[str] | None = None,
    *,
    seed: int = 0,
) -> Copying:
    """Measure whether generated motion copies training motion.

    Compute the distance of each generated window to the nearest training window, and the same for
    recorded windows on which the model was not trained. Training windows begin at every frame.
    Mirrored and time-stretched (0.9 and 1.1 times the duration) training motion counts as training
    motion.

    Args:
        generated: the model's motion.
        held_out: recordings of the same speaker that are not in `training`; pass `generated` if
            only its distances are needed.
        training: recordings on which the model was trained.
        joints: as for `motion_windows`; None for those of the first training motion.
        seed: seed of the subsample, if there are more than 2,000 windows.

    Raises:
        MotionError: clips that are too short, a missing joint, or body parts that cannot be
            identified.

    Examples:
        Training motion that is given back, beside motion of a body of twice the size:

        >>> training = gk.load("demo").generate(seconds=4)
        >>> found = copying(training, training.scaled(2), training)
        >>> round(found.median_ratio, 6), found.held_out_median > 0.1
        (0.0, True)
    """
    training = as_list(training)
    joints = upper_joints(training[0].skeleton) if joints is None else joints
    rng = np.random.default_rng(seed)
    sets = [subsample(motion_windows(motions, joints), rng) for motions in (generated, held_out)]
    nearest = [nearest_training(set_, training, joints) for set_ in sets]
    return Copying(*(float(q) for set_ in nearest for q in np.quantile(set_, (0.5, LOW_QUANTILE))))


def nearest_training(
    windows: MotionWindows, training: Motions, joints: Sequence[str]
) -> np.ndarray:
    """Return (N,) distance of each window to the nearest training window, metres; see `copying`.

    Raises:
        MotionError: training clips that are too short, or a missing joint.
    """
    rows, nearest = windows.values, np.full(len(windows), np.inf)
    averages = _averages(rows)
    for frames in _training_copies(as_list(training), joints):
        first = window_starts(len(frames), _WIDTH, 1.0)
        for at in range(0, len(first), _BLOCK):
            block = frames[first[at : at + _BLOCK, None] + np.arange(_WIDTH)]
            block = block.reshape(len(block), -1)
            bounds = frame_distances(averages, _averages(block))
            lower_to_nearest(nearest, bounds, rows, block)
    if not np.isfinite(nearest).all():
        raise MotionError(f"no training clip is as long as a window of {WINDOW:g} s")
    return nearest


def _averages(values: np.ndarray) -> np.ndarray:
    """Return rows whose distances are at most those of windows (N, width · D), and near to them.

    They are averages of 5 frames, scaled: the mean of squares is at least the square of the mean.
    """
    frames = values.reshape(len(values), _WIDTH // _AVERAGED, _AVERAGED, -1)
    return np.sqrt(_AVERAGED) * frames.mean(axis=2).reshape(len(values), -1)


_WIDTH = round(WINDOW * FPS)
_AVERAGED = 5  # frames; a divisor of _WIDTH


def _frames(paths: np.ndarray) -> np.ndarray:
    """Return (T, 6 J) positions and velocities of body-centred paths (T, J, 3), scaled."""
    both = np.concatenate([paths, VELOCITY_SECONDS * velocities(paths)], axis=1)
    return both.reshape(len(paths), -1) / np.sqrt(_WIDTH * paths.shape[1])


def _training_copies(training: Sequence[Motion], joints: Sequence[str]) -> Iterator[np.ndarray]:
    """Yield frames of the training motions, and of mirrored and time-stretched copies."""
    for motion in training:
        for copy in _with_mirrored(motion, joints):
            for stretch in STRETCHES:
                yield _frames(_stretched(copy, stretch))


def _with_mirrored(motion: Motion, joints: Sequence[str]) -> list[np.ndarray]:
    """Return body-centred paths (T, J, 3), and those with left and right exchanged.

    The paths alone if the counterpart of a joint is not among `joints`: it has no place to go.
    """
    paths, pairs = body_centred(motion, joints), left_right_pairs(motion.skeleton)
    swapped = {name: other for pair in pairs for name, other in (pair, pair[::-1])}
    counterparts = [swapped.get(name, name) for name in joints]
    if set(counterparts) != set(joints):
        return [paths]
    turned = paths[:, [list(joints).index(name) for name in counterparts]] * (-1.0, 1.0, 1.0)
    return [paths, turned]


def _stretched(paths: np.ndarray, duration: float) -> np.ndarray:
    """Return paths (T, J, 3) with their duration multiplied, by cubic interpolation."""
    from scipy.interpolate import CubicSpline

    if duration == 1.0 or len(paths) < 2:
        return paths
    n = round((len(paths) - 1) * duration) + 1
    times = np.arange(n) * (len(paths) - 1) / max(n - 1, 1)
    return CubicSpline(np.arange(len(paths)), paths)(times)


def subsample(windows: MotionWindows, rng: np.random.Generator) -> MotionWindows:
    """Return at most `MOST_WINDOWS` windows, chosen at random."""
    kept = _kept(windows, rng)
    return replace(windows, clips=windows.clips[kept], first=windows.first[kept])


def _kept(windows: MotionWindows, rng: np.random.Generator) -> np.ndarray:
    """Return the indices of at most `MOST_WINDOWS` windows, chosen at random."""
    if len(windows) <= MOST_WINDOWS:
        return np.arange(len(windows))
    return np.sort(rng.choice(len(windows), MOST_WINDOWS, replace=False))


def _check_sets(one: MotionWindows, other: MotionWindows, least: int = 1) -> None:
    """Raise a MotionError for windows of different numbers of joints, or fewer than `least`."""
    joints = [windows.frames[0].shape[1] // 6 for windows in (one, other)]
    if joints[0] != joints[1] or min(len(one), len(other)) < least:
        raise MotionError(
            f"{len(one)} and {len(other)} windows of {joints[0]} and {joints[1]} joints cannot be "
            f"compared: there must be {least} or more of either, cut with the same joints"
        )


def arm_windows(motions: Sequence[Motion], side: str, *, hop: float = HOP) -> MotionWindows:
    """Return windows of one arm: 9 frames of the rotation matrices of its shoulder and elbow.

    Args:
        motions: any frame rate; those shorter than 1 s have no window.
        side: "left" or "right".
        hop: time between the starts of windows, seconds.

    Raises:
        MotionError: body parts that cannot be identified, or no motion as long as a window.
    """
    from scipy.spatial.transform import Rotation

    frames = []
    for motion in motions:
        arm = find_parts(motion.skeleton).arms[side]
        joints = [motion.skeleton.index(name) for name in (arm.shoulder, arm.elbow)]
        rotations = at_rate(motion, FPS).rotations[:, joints]
        frames.append(Rotation.from_quat(rotations.reshape(-1, 4)).as_matrix().reshape(-1, 18))
    return _cut(frames, hop, ARM_STEP)


def nearest_arm(windows: MotionWindows, training: Sequence[Motion], side: str) -> np.ndarray:
    """Return the angle (N,) of windows of an arm to the nearest one of training, degrees.

    Windows of the training motion, and of its mirrored copy, begin at every frame. The angle of a
    rotation matrix R from the identity I is 2 asin(|R - I| / sqrt(8)), with the Frobenius norm.

    Raises:
        MotionError: see `arm_windows`.
    """
    rows, nearest = windows.values, np.full(len(windows), np.inf)
    for copy in (training, [motion.mirror() for motion in training]):
        kept = arm_windows(copy, side, hop=1.0 / FPS)
        for at in range(0, len(kept), _ARM_BLOCK):
            block = kept.rows(np.arange(at, min(at + _ARM_BLOCK, len(kept))))
            nearest = np.minimum(nearest, frame_distances(rows, block, squared=True).min(axis=1))
    mean = nearest / (rows.shape[1] // 9)
    return np.degrees(2.0 * np.arcsin(np.minimum(np.sqrt(mean / 8.0), 1.0)))
