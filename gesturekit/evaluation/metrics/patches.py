"""Patch metrics: coverage of a reference motion, and diversity relative to it.

Coverage, global and local diversity of Li et al. 2022 (GANimator), eqs. 17 to 20 of
Moreno-Villamarin et al. 2024, and the inter- and intra-diversity of Raab et al. 2024 (SinMDM).
All compare arrays (T, D) of frames, which `patch_features` computes from motions. Two variants:

- "ganimator", the published code: the distance of two frames is their L2 distance, that of two
  windows its mean over the frames. Query windows start at 0 ... L - w - 1, without the last one;
  all windows are searched. Features are 6D rotations and contact labels.
- "paper", the formulas of 2024: the distance of two windows is the Frobenius norm of their
  difference, all L - w + 1 windows are queries, and global diversity takes squared distances of
  frames. Features are rotation matrices.

Window lengths are in frames: compare motions at one frame rate, the model's. Published values are
for 30 fps, means over 200 samples twice as long as the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.metrics.diagonals import (
    frame_distances,
    least_window_sums,
    segmentation_cost,
    window_sums,
)
from gesturekit.evaluation.metrics.inputs import check_choice, checked_rows, refuse
from gesturekit.motion import Motion
from gesturekit.motion.contacts import contact_labels
from gesturekit.motion.parts import body_joints
from gesturekit.motion.rotations import matrix_from_quaternion, sixd_from_quaternion
from gesturekit.wording import counted

VARIANTS = ("ganimator", "paper")
THRESHOLD = 2.0
"""Coverage threshold of the variant "ganimator"."""
CONTACT_SPEED = 0.54
"""Contact threshold, m/s on the reference body: GANimator's 0.018 m per frame at 30 fps."""
PATCH_PAIRS = 250_000_000
"""Largest number of frames of a clip times frames of its recording that is compared: 2 GB."""
MOST_PAIRS = 10**9
"""Largest number of pairs of frames to compare: 8 GB."""


@dataclass(frozen=True)
class PatchScores:
    """Coverage (0 to 1), global and local diversity of one generated motion.

    Examples:
        Every frame is 1 away from the nearest of the reference:

        >>> patch_scores(np.ones((40, 1)), np.zeros((40, 1)))
        PatchScores(coverage=1.0, global_diversity=1.0, local_diversity=1.0)
    """

    coverage: float
    global_diversity: float
    local_diversity: float


def coverage(
    generated: np.ndarray,
    reference: np.ndarray,
    window: int = 30,
    threshold: float | None = None,
    *,
    variant: str = "ganimator",
) -> float:
    """Return the fraction of the reference's windows found in the generated motion (eq. 17).

    Args:
        generated: (L, D) frames.
        reference: (N, D) frames.
        window: frames of a window.
        threshold: a window is found if its nearest one is closer than this. 2.0 in the variant
            "ganimator"; "paper" has no default, because its authors chose theirs by eye.
        variant: see the module docstring.

    Raises:
        EvaluationError: shapes that differ, NaN, motions too short, no threshold.

    Examples:
        A clip against itself, and a clip that has nothing of the second half of the reference:

        >>> reference = np.repeat([0.0, 10.0], 100)[:, None]
        >>> coverage(reference, reference), round(coverage(reference[:100], reference, window=1), 2)
        (1.0, 0.5)
    """
    return _coverage(_distances(generated, reference, variant), window, threshold, variant)


def global_diversity(
    generated: np.ndarray,
    reference: np.ndarray,
    min_segment: int = 30,
    *,
    variant: str = "ganimator",
) -> float:
    """Return the mean distance of generated frames to their aligned reference frames (eq. 19).

    The generated motion is cut into segments of at least `min_segment` frames. Each is aligned with
    an interval of the reference of the same length, so that the mean over all frames is least.

    Args:
        generated: (L, D) frames.
        reference: (N, D) frames.
        min_segment: frames.
        variant: see the module docstring.

    Raises:
        EvaluationError: shapes that differ, NaN, motions too short, or L frames that cannot be
            cut into segments of `min_segment` to N frames.

    Examples:
        A clip against itself, and frames that are 3 away from the nearest of the reference:

        >>> reference = np.zeros((60, 1))
        >>> global_diversity(reference, reference), global_diversity(reference + 3, reference)
        (0.0, 3.0)
    """
    return _segmentation(_distances(generated, reference, variant), min_segment)


def local_diversity(
    generated: np.ndarray, reference: np.ndarray, window: int = 15, *, variant: str = "ganimator"
) -> float:
    """Return the mean distance of generated windows to their nearest reference window (eq. 20).

    Arguments and errors as in `coverage`.

    Examples:
        One half of the windows is in the reference, the other is 4 away from it:

        >>> generated = np.array([[0.0], [4.0], [0.0], [4.0], [0.0]])
        >>> local_diversity(generated, np.zeros((5, 1)), window=1)
        2.0
    """
    distances = _distances(generated, reference, variant)
    return float(_nearest(distances, 0, window, variant).mean())


def patch_scores(
    generated: np.ndarray,
    reference: np.ndarray,
    *,
    threshold: float | None = None,
    variant: str = "ganimator",
) -> PatchScores:
    """Return coverage, global and local diversity from one distance matrix, in their usual windows.

    Args:
        generated: (L, D) frames.
        reference: (N, D) frames.
        threshold: see `coverage`; "paper" has no default, and no coverage (NaN) without one.
        variant: see the module docstring.

    Raises:
        EvaluationError: see the three functions.

    Examples:
        >>> patch_scores(np.eye(60), np.eye(60))
        PatchScores(coverage=1.0, global_diversity=0.0, local_diversity=0.0)
    """
    distances = _distances(generated, reference, variant)
    has_threshold = threshold is not None or variant == "ganimator"
    return PatchScores(
        _coverage(distances, 30, threshold, variant) if has_threshold else np.nan,
        _segmentation(distances, 30),
        float(_nearest(distances, 0, 15, variant).mean()),
    )


def patch_values(
    motion: Motion,
    recording: Motion,
    joints: Sequence[str],
    *,
    patches: str = "ganimator",
    threshold: float | None = None,
) -> dict[str, float]:
    """Return coverage (%), global and local diversity of a motion against its recording, by name.

    Args:
        motion: L frames.
        recording: N frames.
        joints: names of the joints that both have.
        patches: the variant.
        threshold: of coverage; "paper" has no default, and no coverage (NaN) without one.

    Raises:
        EvaluationError: see `patch_scores`, or too many frames to compare patch by patch.

    Examples:
        A recording against itself:

        >>> recording = gk.load("demo").generate(seconds=2)
        >>> found = patch_values(recording, recording, ["LeftArm", "RightArm"])
        >>> {key: round(value, 3) for key, value in found.items()}
        {'coverage': 100.0, 'global_diversity': 0.0, 'local_diversity': 0.0}
    """
    _check_pairs(motion.n_frames, recording.n_frames)
    ours, theirs = (patch_features(m, patches, joints=joints) for m in (motion, recording))
    scores = patch_scores(ours, theirs, threshold=threshold, variant=patches)
    return vars(scores) | {"coverage": 100.0 * scores.coverage}


def intra_diversity_of(
    motion: Motion, joints: Sequence[str], *, patches: str = "ganimator"
) -> float:
    """Return `intra_diversity` of a motion; arguments and errors as in `patch_values`.

    Examples:
        A body that never moves:

        >>> rig = gk.load("demo").skeleton
        >>> still = np.tile([0.0, 0, 0, 1], (30, rig.n_joints, 1))
        >>> motion = gk.Motion(rig, still, np.zeros((30, 3)), 30)
        >>> intra_diversity_of(motion, ["LeftArm"], patches="paper")
        0.0
    """
    _check_pairs(motion.n_frames, motion.n_frames)
    return intra_diversity(patch_features(motion, patches, joints=joints))


def inter_diversity(
    samples: Sequence[np.ndarray], window: int = 15, *, variant: str = "nearest"
) -> float:
    """Return how much samples of one model differ from each other (SinMDM).

    As published, each sample is compared with the previous one, the first with the last.

    Args:
        samples: (T, D) arrays, two or more.
        window: frames of a window.
        variant: "nearest" (`inter_diversity_local` of the code): local diversity, GANimator's form,
            of a sample against the other. "aligned" (`inter_diversity_dist`): Frobenius norm of
            the difference of the two, frame by frame, over the number of frames; `window` is not
            used, and lengths must be equal.

    Raises:
        EvaluationError: fewer than two samples, shapes that differ, NaN, or too short.

    Examples:
        Two equal samples, and two that are 3 apart in every frame:

        >>> sample = np.zeros((30, 1))
        >>> inter_diversity([sample, sample]), inter_diversity([sample, sample + 3])
        (0.0, 3.0)
    """
    check_choice("variant", variant, ("nearest", "aligned"))
    arrays = _samples(samples, least=2)
    lengths = sorted({len(array) for array in arrays})
    if variant == "aligned" and len(lengths) > 1:
        raise EvaluationError(
            f"samples of {lengths[0]} to {lengths[-1]} frames; variant aligned needs one length"
        )
    pairs = [(arrays[i], arrays[i - 1]) for i in range(len(arrays))]
    if variant == "nearest":
        return float(np.mean([local_diversity(a, b, window) for a, b in pairs]))
    return float(np.mean([np.linalg.norm(a - b) / len(a) for a, b in pairs]))


def intra_diversity(samples: np.ndarray | Sequence[np.ndarray], window: int = 15) -> float:
    """Return how much the windows of one sample differ (SinMDM), averaged over samples.

    The published code draws one pair of windows per sample and divides the Frobenius norm of their
    difference by `window`. This is the expectation: the mean over all pairs, a window with itself
    included and the last window left out. Compare it with the value of the reference.

    Args:
        samples: one (T, D) array, or several.
        window: frames of a window.

    Raises:
        EvaluationError: no sample, NaN, or a sample of less than `window` + 1 frames.

    Examples:
        Of the pairs of windows 0, 3, 0, 3, one half is 3 apart; the last frame is left out:

        >>> intra_diversity(np.array([[0.0], [3.0], [0.0], [3.0], [9.0]]), window=1)
        1.5
    """
    values = []
    is_one = isinstance(samples, np.ndarray) and samples.ndim == 2
    for frames in _samples([np.asarray(samples)] if is_one else list(samples), least=1):
        _check_length("window", window, len(frames) - 1)
        apart = np.sqrt(window_sums(frame_distances(frames, frames, squared=True), window))
        values.append(apart[:-1, :-1].mean() / window)
    return float(np.mean(values))


def patch_features(
    motion: Motion, variant: str = "ganimator", *, joints: str | Sequence[str] = "body"
) -> np.ndarray:
    """Return the features of a motion that a variant compares.

    "ganimator", (T, 6 (J + F)): 6D rotations of J joints, the root's in the world, then for each
    foot point its contact label and five zeros. The root position is left out. A foot point is in
    contact if slower than 0.54 m/s (on the reference body), never in frame 0; the points are heel
    and toe of `gesturekit.motion.contacts` (GANimator: toe base and toe end).
    "paper", (T, 9 J): rotation matrices.

    Args:
        motion: T frames.
        variant: "ganimator" or "paper".
        joints: "body" (no fingers, no face, no end joints), "all", or names.

    Raises:
        EvaluationError: no such variant.
        MotionError: no such joint, or body parts that cannot be identified.

    Examples:
        The rotation matrix of a joint that is not turned:

        >>> rig = gk.Skeleton(("hips",), (-1,), [[0, 1, 0]])
        >>> motion = gk.Motion(rig, [[[0, 0, 0, 1]]], [[0, 1, 0]], 30)
        >>> patch_features(motion, "paper", joints="all").tolist()
        [[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]]
    """
    check_choice("variant", variant, VARIANTS)
    if isinstance(joints, str):
        check_choice("joints (a list of names, or a word):", joints, ("body", "all"))
        joints = motion.skeleton.names if joints == "all" else body_joints(motion.skeleton)
    rotations = motion.rotations[:, [motion.skeleton.index(name) for name in joints]]
    if variant == "paper":
        return matrix_from_quaternion(rotations).reshape(motion.n_frames, -1)
    labels = contact_labels(motion, threshold=CONTACT_SPEED)
    labels[0] = 0.0
    contacts = np.zeros((*labels.shape, 6))
    contacts[..., 0] = labels
    blocks = np.concatenate([sixd_from_quaternion(rotations), contacts], axis=1)
    return blocks.reshape(motion.n_frames, -1)


def _distances(generated: np.ndarray, reference: np.ndarray, variant: str) -> np.ndarray:
    """Return (L, N) distances of frames, squared in the variant "paper"."""
    check_choice("variant", variant, VARIANTS)
    generated, reference = checked_rows({"generated": generated, "reference": reference})
    _check_pairs(len(generated), len(reference), MOST_PAIRS)
    return frame_distances(generated, reference, squared=variant == "paper")


def _coverage(distances: np.ndarray, window: int, threshold: float | None, variant: str) -> float:
    if threshold is None and variant == "ganimator":
        threshold = THRESHOLD
    if threshold is None or not 0 < threshold < np.inf:
        raise EvaluationError(
            f"threshold is {threshold}; coverage takes a number above 0, for which the variant "
            '"paper" has no default: its authors give none'
        )
    return float((_nearest(distances, 1, window, variant) < threshold).mean())


def _segmentation(distances: np.ndarray, min_segment: int) -> float:
    _check_length("min_segment", min_segment, min(distances.shape))
    cost = segmentation_cost(distances, min_segment) / len(distances)
    if not np.isfinite(cost):
        raise EvaluationError(
            "{} generated frames cannot be cut into pieces of at most {} (the reference has no "
            "more) and at least min_segment, {}: choose a shorter one".format(
                *distances.shape, min_segment
            )
        )
    return cost


def _nearest(distances: np.ndarray, axis: int, window: int, variant: str) -> np.ndarray:
    """Return (W,) distances of windows along an axis of (L, N) frame distances from the nearest
    ones along the other.
    """
    is_published = variant == "ganimator"  # its code leaves out the last window
    most = min(distances.shape[axis] - is_published, distances.shape[1 - axis])
    _check_length("window", window, most)
    sums = least_window_sums(distances, window)[axis]
    return sums[:-1] / window if is_published else np.sqrt(sums)


def _check_pairs(n: int, m: int, most: int = PATCH_PAIRS) -> None:
    if n * m > most:
        raise EvaluationError(
            f"{n} frames against {m} would take {8e-9 * n * m:.0f} GB; compare shorter pieces"
        )


def _check_length(name: str, value: int, most: int) -> None:
    if not isinstance(value, int | np.integer) or not 1 <= value <= most:
        raise EvaluationError(
            f"{name} is {value!r}; expected a whole number of frames from 1 to {most}: longer ones "
            "do not fit into both motions"
        )


def _samples(samples: Sequence[np.ndarray], least: int) -> list[np.ndarray]:
    refuse((len(samples) < least, f"{counted(len(samples), 'sample')}; at least {least} needed"))
    return checked_rows({f"sample {i}": sample for i, sample in enumerate(samples)})
