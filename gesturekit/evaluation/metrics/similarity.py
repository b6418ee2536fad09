"""Similarity to a recording frame by frame (RMSE, CCA, SRGR, MSE, LVD); L1 diversity of poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from audio_features import FeatureTrack
from gesturekit.errors import EvaluationError
from gesturekit.evaluation.metrics.inputs import check_choice, refuse
from gesturekit.evaluation.metrics.physical import joint_paths
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.model_joints import first_moving_joint
from gesturekit.motion.parts import known_parts
from gesturekit.motion.parts.body_size import body_scale

_STILL = 1e-6  # fraction of a pose's extent; a column that varies less is constant
SRGR_THRESHOLD = 0.1
"""Largest distance of a correct joint in SRGR, metres on the reference body."""


def root_relative(motion: Motion, joints: Sequence[str] | None = None) -> np.ndarray:
    """Return joint positions relative to the first joint, which is left out; world axes.

    Args:
        motion: T frames.
        joints: names, the pelvis first; None takes the body joints.

    Returns:
        (T, J - 1, 3) metres.

    Raises:
        MotionError: a missing joint, or body parts that cannot be identified.

    Examples:
        The head is half a metre above the hips, wherever they are:

        >>> rig = gk.Skeleton(("hips", "head"), (-1, 0), [[0, 0, 0], [0, 0.5, 0]])
        >>> motion = gk.Motion(rig, np.tile([0.0, 0, 0, 1], (2, 2, 1)), [(0, 1, 0), (3, 1, 2)], 30)
        >>> root_relative(motion, ["hips", "head"]).tolist()
        [[[0.0, 0.5, 0.0]], [[0.0, 0.5, 0.0]]]
    """
    paths = joint_paths(motion, joints)
    return paths[:, 1:] - paths[:, :1]


def l1_diversity(motion: Motion, joints: Sequence[str] | None = None) -> float:
    """Return Σ_t Σ_d |x_td - mean_t x_td| / T over pose coordinates, metres (BEAT, EMAGE).

    The sum grows with the number of joints: compare values of the same joints.

    Examples:
        The head moves to and fro, 0.1 m from its mean place in every frame:

        >>> rig = gk.Skeleton(("hips", "head"), (-1, 0), [[0, 0, 0], [0, 0.5, 0]])
        >>> head = {"head": [(-0.1, 0.5, 0), (0.1, 0.5, 0)]}
        >>> motion = gk.Motion(rig, np.tile([0.0, 0, 0, 1], (2, 2, 1)), np.zeros((2, 3)), 30, head)
        >>> round(l1_diversity(motion, ["hips", "head"]), 6)
        0.1
    """
    values = root_relative(motion, joints)
    return float(np.abs(values - values.mean(axis=0)).sum() / len(values))


def cca(generated: np.ndarray, reference: np.ndarray) -> float:
    """Return Pearson's r of the first canonical pair of two pose sequences (GENEA).

    Fitted and measured on the same frames, as in genea_numerical_evaluations (scikit-learn's CCA
    with one component and up to 1,500 iterations). It is high for any two sequences with many
    columns and few frames: compare it with the value for mismatched pairs.

    Args:
        generated: (T, D).
        reference: (T, E).

    Raises:
        EvaluationError: different or too few frames, or a sequence that does not move.

    Examples:
        A linear function of the recorded poses:

        >>> reference = np.random.default_rng(0).normal(size=(100, 2))
        >>> round(cca(3 * reference + 1, reference), 6)
        1.0
    """
    import warnings

    from sklearn.cross_decomposition import CCA
    from sklearn.exceptions import ConvergenceWarning

    n, m = len(generated), len(reference)
    sides = [
        side[:, side.std(axis=0) > _STILL * np.abs(side).max(initial=0.0)]
        for side in (generated, reference)
    ]
    refuse(
        (n != m, f"CCA compares frame by frame; there are {n} and {m} frames"),
        (not sides[0].shape[1], "CCA: the generated motion does not move"),
        (not sides[1].shape[1], "CCA: the reference does not move"),
        (n < 3, f"CCA needs at least 3 frames; there are {n}"),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        first, second = CCA(n_components=1, max_iter=1500).fit_transform(*sides)
    return float(np.corrcoef(first[:, 0], second[:, 0])[0, 1])


def pose_pair(
    motion: Motion, recording: Motion, joints: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses (T, 3 (J - 1)) of both motions over their common frames, metres.

    They are those of joints below the pelvis, relative to it: joints above may lie on the floor.
    Where it is not known, or not among `joints`, all are relative to the first one.
    """
    parts = known_parts(recording.skeleton)
    if parts is not None and parts.pelvis in joints:
        joints = _and_below(recording.skeleton, parts.pelvis, joints)
    n = min(motion.n_frames, recording.n_frames)
    ours, theirs = (root_relative(m, joints)[:n].reshape(n, -1) for m in (motion, recording))
    return ours, theirs


def _and_below(rig: Skeleton, root: str, joints: Sequence[str]) -> list[str]:
    """Return a joint and those of `joints` that are below it."""
    below = {rig.names[j] for j in rig.descendants(rig.index(root))}
    return [root, *(name for name in joints if name in below)]


def pose_cca(motion: Motion, recording: Motion, joints: Sequence[str]) -> float:
    """Return `cca` of the poses of a motion and its recording.

    Examples:
        The same movement of a body of twice the size:

        >>> recording = gk.load("demo").generate(seconds=2)
        >>> joints = ["Hips", "LeftHand", "RightHand"]
        >>> round(pose_cca(recording.scaled(2), recording, joints), 3)
        1.0
    """
    return cca(*pose_pair(motion, recording, joints))


def pose_rmse(motion: Motion, recording: Motion, joints: Sequence[str]) -> float:
    """Return the root mean square distance of the joints of a motion from the recorded ones, m.

    sqrt(mean over t and j of ||R p_tj - q_tj||²), p and q positions relative to the first joint
    that moves (the hips), of the joints below it, over the frames that both have. R turns the whole
    motion about the vertical so that the error is least, because a model may face all of its
    training motion forward. Of a reconstruction from z* it is close to zero (Moreno-Villamarin et
    al. 2024, section 4.3).

    Args:
        motion: T frames.
        recording: the recording, at the same frame rate.
        joints: names of the joints that both have.

    Raises:
        MotionError: a motion without the joint that moves first in the recording.

    Examples:
        A motion that goes elsewhere, and one of a body of twice the size, whose head is half a
        metre too high:

        >>> rig = gk.Skeleton(("hips", "head"), (-1, 0), [[0, 0, 0], [0, 0.5, 0]])
        >>> recording = gk.Motion(rig, np.tile([0.0, 0, 0, 1], (2, 2, 1)), np.zeros((2, 3)), 30)
        >>> moved = gk.Motion(rig, recording.rotations, np.ones((2, 3)), 30)
        >>> [pose_rmse(m, recording, rig.names) for m in (moved, recording.scaled(2))]
        [0.0, 0.5]
    """
    rig, n = recording.skeleton, min(motion.n_frames, recording.n_frames)
    names = _and_below(rig, rig.names[first_moving_joint([recording])], joints)
    ours, theirs = (root_relative(side, names)[:n] for side in (motion, recording))
    # In the ground plane x + iz, the turn by least squares is the angle of sum conj(p) q.
    flat, goal = (side[..., 0] + 1j * side[..., 2] for side in (ours, theirs))
    turned = flat * np.exp(1j * np.angle(np.vdot(flat, goal)))
    squares = np.abs(turned - goal) ** 2 + (ours[..., 1] - theirs[..., 1]) ** 2
    return float(np.sqrt(squares.mean()))


def semantic_recall(
    motion: Motion, recording: Motion, joints: Sequence[str], semantic: FeatureTrack
) -> float:
    """Return `srgr` of a motion; its threshold grows with the recording's body.

    Args:
        motion: T frames.
        recording: the recording, at the same frame rate.
        joints: names of the joints that both have.
        semantic: (S, 1) semantic relevance over time, 0 to 1.

    Examples:
        A recording against itself, of the mean relevance of BEAT:

        >>> recording = gk.load("demo").generate(seconds=2)
        >>> semantic = af.FeatureTrack(np.full((60, 1), 0.165), times=np.arange(60) / 30)
        >>> round(semantic_recall(recording, recording, ["Hips", "LeftHand"], semantic), 6)
        1.0
    """
    ours, theirs = (side.reshape(len(side), -1, 3) for side in pose_pair(motion, recording, joints))
    relevance = semantic.to_rate(motion.fps, len(ours)).values[:, 0]
    near = SRGR_THRESHOLD * body_scale(recording.skeleton)
    return srgr(ours, theirs, relevance, threshold=near)


def srgr(
    generated: np.ndarray,
    reference: np.ndarray,
    semantic: np.ndarray,
    *,
    variant: Literal["beat", "emage"] = "emage",
    threshold: float = SRGR_THRESHOLD,
) -> float:
    """Return the semantic-relevance gesture recall (SRGR) of BEAT and EMAGE.

    mean over frames t and joints j of [distance < threshold] · semantic_t / 0.165.

    Args:
        generated: (T, J, 3) poses, metres.
        reference: (T, J, 3) poses of the recording.
        semantic: (T,) semantic relevance of each frame, 0 to 1.
        variant: "beat" (2022) takes the L1 distance over x, y and z, "emage" the L2 distance.
        threshold: metres.

    Raises:
        EvaluationError: shapes that differ, or an unknown variant.

    Examples:
        One of two joints is further than 0.1 m away, where the relevance is the mean of BEAT:

        >>> reference, generated = np.zeros((2, 50, 2, 3))
        >>> generated[:, 1] = 0.5
        >>> round(srgr(generated, reference, np.full(50, 0.165)), 6)
        0.5
    """
    if generated.shape != reference.shape or len(semantic) != len(generated):
        raise EvaluationError(
            f"SRGR: poses {generated.shape} and {reference.shape} with {len(semantic)} semantic "
            "values; all must have the same frames and joints"
        )
    check_choice("SRGR variant", variant, _DISTANCES)
    distance = np.linalg.norm(generated - reference, ord=_DISTANCES[variant], axis=-1)
    return float(((distance < threshold) * semantic[:, None]).mean() / _SEMANTIC_MEAN)


def vertex_mse(generated: np.ndarray, reference: np.ndarray) -> float:
    """Return the mean squared error of vertices as in BEAT2 (EMAGE, Liu et al. 2024): the face's.

    Σ_t Σ_d (x_td - y_td)² / (T D) over coordinates d of all vertices, as its evaluation tools sum.

    Args:
        generated: (T, V, 3) vertices, metres; the papers' are those of the SMPL-X face.
        reference: the same of the recording.

    Raises:
        EvaluationError: shapes that differ, or no frames.

    Examples:
        Of four coordinates in two frames, one is 0.2 off in one of them:

        >>> reference, generated = np.zeros((2, 2, 2, 2))
        >>> generated[0, 1, 0] = 0.2
        >>> round(vertex_mse(generated, reference), 6)
        0.005
    """
    return float(np.square(_vertex_differences(generated, reference)).mean())


def vertex_lvd(generated: np.ndarray, reference: np.ndarray) -> float:
    """Return the L1 vertex difference (LVD) of BEAT2 (EMAGE; Yi et al. 2023), of velocities.

    Σ_t Σ_d |(x_td - x_(t-1)d) - (y_td - y_(t-1)d)| / (T D): differences of T - 1 pairs of frames,
    divided by all T frames, as in its evaluation tools. Arguments and errors as of `vertex_mse`.

    Examples:
        One of two coordinates moves on by 0.1 in each of five frames, the recording rests:

        >>> reference, generated = np.zeros((2, 5, 1, 2))
        >>> generated[:, 0, 0] = 0.1 * np.arange(5)
        >>> round(vertex_lvd(generated, reference), 6)
        0.04
    """
    differences = _vertex_differences(generated, reference)
    return float(np.abs(np.diff(differences, axis=0)).sum() / differences.size)


def _vertex_differences(generated: np.ndarray, reference: np.ndarray) -> np.ndarray:
    if generated.shape != reference.shape or not generated.size:
        raise EvaluationError(
            f"vertices {generated.shape} and {reference.shape}: both must be (frames, vertices, 3)"
        )
    return np.asarray(generated, np.float64) - reference


_DISTANCES = {"beat": 1, "emage": 2}
_SEMANTIC_MEAN = 0.165  # the mean semantic score of BEAT, by which its authors scale
