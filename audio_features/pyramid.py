"""Level lengths, resampling between levels, and residual features.

Motion and features use the same interpolation, so the two never disagree about where in time
a frame of a level lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from audio_features.errors import FeatureError


def level_lengths(n_frames: int, levels: int, factor: float = 4 / 3) -> list[int]:
    """Number of frames at every level, coarse to fine; the last is `n_frames`.

    T_i = max(1, round(T / factor^(L - i))) for i = 1 … L. Rounding is to nearest, ties to even.

    Raises FeatureError where n_frames or levels is below 1, or factor is not above 1.
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
    """Linear interpolation from n_in to n_out frames, as indices and weights.

    out[k] = (1 - w[k])·in[lo[k]] + w[k]·in[hi[k]], the convention of
    `torch.nn.functional.interpolate(mode="linear", align_corners=False)`: frame k lies at
    (k + ½)·n_in/n_out - ½, held at the ends.

    Args:
        n_in, n_out: numbers of frames.
        start, stop: the frames out that are wanted; all M = n_out of them by default.

    Returns lo (M,) int64, hi (M,) int64, w (M,) float64 in [0, 1).
    """
    if n_in < 1 or n_out < 1:
        raise FeatureError(f"cannot interpolate from {n_in} to {n_out} frames: at least 1 each")
    # Whole numbers as far as possible: the position is `numerator` / (2·n_out).
    out = np.arange(start, n_out if stop is None else stop, dtype=np.int64)
    numerator = np.maximum((2 * out + 1) * n_in - n_out, 0)
    lo, remainder = np.divmod(numerator, 2 * n_out)
    hi = np.minimum(lo + 1, n_in - 1)
    return lo, hi, remainder / (2 * n_out)


def resample_frames(
    values: np.ndarray, n: int, start: int = 0, stop: int | None = None
) -> np.ndarray:
    """(T, …) to (n, …) by `interpolation_weights`; floats keep their dtype.

    With start and stop, only those of the n frames.
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
    """What each level adds to the one below: s_1 = s̃_1, s_i = ↑s̃_{i-1} - s̃_i.

    s̃_i is `values` (T, D) resampled to lengths[i] directly, ↑ the resampling from one level's
    length to the next (multi-resolution paper, section on speech features; its sign).

    Returns a list of (lengths[i], D) arrays, coarse to fine; the last length must be T.
    """
    values = np.asarray(values)
    if not len(lengths) or lengths[-1] != len(values):
        raise FeatureError(
            f"lengths are {list(lengths)}, values have {len(values)} frames: "
            "the last length must be the number of frames (see level_lengths)"
        )
    levels = [resample_frames(values, n) for n in lengths]
    residuals = [
        resample_frames(coarse, len(fine)) - fine
        for coarse, fine in zip(levels[:-1], levels[1:], strict=True)
    ]
    return [levels[0], *residuals]


def residual_level(
    values: np.ndarray, lengths: Sequence[int], level: int, start: int, stop: int
) -> np.ndarray:
    """Frames `start` to `stop` of `residual_pyramid(values, lengths)[level]`, without the rest.

    Only the frames of `values` (T, D) around them are read.
    """
    fine = resample_frames(values, lengths[level], start, stop)
    if level == 0:
        return fine
    lo, hi, w = interpolation_weights(lengths[level - 1], lengths[level], start, stop)
    w = w[:, None].astype(fine.dtype)
    coarse = resample_frames(values, lengths[level - 1], lo[0], hi[-1] + 1)
    return coarse[lo - lo[0]] * (1 - w) + coarse[hi - lo[0]] * w - fine


def from_residual_pyramid(levels: Sequence[np.ndarray]) -> np.ndarray:
    """The inverse of `residual_pyramid`: s̃_i = ↑s̃_{i-1} - s_i, up to the finest level.

    Works in float64 so that rounding does not build up over levels; returns the dtype of the
    finest level, (T, D).
    """
    if not levels:
        raise FeatureError("an empty pyramid: give at least one level")
    values = np.asarray(levels[0], dtype=np.float64)
    for residual in levels[1:]:
        values = resample_frames(values, len(residual)) - residual
    return values.astype(np.asarray(levels[-1]).dtype, copy=False)
