"""Upsampling and padding along time, as index operations.

On a GPU torch can make the backward pass of gathers by index deterministic
(`torch.use_deterministic_algorithms`), and not that of its own interpolation and reflection
padding. On a CPU torch gathers frames several times slower than numpy does. The weights are
those of the audio front-end: motion and features never disagree on where a frame lies.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from audio_features.pyramid import interpolation_weights
from gesturekit.compiled import compiled


@lru_cache(maxsize=4096)
def _weights(n_in: int, n_out: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    low, high, weight = map(torch.from_numpy, interpolation_weights(n_in, n_out))
    return low, high, weight.to(dtype)


def resample(x: Tensor, n_frames: int) -> Tensor:
    """(..., T) to (..., n_frames), linear, align_corners=False."""
    if x.shape[-1] == n_frames:
        return x
    return _between(x, *_weights(x.shape[-1], n_frames, x.dtype))


def resample_part(x: Tensor, n_frames: int, start: int, stop: int) -> Tensor:
    """Frames `start` to `stop` of `resample(x, n_frames)`, to the bit, without the others."""
    if x.shape[-1] == n_frames:
        return x[..., start:stop]
    if (start, stop) == (0, n_frames):
        return resample(x, n_frames)
    low, high, weight = map(
        torch.from_numpy, interpolation_weights(x.shape[-1], n_frames, start, stop)
    )
    return _between(x, low, high, weight.to(x.dtype))


def _between(x: Tensor, low: Tensor, high: Tensor, weight: Tensor) -> Tensor:
    """Between frames `low` and `high` of (..., T), as far as `weight` says."""
    if x.device.type == "cpu" and x.dtype == torch.float32:
        return _Between.apply(x, low, high, weight)
    low, high, weight = (part.to(x.device) for part in (low, high, weight))
    below = x.index_select(-1, low)
    return below + weight * (x.index_select(-1, high) - below)


class _Between(torch.autograd.Function):
    """`_between` of float32 on a CPU, to the bit, and its transpose."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, low: Tensor, high: Tensor, weight: Tensor) -> Tensor:
        ctx.n_frames = x.shape[-1]
        ctx.places = [part.numpy() for part in (low, high, weight)]
        low, high, weight = ctx.places
        frames = x.numpy()
        below, made = frames.take(low, axis=-1), frames.take(high, axis=-1)
        made -= below
        made *= weight
        made += below
        return torch.from_numpy(made)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        made = gradient.new_zeros(*gradient.shape[:-1], ctx.n_frames)
        flat = gradient.reshape(-1, gradient.shape[-1]).contiguous().numpy()
        _resample_back(flat, *ctx.places, made.view(-1, ctx.n_frames).numpy())
        return made, None, None, None


@compiled()
def _resample_back(
    gradient: np.ndarray, low: np.ndarray, high: np.ndarray, weight: np.ndarray, made: np.ndarray
) -> None:
    for c in range(len(gradient)):
        for t in range(len(low)):
            above = weight[t] * gradient[c, t]
            made[c, low[t]] += gradient[c, t] - above
            made[c, high[t]] += above


@lru_cache(maxsize=4096)
def _reflection(n_frames: int, padding: int) -> Tensor:
    period = max(1, 2 * (n_frames - 1))
    index = torch.arange(-padding, n_frames + padding).remainder(period)
    return torch.minimum(index, period - index).clamp(max=n_frames - 1)


def reflect(x: Tensor, padding: int) -> Tensor:
    """(..., T) to (..., T + 2 padding), mirrored about the end frames as often as it takes."""
    return x.index_select(-1, _reflection(x.shape[-1], padding).to(x.device))
