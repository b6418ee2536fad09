"""Samples of files and arrays: conversion to floats, choice of the channel, repair of faults."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from audio_features.errors import AudioError

CANCELLING = "the channels cancel each other, one is inverted: channel {} is used"
"""Description of the repair by `ChannelLevels.instead_of_mean`."""

_CANCELLED = 0.1
"""Channels cancel if their mean has less than this share of the power that one of them alone,
beside silent ones, would give it."""
_FEW_FAULTY = 0.01
"""Share of samples that may be NaN or infinite; they are interpolated."""
_BLOCK = 1 << 20  # samples processed at a time, which bounds the memory for long files


class ChannelLevels:
    """Power of the channels of a sound and of their mean, about their offsets.

    Args:
        channels: number of channels C.
    """

    def __init__(self, channels: int) -> None:
        self._count = 0
        self._total = np.zeros(channels + 1)
        self._square = np.zeros(channels + 1)

    def add(self, block: np.ndarray, mean: np.ndarray) -> None:
        """Include a block (N, C) of samples, with the mean (N,) of its channels."""
        values = np.column_stack([block, mean]).astype(np.float64)
        values[~np.isfinite(values)] = 0.0
        self._count += len(values)
        self._total += values.sum(axis=0)
        self._square += np.square(values, out=values).sum(axis=0)

    def instead_of_mean(self) -> int | None:
        """Return the loudest channel, from 1, if the channels cancel in the mean, else None."""
        count = max(self._count, 1)
        *powers, of_mean = self._square / count - np.square(self._total / count)
        loudest = int(np.argmax(powers))
        if len(powers) > 1 and of_mean < _CANCELLED * powers[loudest] / len(powers) ** 2:
            return loudest + 1
        return None


def numbers(samples: ArrayLike, name: str) -> np.ndarray:
    """Convert to (N,) or two-dimensional float32 with full scale ±1."""
    if hasattr(samples, "detach") and hasattr(samples, "cpu"):
        # A torch tensor: numpy knows neither bfloat16 nor GPUs.
        samples = samples.detach().cpu()
        samples = samples.float() if samples.is_floating_point() else samples
    try:
        values = np.asarray(samples)
    except (TypeError, ValueError) as error:
        raise AudioError(f"{name}: not an array of samples ({error})") from None
    if values.ndim == 0:
        kind = type(samples).__name__
        raise AudioError(f"{name}: {kind}, expected an array of samples, or the path of a file")
    if values.ndim > 2:  # a batch of one sound
        values = values.reshape([n for n in values.shape if n != 1] or [1])
    if values.ndim not in (1, 2) or not values.size:
        raise AudioError(
            f"{name}: shape {values.shape}, expected samples (N,), or channels (C, N) or (N, C)"
        )
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    if values.dtype == np.int64:  # a list of whole numbers: of the fewest bits that hold them
        for narrower in (np.int16, np.int32):
            if (values == values.astype(narrower)).all():
                values = values.astype(narrower)
                break
    if values.dtype.kind not in "iu" or values.dtype.itemsize > 4:
        raise AudioError(
            f"{name}: dtype {values.dtype}, expected floats with full scale ±1, or integers of 8, "
            "16 or 32 bits"
        )
    half = 2.0 ** (8 * values.dtype.itemsize - 1)
    middle = half if values.dtype.kind == "u" else 0.0
    return ((values - middle) / half).astype(np.float32)


def one_channel(values: np.ndarray) -> tuple[np.ndarray, int | None]:
    """Return the mean (N,) of the channels of (C, N) or (N, C); C is the shorter axis.

    If the channels cancel each other, the loudest one is returned, with its number from 1.
    """
    channels = values.T if values.shape[0] <= values.shape[1] else values
    mean = channels.mean(axis=1, dtype=np.float32)
    levels = ChannelLevels(channels.shape[1])
    levels.add(channels, mean)
    used = levels.instead_of_mean()
    return (mean, None) if used is None else (channels[:, used - 1], used)


def interpolated(samples: np.ndarray, rate: int, repairs: list[str]) -> np.ndarray:
    """Interpolate samples that are not finite if they are few, and describe it in `repairs`."""
    count = sum(
        np.count_nonzero(~np.isfinite(samples[at : at + _BLOCK]))
        for at in range(0, len(samples), _BLOCK)
    )
    if not 0 < count <= _FEW_FAULTY * len(samples):
        return samples
    finite = np.isfinite(samples)
    faulty, good = np.flatnonzero(~finite), np.flatnonzero(finite)
    repairs.append(
        f"NaN or infinite: {count} of {len(samples)} samples, the first at "
        f"{faulty[0] / rate:.3f} s: they are interpolated"
    )
    samples = samples.copy()
    samples[faulty] = np.interp(faulty, good, samples[good])
    return samples
