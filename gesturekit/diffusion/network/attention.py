"""Translation-invariant self-attention: the bias depends only on the distance of two frames.

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
import torch.nn.functional as F
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
class Block:
    """Queries `first:last` attend to keys `first_key:last_key`."""

    first: int
    last: int
    first_key: int
    last_key: int


@dataclass(frozen=True)
class Band:
    """Heads `first:last` with the blocks in which they are computed.

    Attributes:
        first: first head.
        last: last head, excluded.
        blocks: that cover all frames.
        biases: (heads, queries, keys) for each block; blocks of equal shape share one tensor.
    """

    first: int
    last: int
    blocks: list[Block]
    biases: list[Tensor]


def blocks_of(n_frames: int, reach: int, size: int) -> list[Block]:
    """Split frames into blocks of `size` queries with `reach` more keys on either side."""
    if n_frames <= size + 2 * reach:
        return [Block(0, n_frames, 0, n_frames)]
    return [
        Block(
            first,
            min(first + size, n_frames),
            max(first - reach, 0),
            min(first + size + reach, n_frames),
        )
        for first in range(0, n_frames, size)
    ]


def bias_of_blocks(table: Tensor, blocks: list[Block]) -> list[Tensor]:
    """Return the bias (H, queries, keys) of each block from a table (H, 2 R + 1).

    The bias is made of sliding windows over the table (see `PositionBias.table`) without index
    operations, so that gradients are deterministic on every device.
    """
    reach = table.shape[1] // 2
    # Ordered by key minus query, so that one window is one query; the last query comes first.
    ahead = table.flip(1)
    made: dict[tuple[int, int, int], Tensor] = {}
    biases = []
    for block in blocks:
        queries, keys = block.last - block.first, block.last_key - block.first_key
        before = block.first - block.first_key
        shape = queries, keys, before
        if shape not in made:
            start = reach - before - (queries - 1)
            span = ahead[:, start : start + queries + keys - 1]
            # Contiguous: the fused kernel would otherwise copy it at every call.
            made[shape] = span.unfold(1, keys, 1).flip(1).contiguous()
        biases.append(made[shape])
    return biases


def bands(bias: PositionBias, n_frames: int) -> list[Band]:
    """Group all heads into bands for a clip of `n_frames`.

    In a band, the widest reach is less than four times the narrowest. At the published sizes, four
    heads reach up to 16 frames and four up to 75. On a GPU all heads are one band.
    """
    is_gpu = bias.slopes.device.type != "cpu"
    made: list[Band] = []
    last = len(bias.reaches)
    while last > 0:
        reach = bias.reaches[last - 1]
        first = next(h for h in range(last) if is_gpu or 4 * bias.reaches[h] > reach)
        least = GPU_QUERIES if is_gpu else MIN_QUERIES
        blocks = blocks_of(n_frames, reach, max(least, 4 * reach // 3))
        widest = max(max(b.last - b.first_key, b.last_key - b.first) for b in blocks)
        table = bias.table(widest)[first:last]
        made.append(Band(first, last, blocks, bias_of_blocks(table, blocks)))
        last = first
    return made[::-1]


def attend(
    queries: Tensor, keys: Tensor, values: Tensor, bands: list[Band], dropout: float
) -> Tensor:
    """Compute attention (B, H, T, D) band by band and block by block.

    Without gradients, this uses torch's fused kernel. With gradients, it uses plain matrix products
    and sums, whose gradients are deterministic on every device.
    """
    heads_done = []
    for band in bands:
        heads = slice(band.first, band.last)
        parts = []
        for block, bias in zip(band.blocks, band.biases, strict=True):
            q = queries[:, heads, block.first : block.last]
            k = keys[:, heads, block.first_key : block.last_key]
            v = values[:, heads, block.first_key : block.last_key]
            if torch.is_grad_enabled():
                scores = q @ k.transpose(-1, -2) * q.shape[-1] ** -0.5 + bias
                weights = F.dropout(scores.softmax(-1), dropout)
                parts.append(weights @ v)
            else:
                mask = bias.to(q.dtype).expand(len(q), -1, -1, -1)
                parts.append(F.scaled_dot_product_attention(q, k, v, mask, dropout))
        heads_done.append(torch.cat(parts, 2) if len(parts) > 1 else parts[0])
    return torch.cat(heads_done, 1) if len(heads_done) > 1 else heads_done[0]


class Attention(nn.Module):
    """Multi-head attention with a gated output."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.dropout = config.dropout
        self.bias = PositionBias(config)
        self.read = nn.Linear(config.channels, 3 * config.channels, bias=False)
        self.write = nn.Linear(config.channels, 2 * config.channels)

    def forward(self, x: Tensor, bands: list[Band]) -> Tensor:
        """Map (B, T, channels) to the same shape."""
        batch, n_frames, channels = x.shape
        q, k, v = (
            self.read(x)
            .view(batch, n_frames, 3, self.heads, channels // self.heads)
            .permute(2, 0, 3, 1, 4)
        )
        attended = attend(q, k, v, bands, self.dropout if self.training else 0.0)
        return F.glu(self.write(attended.transpose(1, 2).reshape(batch, n_frames, channels)))
