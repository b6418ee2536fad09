"""Bias of translation-invariant self-attention: it depends only on the distance of two frames.

The bias of head h for a query d frames after its key (Wennberg and Henter 2021, with slopes that
the released code adds) is

    log(sum_k |a_hk| sigmoid(sign(a_hk) (d - o_hk) / s_hk) + |b_h| + 1e-8) - slope_h |d|

so a table over d is sufficient. The slopes are fixed and make attention local: the bias of the head
with the widest view falls by 37 nats at `farthest_view` frames. Attention is therefore computed in
blocks of frames with that many neighbours on both sides, fewer for heads with a narrower view. Cost
and memory are linear in the length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gesturekit.diffusion.config import NetworkConfig

EPSILON = 1e-8
"""Added inside the logarithm; also the attention weight at half of a head's view."""
MIN_QUERIES = 48
"""Least number of frames in a block; blocks have 4/3 of the head's reach if that is more."""
GPU_QUERIES = 256
"""The same on a GPU, where starting a small product takes longer than computing a large one."""


class PositionBias(nn.Module):
    """The position bias of each head: learnt kernels and fixed slopes."""

    slopes: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        shape = config.heads, config.kernels
        self.amplitudes = nn.Parameter(torch.randn(shape) * 0.01)
        self.offsets = nn.Parameter(torch.randn(shape) * 15)
        self.widths = nn.Parameter(torch.full(shape, 5.0))
        self.floors = nn.Parameter(torch.ones(config.heads))
        ratio = config.farthest_view / config.nearest_view
        views = [
            config.nearest_view * ratio ** (h / max(config.heads - 1, 1))
            for h in range(config.heads)
        ]
        # A key 37 nats below the query's own frame has no weight in single precision.
        self.reaches = [math.ceil(view - 1e-9) for view in views]
        slopes = torch.tensor([-2 * math.log(EPSILON) / view for view in views])
        self.register_buffer("slopes", slopes, persistent=False)

    def table(self, reach: int) -> Tensor:
        """Return the bias (H, 2 reach + 1) for distances from -reach to reach (query minus key)."""
        distance = torch.arange(-reach, reach + 1, device=self.slopes.device).float()
        amplitudes = self.amplitudes.float()
        apart = (distance[:, None, None] - self.offsets.float()) / self.widths.float()
        kernels = amplitudes.abs() * torch.sigmoid(amplitudes.sign() * apart)
        score = torch.log(kernels.sum(-1) + self.floors.float().abs() + EPSILON)
        return (score - distance.abs()[:, None] * self.slopes).T


@dataclass(frozen=True)
class Band:
    """Heads of similar reach.

    Attributes:
        heads: the heads.
        blocks: query frames, key frames, and the bias (heads, queries, keys) of each block; the
            queries of all blocks are all frames.
    """

    heads: slice
    blocks: list[tuple[slice, slice, Tensor]]


def bands(bias: PositionBias, n_frames: int) -> list[Band]:
    """Group all heads into bands for a clip of `n_frames`.

    In a band, the widest reach is less than four times the narrowest. At the published sizes, four
    heads reach up to 16 frames and four up to 75. On a GPU all heads are one band.
    """
    is_gpu = bias.slopes.device.type != "cpu"
    least = GPU_QUERIES if is_gpu else MIN_QUERIES
    all_bands: list[Band] = []
    last = len(bias.reaches)
    while last > 0:
        reach = bias.reaches[last - 1]
        first = next(h for h in range(last) if is_gpu or 4 * bias.reaches[h] > reach)
        frames = _blocks(n_frames, reach, max(least, 4 * reach // 3))
        widest = max(max(q.stop - k.start, k.stop - q.start) for q, k in frames)
        table = bias.table(widest)[first:last]
        all_bands.append(Band(slice(first, last), _with_bias(table, frames)))
        last = first
    return all_bands[::-1]


def _blocks(n_frames: int, reach: int, size: int) -> list[tuple[slice, slice]]:
    """Split frames into blocks of `size` queries, with `reach` more keys on either side."""
    if n_frames <= size + 2 * reach:
        return [(slice(0, n_frames), slice(0, n_frames))]
    return [
        (
            slice(first, min(first + size, n_frames)),
            slice(max(first - reach, 0), min(first + size + reach, n_frames)),
        )
        for first in range(0, n_frames, size)
    ]


def _with_bias(
    table: Tensor, frames: list[tuple[slice, slice]]
) -> list[tuple[slice, slice, Tensor]]:
    """Return blocks with their bias (H, queries, keys), from a table (H, 2 R + 1).

    The bias is made of sliding windows over the table (see `PositionBias.table`) without index
    operations, so that gradients are deterministic on every device. Blocks of equal shape share it.
    """
    reach = table.shape[1] // 2
    # Ordered by key minus query, so that one window is one query; the last query comes first.
    ahead = table.flip(1)
    biases: dict[tuple[int, int, int], Tensor] = {}
    blocks = []
    for q, k in frames:
        queries, keys, before = shape = (q.stop - q.start, k.stop - k.start, q.start - k.start)
        if shape not in biases:
            start = reach - before - (queries - 1)
            span = ahead[:, start : start + queries + keys - 1]
            # Contiguous: the fused kernel would otherwise copy it at every call.
            biases[shape] = span.unfold(1, keys, 1).flip(1).contiguous()
        blocks.append((q, k, biases[shape]))
    return blocks
