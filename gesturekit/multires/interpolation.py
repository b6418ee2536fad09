"""Upsampling and padding along time, as index operations.

On a GPU torch can make the backward pass of gathers by index deterministic
(`torch.use_deterministic_algorithms`), and not that of its own interpolation and reflection
padding. The weights are those of the audio front-end: motion and features never disagree on where
a frame lies.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from audio_features.pyramid import interpolation_weights


@lru_cache(maxsize=4096)
def _weights(n_in: int, n_out: int) -> tuple[Tensor, Tensor, Tensor]:
    low, high, weight = interpolation_weights(n_in, n_out)
    return torch.from_numpy(low), torch.from_numpy(high), torch.from_numpy(weight).float()


def resample(x: Tensor, n_frames: int) -> Tensor:
    """(..., T) to (..., n_frames), linear, align_corners=False."""
    if x.shape[-1] == n_frames:
        return x
    low, high, weight = (part.to(x.device) for part in _weights(x.shape[-1], n_frames))
    below = x.index_select(-1, low)
    return below + weight.to(x.dtype) * (x.index_select(-1, high) - below)


def resample_part(x: Tensor, n_frames: int, start: int, stop: int) -> Tensor:
    """Frames `start` to `stop` of `resample(x, n_frames)`, to the bit, without the others."""
    if x.shape[-1] == n_frames:
        return x[..., start:stop]
    if (start, stop) == (0, n_frames):
        return resample(x, n_frames)
    low, high, weight = interpolation_weights(x.shape[-1], n_frames, start, stop)
    below = x.index_select(-1, torch.from_numpy(low).to(x.device))
    above = x.index_select(-1, torch.from_numpy(high).to(x.device))
    return below + torch.from_numpy(weight).float().to(x.device, x.dtype) * (above - below)


@lru_cache(maxsize=4096)
def _reflection(n_frames: int, padding: int) -> Tensor:
    period = max(1, 2 * (n_frames - 1))
    index = torch.arange(-padding, n_frames + padding).remainder(period)
    return torch.minimum(index, period - index).clamp(max=n_frames - 1)


def reflect(x: Tensor, padding: int) -> Tensor:
    """(..., T) to (..., T + 2 padding), mirrored about the end frames as often as it takes."""
    return x.index_select(-1, _reflection(x.shape[-1], padding).to(x.device))
