"""Self-attention whose position bias depends on the distance between two frames alone.

The bias of head h for a query d frames after its key (Wennberg and Henter 2021, with slopes that
the released code adds) is

    log(sum_k |a_hk| sigmoid(sign(a_hk) (d - o_hk) / s_hk) + |b_h| + 1e-8) - slope_h |d|

so that a table over d holds all of it. The slopes are not learnt: the farthest-sighted head loses
37 nats at `farthest_view` frames. Attention is therefore computed in blocks of frames, each with
that many neighbours on both sides, and near-sighted heads with fewer: cost and memory grow with the
length, not with its square.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.diffusion.config import NetworkConfig

LEAST = 1e-8
"""Inside the logarithm; also the weight that is left at half of a head's view."""
LEAST_QUERIES = 48
"""Frames of a block of attention; more for heads that see far, 4/3 of their reach."""


class PositionBias(nn.Module):
    """The learnt part of the bias, and its slopes; one number a head for each distance."""

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
        # 37 nats below its own frame a key weighs nothing, in single precision.
        self.reaches = [math.ceil(view - 1e-9) for view in views]
        slopes = torch.tensor([-2 * math.log(LEAST) / view for view in views])
        self.register_buffer("slopes", slopes, persistent=False)

    def table(self, reach: int) -> Tensor:
        """(H, 2 reach + 1): the bias for queries `reach` frames before the key up to after it."""
        distance = torch.arange(-reach, reach + 1, device=self.slopes.device).float()
        amplitudes = self.amplitudes.float()
        apart = (distance[:, None, None] - self.offsets.float()) / self.widths.float()
        kernels = amplitudes.abs() * torch.sigmoid(amplitudes.sign() * apart)
        score = torch.log(kernels.sum(-1) + self.floors.float().abs() + LEAST)
        return (score - distance.abs()[:, None] * self.slopes).T


@dataclass(frozen=True)
class Block:
    """Queries `first:last` look at keys `first_key:last_key`."""

    first: int
    last: int
    first_key: int
    last_key: int


@dataclass(frozen=True)
class Band:
    """Heads `first:last` and the blocks in which they are computed, with a bias for each.

    `biases` are (heads, queries, keys); blocks of one shape share one tensor.
    """

    first: int
    last: int
    blocks: list[Block]
    biases: list[Tensor]


def blocks_of(n_frames: int, reach: int, size: int) -> list[Block]:
    """Blocks of `size` queries that see `reach` frames on either side; a short clip is one."""
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
    """The bias of each block, (H, queries, keys), from (H, 2 R + 1) of `PositionBias.table`.

    Rows of windows over the table: no index is gathered, so that gradients are sums in a fixed
    order on every device.
    """
    reach = table.shape[1] // 2
    # By key minus query, so that a window is what one query sees; the last query comes first.
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
            # Laid out row by row: the fused kernel would do so anew at every call.
            made[shape] = span.unfold(1, keys, 1).flip(1).contiguous()
        biases.append(made[shape])
    return biases


def bands(bias: PositionBias, n_frames: int) -> list[Band]:
    """The bands of all heads over so many frames.

    Heads are computed together where the farthest-sighted sees less than four times as far as the
    others. At the published sizes, four heads see 16 frames and four see 75.
    """
    made: list[Band] = []
    last = len(bias.reaches)
    while last > 0:
        reach = bias.reaches[last - 1]
        first = next(h for h in range(last) if 4 * bias.reaches[h] > reach)
        blocks = blocks_of(n_frames, reach, max(LEAST_QUERIES, 4 * reach // 3))
        widest = max(max(b.last - b.first_key, b.last_key - b.first) for b in blocks)
        table = bias.table(widest)[first:last]
        made.append(Band(first, last, blocks, bias_of_blocks(table, blocks)))
        last = first
    return made[::-1]


def attend(
    queries: Tensor, keys: Tensor, values: Tensor, bands: list[Band], dropout: float
) -> Tensor:
    """Attention of (B, H, T, D), band by band and block by block, to (B, H, T, D).

    Without gradients by the fused kernel of torch; with them in its parts, whose gradients come
    from matrix products and sums in a fixed order on every device.
    """
    seen = []
    for band in bands:
        heads = slice(band.first, band.last)
        parts = []
        for block, bias in zip(band.blocks, band.biases, strict=True):
            q = queries[:, heads, block.first : block.last]
            k = keys[:, heads, block.first_key : block.last_key]
            v = values[:, heads, block.first_key : block.last_key]
            if torch.is_grad_enabled():
                scores = q @ k.transpose(-1, -2) * q.shape[-1] ** -0.5 + bias
                weights = F.dropout(scores.softmax(-1), dropout, training=dropout > 0)
                parts.append(weights @ v)
            else:
                mask = bias.to(q.dtype).expand(len(q), -1, -1, -1)
                parts.append(F.scaled_dot_product_attention(q, k, v, mask, dropout))
        seen.append(torch.cat(parts, 2) if len(parts) > 1 else parts[0])
    return torch.cat(seen, 1) if len(seen) > 1 else seen[0]


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
        """(B, T, channels) to the same shape."""
        batch, n_frames, channels = x.shape
        q, k, v = (
            self.read(x)
            .view(batch, n_frames, 3, self.heads, channels // self.heads)
            .permute(2, 0, 3, 1, 4)
        )
        seen = attend(q, k, v, bands, self.dropout if self.training else 0.0)
        return F.glu(self.write(seen.transpose(1, 2).reshape(batch, n_frames, channels)))
