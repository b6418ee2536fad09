"""Fréchet distances between sets of motions, and diversity of their clips.

|m1 - m2|² + tr(S1 + S2 - 2 (S1 S2)^½) with means and covariances (divided by n - 1) of features
(Heusel et al. 2017). The metrics differ in their features:

- `fgd`: those of an autoencoder of short windows of poses (Yoon et al. 2020). Values can be
  compared if the fingerprint of the autoencoder is the same.
- `raw_fgd`: the normalised windows themselves (Ahuja et al. 2020).
- `fid`: kinetic or geometric features of 10 s clips, each divided by its standard deviation in the
  reference (Siyao et al. 2022); `clip_diversity`: mean distance of two clips.

Small samples bias all of them upwards: below `SAMPLES_PER_DIMENSION` samples per feature dimension,
two halves of one set are more than about 5 % of its variance apart. Compare sets of equal size,
and read the note.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.metrics.frechet.clip_features import CLIP_SECONDS, clip_features
from gesturekit.evaluation.metrics.frechet.poses import PoseWindows
from gesturekit.evaluation.metrics.inputs import checked_rows
from gesturekit.motion import Motion

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import Extractor

SAMPLES_PER_DIMENSION = 10
_CLIPS = 10
"""Least number of motions of either set for an interval."""


@dataclass(frozen=True)
class FrechetResult:
    """A Fréchet distance and its bootstrap interval.

    Attributes:
        value: the distance (a squared length, in the features' units).
        low: value less 1.96 bootstrap standard errors, at least 0; NaN without a bootstrap.
        high: value and 1.96 bootstrap standard errors.
        n_generated: samples (windows or clips) of the generated set.
        n_reference: samples of the reference set.
        dimensions: dimension of the features.
        note: "" or why the value is uncertain.

    Examples:
        >>> print(FrechetResult(2.5, 2.0, 3.0, n_generated=400, n_reference=500, dimensions=32))
        2.5 [2, 3] (400 against 500 samples of 32)
    """

    value: float
    low: float
    high: float
    n_generated: int
    n_reference: int
    dimensions: int
    note: str = ""

    def __str__(self) -> str:
        spread = "" if np.isnan(self.low) else f" [{self.low:.4g}, {self.high:.4g}]"
        counts = f"{self.n_generated} against {self.n_reference} samples of {self.dimensions}"
        return f"{self.value:.4g}{spread} ({counts}{'; ' + self.note if self.note else ''})"


def frechet_distance(generated: np.ndarray, reference: np.ndarray) -> float:
    """Return the Fréchet distance of the Gaussians fitted to two samples.

    tr((S1 S2)^½) is the sum of the singular values of R1 R2', where R'R = S. This needs no matrix
    square root and no regularisation, and is valid for fewer samples than dimensions. Equal samples
    have distance 0 up to rounding (1e-15 of their variance); it is never negative.

    Args:
        generated: (n, D) features, n from 2.
        reference: (m, D) features, m from 2.

    Raises:
        EvaluationError: shapes that differ, fewer than two samples, or NaN.

    Examples:
        The same spread, 3 apart:

        >>> reference = np.array([[0.0], [1.0], [2.0]])
        >>> round(frechet_distance(reference + 3, reference), 6)
        9.0
    """
    from scipy.linalg import svdvals

    sets = checked_rows({"generated": generated, "reference": reference}, "sample", least=2)
    means = [x.mean(axis=0) for x in sets]
    roots: list[Any] = [
        np.linalg.qr((x - mean) / np.sqrt(len(x) - 1), mode="r") for x, mean in zip(sets, means)
    ]
    overlap = svdvals(roots[0] @ roots[1].T).sum()
    apart = ((means[0] - means[1]) ** 2).sum()
    return float(max(0.0, apart + sum((root**2).sum() for root in roots) - 2 * overlap))


def frechet_result(
    generated: Sequence[np.ndarray],
    reference: Sequence[np.ndarray],
    *,
    resamples: int = 100,
    seed: int = 0,
) -> FrechetResult:
    """Return the Fréchet distance of two sets of motions, with its bootstrap interval.

    Both sets are resampled `resamples` times by whole motions, as windows of one motion are
    correlated; there is no interval if a set has fewer than 10 motions. It is computed from the
    standard error, as resampled distances are biased upwards.

    Args:
        generated: (n_i, D) features of each motion.
        reference: (m_i, D) features of each motion.
        resamples: 0 for no interval.
        seed: seed of the resamples.

    Raises:
        EvaluationError: see `frechet_distance`.

    Examples:
        Features of two recordings, and the same 3 apart:

        >>> reference = [np.array([[0.0], [1.0]]), np.array([[2.0], [3.0]])]
        >>> result = frechet_result([features + 3 for features in reference], reference)
        >>> round(result.value, 6), result.n_reference
        (9.0, 4)
    """
    sets = [list(generated), list(reference)]
    if not all(sets):
        raise EvaluationError("a Fréchet distance needs features of both sets; one is empty")
    ours, theirs = (np.concatenate(one) for one in sets)
    value = frechet_distance(ours, theirs)
    (n, dimensions), m, notes = ours.shape, len(theirs), []
    if min(n, m) < (enough := SAMPLES_PER_DIMENSION * dimensions):
        notes.append(f"fewer than {enough} samples, {SAMPLES_PER_DIMENSION} a dimension: too high")
    low = high = np.nan
    if resamples and min(map(len, sets)) < _CLIPS:
        notes.append(f"fewer than {_CLIPS} motions: no interval")
    elif resamples > 1:  # one has no spread
        spread = _standard_error(sets, resamples, seed)
        low, high = max(0.0, value - 1.96 * spread), value + 1.96 * spread
    return FrechetResult(value, low, high, n, m, dimensions, "; ".join(notes))


def fgd(
    generated: Sequence[Motion], reference: Sequence[Motion], model: Extractor, *, seed: int = 0
) -> FrechetResult:
    """Return the Fréchet gesture distance on the features of `model` (`gesturekit fit-features`).

    Args:
        generated: motions with the joints of the extractor, any frame rate.
        reference: the same for the recordings.
        model: the autoencoder fitted on a reference set, or BEAT2's (`load_extractor`).
        seed: see `frechet_result`.

    Raises:
        EvaluationError: missing joints, or no motion as long as a window.

    Examples:
        Recordings against themselves:

        >>> from gesturekit.evaluation import FeatureModel
        >>> recordings = [gk.load("demo").generate(seconds=5)]
        >>> model = FeatureModel.fit(recordings, steps=1)
        >>> round(fgd(recordings, recordings, model).value, 6)
        0.0
    """
    return frechet_result(model.encode(generated), model.encode(reference), seed=seed)


def raw_fgd(
    generated: Sequence[Motion],
    reference: Sequence[Motion],
    windows: PoseWindows | None = None,
    *,
    joints: Sequence[str] | None = None,
) -> FrechetResult:
    """Return the Fréchet distance on windows of normalised poses, without an autoencoder.

    It has no interval.

    Args:
        generated: motions of one rig.
        reference: motions of the same rig.
        windows: pose normalisation; by default `PoseWindows.fit(reference)`, GENEA's form.
            `model.windows` gives the value to compare with a model's `fgd`.
        joints: names of joints of both sets, if `windows` is None; by default the body joints.

    Raises:
        EvaluationError: see `fgd`.

    Examples:
        Recordings against themselves:

        >>> recordings = [gk.load("demo").generate(seconds=5)]
        >>> round(raw_fgd(recordings, recordings, joints=["LeftHand", "RightHand"]).value, 6)
        0.0
    """
    windows = windows or PoseWindows.fit(reference, joints=joints)
    flat = [
        [clip.reshape(len(clip), -1) for clip in windows.cut(motions)]
        for motions in (generated, reference)
    ]
    return frechet_result(*flat, resamples=0)


def fid(
    generated: Sequence[Motion],
    reference: Sequence[Motion],
    kind: str = "kinetic",
    *,
    seconds: float = CLIP_SECONDS,
    joints: Sequence[str] | None = None,
    kinetic: str = "corrected",
    seed: int = 0,
) -> FrechetResult:
    """Return FID_k or FID_g, the Fréchet distance on features of clips in the reference's spread.

    Args:
        generated: motions of one rig, cut into consecutive clips; a remainder is left out.
        reference: motions of the same rig.
        kind: "kinetic" (`kinetic_features`) or "geometric" (`geometric_features`).
        seconds: length of a clip.
        joints: names of joints of both sets, of kinetic features; by default the body joints of
            the reference.
        kinetic: variant of the kinetic features.
        seed: see `frechet_result`.

    Raises:
        EvaluationError: rigs that differ, fewer than two clips, motions shorter than a clip.

    Examples:
        Recordings against themselves, and a body of 10 times the size against them: geometric
        features are in units of the body.

        >>> recordings = [gk.load("demo").generate(seconds=4)]
        >>> large = [recordings[0].scaled(10)]
        >>> round(fid(recordings, recordings, seconds=1).value, 6)
        0.0
        >>> fid(large, recordings, seconds=1).value > 100
        True
        >>> round(fid(large, recordings, "geometric", seconds=1).value, 6)
        0.0
    """
    sets = clip_features([generated, reference], kind, seconds, joints, kinetic)
    return frechet_result(*sets, seed=seed)


def clip_diversity(
    motions: Sequence[Motion],
    reference: Sequence[Motion] | None = None,
    kind: str = "kinetic",
    *,
    seconds: float = CLIP_SECONDS,
    joints: Sequence[str] | None = None,
    kinetic: str = "corrected",
) -> float:
    """Return Div_k or Div_g, the mean distance of two clips of `motions` in the features of `fid`.

    Args:
        motions: motions of one rig, cut into clips.
        reference: whose standard deviations are the units; by default `motions` themselves.
        kind, seconds, joints, kinetic: see `fid`.

    Raises:
        EvaluationError: see `fid`.

    Examples:
        Two equal clips:

        >>> motion = gk.load("demo").generate(seconds=2)
        >>> clip_diversity([motion, motion], seconds=2)
        0.0
    """
    from scipy.spatial.distance import pdist

    sets = [motions, motions if reference is None else reference]
    clips = np.concatenate(clip_features(sets, kind, seconds, joints, kinetic)[0])
    if len(clips) < 2:
        raise EvaluationError(f"diversity needs two clips of {seconds:g} s; there is one")
    return float(pdist(clips).mean())


def _standard_error(sets: list[list[np.ndarray]], resamples: int, seed: int) -> float:
    rng = np.random.default_rng(seed)
    values = []
    for _ in range(resamples):
        drawn = ([one[i] for i in rng.integers(0, len(one), len(one))] for one in sets)
        values.append(frechet_distance(*map(np.concatenate, drawn)))
    return float(np.std(values, ddof=1))
