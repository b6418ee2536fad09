"""Level lengths, resampling between levels, and residual features.

Motion and features use the same interpolation, so the frames of a level have the same times in
both.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from audio_features.errors import FeatureError


def level_lengths(n_frames: int, levels: int, factor: float = 4 / 3) -> list[int]:
    """Return the number of frames of every level, coarse to fine; the last is `n_frames`.

    T_i = max(1, round(T / factor^(L - i))) for i = 1 … L. Rounding is to nearest, ties to even.

    Raises FeatureError if n_frames or levels is below 1, or factor is not above 1.

    Examples:
        >>> af.level_lengths(100, levels=3, factor=2)
        [25, 50, 100]
        >>> af.level_lengths(250, levels=10)
        [19, 25, 33, 44, 59, 79, 105, 141, 188, 250]
    """
    if n_frames < 1 or levels < 1:
        raise FeatureError(f"n_frames={n_frames}, levels={levels}: both must be at least 1")
    if not 1 < factor < 1000:
        raise FeatureError(f"factor={factor}: levels grow by a factor above 1")
    ratio = 1 / Fraction(factor).limit_denominator(1000)
    return [max(1, round(n_frames * ratio ** (levels - i))) for i in range(1, levels + 1)]


def interpolation_weights(
    n_in: int, n_out: int, start: int = 0, stop: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return indices and weights of the linear interpolation from n_in to n_out frames.

    out[k] = (1 - w[k])·in[lo[k]] + w[k]·in[hi[k]], the convention of
    `torch.nn.functional.interpolate(mode="linear", align_corners=False)`: frame k lies at
    (k + ½)·n_in/n_out - ½, clamped to the first and the last frame.

    Args:
        n_in: number of input frames.
        n_out: number of output frames.
        start: first output frame.
        stop: end of the M output frames; by default all M = n_out.

    Returns:
        lo (M,) int64, hi (M,) int64, w (M,) float64 in [0, 1).

    Examples:
        Frames 1 and 2 of 4 lie a quarter and three quarters of the way from frame 0 to 1 of 2:

        >>> lo, hi, w = af.interpolation_weights(2, 4)
        >>> lo.tolist(), hi.tolist(), w.tolist()
        ([0, 0, 0, 1], [1, 1, 1, 1], [0.0, 0.25, 0.75, 0.25])
    """
    if n_in < 1 or n_out < 1:
        raise FeatureError(f"cannot interpolate from {n_in} to {n_out} frames: at least 1 each")
    # Exact integer arithmetic: the position is `numerator` / (2·n_out).
    out = np.arange(start, n_out if stop is None else stop, dtype=np.int64)
    numerator = np.maximum((2 * out + 1) * n_in - n_out, 0)
    lo, remainder = np.divmod(numerator, 2 * n_out)
    hi = np.minimum(lo + 1, n_in - 1)
    return lo, hi, remainder / (2 * n_out)


def resample_frames(
    values: np.ndarray, n: int, start: int = 0, stop: int | None = None
) -> np.ndarray:
    """Resample (T, …) to (n, …) by `interpolation_weights`; the dtype is kept.

    With start and stop, only that range of the n frames is computed.

    Examples:
        >>> af.resample_frames(np.array([[0.0], [1.0], [2.0], [3.0]]), 2).ravel()
        array([0.5, 2.5])
        >>> af.resample_frames(np.array([[0.5], [2.5]]), 4).ravel()
        array([0.5, 1. , 2. , 2.5])
    """
    values = np.asarray(values)
    if values.dtype.kind != "f":
        raise FeatureError(f"values have dtype {values.dtype}: give floats")
    if len(values) == n:
        return values[start:stop].copy()
    lo, hi, w = interpolation_weights(len(values), n, start, stop)
    w = w.reshape(-1, *([1] * (values.ndim - 1))).astype(values.dtype)
    return values[lo] * (1 - w) + values[hi] * w


def residual_pyramid(values: np.ndarray, lengths: Sequence[int]) -> list[np.ndarray]:
    """Split values (T, D) into residual levels: s_1 = s̃_1, s_i = ↑s̃_{i-1} - s̃_i.

    s̃_i is `values` (T, D) resampled to lengths[i] directly, ↑ the resampling from one level's
    length to the next (multi-resolution paper, section 5; its sign).

    Returns a list of (lengths[i], D) arrays, coarse to fine; the last length must be T.

    Examples:
        The coarse level holds 0.5 and 2.5, upsampled 0.5, 1, 2 and 2.5:

        >>> coarse, fine = af.residual_pyramid(np.array([[0.0], [1.0], [2.0], [3.0]]), [2, 4])
        >>> coarse.ravel(), fine.ravel()
        (array([0.5, 2.5]), array([ 0.5,  0. ,  0. , -0.5]))
    """
    values = np.asarray(values)
    if not len(lengths) or lengths[-1] != len(values):
        raise FeatureError(f"lengths {list(lengths)}: the last must be the {len(values)} frames")
    levels = [resample_frames(values, n) for n in lengths]
    residuals = [
        resample_frames(coarse, len(fine)) - fine
        for coarse, fine in zip(levels[:-1], levels[1:], strict=True)
    ]
    return [levels[0], *residuals]


def residual_level(
    values: np.ndarray, lengths: Sequence[int], level: int, start: int, stop: int
) -> np.ndarray:
    """Compute frames `start` to `stop` of `residual_pyramid(values, lengths)[level]` alone.

    Reads only the neighbouring frames of `values` (T, D). Returns (stop - start, D).

    Examples:
        >>> values = np.array([[0.0], [1.0], [2.0], [3.0]])
        >>> af.residual_level(values, [2, 4], level=1, start=2, stop=4).ravel()
        array([ 0. , -0.5])
    """
    fine = resample_frames(values, lengths[level], start, stop)
    if level == 0:
        return fine
    lo, hi, w = interpolation_weights(lengths[level - 1], lengths[level], start, stop)
    w = w[:, None].astype(fine.dtype)
    coarse = resample_frames(values, lengths[level - 1], lo[0], hi[-1] + 1)
    return coarse[lo - lo[0]] * (1 - w) + coarse[hi - lo[0]] * w - fine


def from_residual_pyramid(levels: Sequence[np.ndarray]) -> np.ndarray:
    """Invert `residual_pyramid`: s̃_i = ↑s̃_{i-1} - s_i, up to the finest level (T, D).

    Computes in float64, so that rounding errors do not accumulate over levels, and returns the
    dtype of the finest level.

    Examples:
        >>> levels = [np.array([[0.5], [2.5]]), np.array([[0.5], [0.0], [0.0], [-0.5]])]
        >>> af.from_residual_pyramid(levels).ravel()
        array([0., 1., 2., 3.])
    """
    if not levels:
        raise FeatureError("an empty pyramid: give at least one level")
    values = np.asarray(levels[0], dtype=np.float64)
    for residual in levels[1:]:
        values = resample_frames(values, len(residual)) - residual
    return values.astype(np.asarray(levels[-1]).dtype, copy=False)
