"""Noise of the state of movement: its parameters, fitted to scores, and noise drawn from them.

Noise depends on its seed and on the time alone, so that any part of a motion can be drawn by
itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

_BETWEEN_TAKES, _PRIOR_TAKES = 1 / 3, 3.0
"""Share of the variance between takes that is expected before any recording is seen, and the number
of takes that count as much as that expectation."""
_WIDTHS = np.geomspace(1.5, 24.0, 13)
"""Smoothness of the component within takes to choose from: seconds of standard deviation of the
Gaussian that smooths white noise. Its correlation at lag t is exp(-t^2 / (4 width^2))."""
_LAGS = 24
STEP, STEPS_OF_TAKE = 0.25, 8
"""Seconds between the points at which noise within takes is drawn; points in each `take`."""
_TRUNCATED = 4.0
"""Gaussians end at this many standard deviations."""
_FAST_SECONDS = 2.0
"""Seconds to each side from which fast noise is filtered."""
_BLOCK, _ZERO = 256, 2**31
"""Points of white noise that are drawn at a time; number of the block that begins at time 0."""


def mixing(noise: np.ndarray, fast: np.ndarray) -> np.ndarray:
    """Return the Cholesky factor (C, C) of the correlation of noise (C, T) of unit variance.

    Slow and fast channels are independent. The smallest variances are raised.
    """
    correlation = (noise @ noise.T) / noise.shape[1] * (fast[:, None] == fast)
    values, vectors = np.linalg.eigh(correlation)
    correlation = (vectors * np.maximum(values, 1e-6)) @ vectors.T
    scale = np.sqrt(np.diag(correlation))
    return np.linalg.cholesky(correlation / np.outer(scale, scale))


def share_between_takes(within: np.ndarray, takes: int) -> np.ndarray:
    """Return the share (C,) of the variance between takes, given that within them, (C,)."""
    count = takes - 1
    return (count * (1 - within) + _PRIOR_TAKES * _BETWEEN_TAKES) / (count + _PRIOR_TAKES)


def within_takes(scores: Sequence[np.ndarray], fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of the variance within takes, and its smoothness in seconds, both (C,).

    They are fitted to half the mean squared difference of frames of a recording, at lags up to half
    of the longest recording (a variogram). It does not depend on the recordings' means, which are
    known badly.

    Args:
        scores: (C, T_k) of variance 1 in all recordings together.
        fps: frames per second.
    """
    longest = max(curves.shape[1] for curves in scores)
    lags = np.unique(np.geomspace(max(1, fps / 2), max(2, longest / 2), _LAGS).astype(int))
    lags = lags[lags < longest]
    if not len(lags):
        return np.full(len(scores[0]), 0.5), np.full(len(scores[0]), _WIDTHS[0])
    counts = np.zeros(len(lags), int)
    halves = np.zeros((len(lags), len(scores[0])))
    for i, lag in enumerate(lags):
        for curves in scores:
            if curves.shape[1] > lag:
                counts[i] += curves.shape[1] - lag
                halves[i] += np.square(curves[:, lag:] - curves[:, :-lag]).sum(axis=1)
    halves /= 2 * counts[:, None]
    shapes = 1 - np.exp(-np.square(lags[:, None] / fps / _WIDTHS) / 4)  # (lags, widths)
    weights = counts[:, None]
    shares = ((weights * shapes).T @ halves) / (weights * np.square(shapes)).sum(axis=0)[:, None]
    shares = np.clip(shares, 0.0, 1.0)  # (widths, C)
    errors = np.square(halves[:, None] - shapes[:, :, None] * shares).transpose(1, 2, 0) @ counts
    best = errors.argmin(axis=0)
    return shares[best, np.arange(len(best))], _WIDTHS[best]


def spectral_kernels(noise: Sequence[np.ndarray], fps: float) -> np.ndarray:
    """Return filters (F, 2 R + 1) that give white noise the spectrum of noise (F, T_k)."""
    reach = round(_FAST_SECONDS * fps)
    lags = range(min(reach + 1, max(curves.shape[1] for curves in noise)))
    covariance = np.zeros((len(noise[0]), reach + 1))
    for lag in lags:
        products = [rows[:, lag:] * rows[:, : rows.shape[1] - lag] for rows in noise]
        covariance[:, lag] = np.concatenate(products, axis=1).mean(axis=1)
    covariance *= np.hanning(2 * reach + 3)[reach + 1 : -1]
    both = np.concatenate([covariance, covariance[:, :0:-1]], axis=1)
    amplitude = np.sqrt(np.maximum(np.fft.rfft(both).real, 0.0))
    kernels = np.fft.fftshift(np.fft.irfft(amplitude, 2 * reach + 1), axes=1)
    return kernels / np.maximum(np.linalg.norm(kernels, axis=1, keepdims=True), 1e-9)


def filtered(
    seed: int, mixing: np.ndarray, kernels: Sequence[np.ndarray], places: np.ndarray
) -> np.ndarray:
    """Return white noise at whole numbers, filtered and interpolated at places (N,): (C, N).

    Args:
        seed: of the noise.
        mixing: (C, C) Cholesky factor of the correlation between channels.
        kernels: (2 R + 1,) filter of each channel.
        places: (N,).
    """
    if not len(mixing) or not len(places):
        return np.empty((len(mixing), len(places)))
    reach = len(kernels[0]) // 2
    low, high = math.floor(places.min()) - reach, math.floor(places.max()) + 1 + reach
    blocks = range(low // _BLOCK, high // _BLOCK + 1)
    white = np.concatenate([_white(seed, block, len(mixing)) for block in blocks])
    white = mixing @ white[low - blocks[0] * _BLOCK :][: high - low + 1].T
    at = np.arange(low + reach, high - reach + 1)
    curves = [np.convolve(*pair, mode="valid") for pair in zip(white, kernels, strict=True)]
    return np.stack([np.interp(places, at, curve) for curve in curves])


@lru_cache(maxsize=256)
def _white(seed: int, block: int, channels: int) -> np.ndarray:
    """Return a block of white noise, (_BLOCK, channels)."""
    return np.random.default_rng((seed, block + _ZERO)).standard_normal((_BLOCK, channels))


@lru_cache(maxsize=64)
def gaussian(width: float, widest: float) -> np.ndarray:
    """Return a Gaussian of `width` points and unit norm, as long as one of `widest` points."""
    impulse = np.zeros(2 * (math.ceil(_TRUNCATED * widest) + 1) + 1)
    impulse[len(impulse) // 2] = 1.0
    kernel = gaussian_filter1d(impulse, width, truncate=_TRUNCATED)
    return kernel / np.linalg.norm(kernel)
