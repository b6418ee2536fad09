"""Resampling and padding along time.

Both are index operations: torch has deterministic backward passes of these on a GPU
(`torch.use_deterministic_algorithms`), but not of its own interpolation and reflection padding. On
a CPU numpy gathers frames several times faster than torch. The interpolation weights are those of
the audio front-end, so that motion and speech features have the same frame times.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from audio_features.pyramid import interpolation_weights


@lru_cache(maxsize=4096)
def _weights(
    n_in: int, n_out: int, dtype: torch.dtype, start: int, stop: int | None
) -> tuple[Tensor, Tensor, Tensor]:
    low, high, weight = map(torch.from_numpy, interpolation_weights(n_in, n_out, start, stop))
    return low, high, weight.to(dtype)


def resample(x: Tensor, n_frames: int, start: int = 0, stop: int | None = None) -> Tensor:
    """Return x (..., T) as (..., n_frames): linear interpolation with align_corners=False.

    With `start` and `stop` only these frames of the result are computed, equal in every bit.
    """
    if x.shape[-1] == n_frames:
        return x[..., start:stop]
    is_whole = start == 0 and stop in (None, n_frames)
    weights = _weights if is_whole else _weights.__wrapped__
    low, high, weight = weights(x.shape[-1], n_frames, x.dtype, start, stop)
    if x.device.type == "cpu" and x.dtype == torch.float32:
        return _Interpolate.apply(x, low, high, weight)
    low, high, weight = (part.to(x.device) for part in (low, high, weight))
    below = x.index_select(-1, low)
    return below + weight * (x.index_select(-1, high) - below)


class _Interpolate(torch.autograd.Function):
    """Interpolation of float32 on a CPU, equal in every bit, and its transpose."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, low: Tensor, high: Tensor, weight: Tensor) -> Tensor:
        ctx.n_frames = x.shape[-1]
        ctx.places = low, high, weight
        frames = x.numpy()
        below, made = (frames.take(index.numpy(), axis=-1) for index in (low, high))
        made -= below
        made *= weight.numpy()
        made += below
        return torch.from_numpy(made)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        low, high, weight = ctx.places
        # Time comes first: index_add_ is fast where it adds whole rows. Frame by frame, low before
        # high, is the order of the sums.
        gradient = gradient.movedim(-1, 0).contiguous()
        above = weight.reshape(-1, *[1] * (gradient.ndim - 1)) * gradient
        parts = torch.stack([gradient - above, above], dim=1).flatten(0, 1)
        made = gradient.new_zeros(ctx.n_frames, *gradient.shape[1:])
        made.index_add_(0, torch.stack([low, high], dim=1).flatten(), parts)
        return made.movedim(0, -1).contiguous(), None, None, None


@lru_cache(maxsize=4096)
def _reflection(n_frames: int, padding: int) -> Tensor:
    period = max(1, 2 * (n_frames - 1))
    index = torch.arange(-padding, n_frames + padding).remainder(period)
    return torch.minimum(index, period - index).clamp(max=n_frames - 1)


def reflect(x: Tensor, padding: int) -> Tensor:
    """Pad x (..., T) by reflection to (..., T + 2 padding); short signals reflect repeatedly."""
    return x.index_select(-1, _reflection(x.shape[-1], padding).to(x.device))
