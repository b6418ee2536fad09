"""Self-attention whose position bias depends on the distance between two frames alone.

The bias of head h for a query d frames after its key (Wennberg and Henter 2021, with slopes that
the released code adds) is

    log(sum_k |a_hk| sigmoid(sign(a_hk) (d - o_hk) / s_hk) + |b_h| + 1e-8) - slope_h |d|

so that a table over d holds all of it. The slopes are not learnt: the farthest-sighted head loses
37 nats at `farthest_view` frames. Attention is therefore computed in blocks of frames, each with
that many neighbours on both sides: cost and memory grow with the length, not with its square.
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
        share = torch.linspace(0, 1, config.heads, dtype=torch.float64)
        views = config.nearest_view * (config.farthest_view / config.nearest_view) ** share
        self.register_buffer("slopes", (-math.log(LEAST) / (views / 2)).float(), persistent=False)

    def table(self, reach: int) -> Tensor:
        """(H, 2 reach + 1): the bias for queries `reach` frames before the key up to after it."""
        distance = torch.arange(-reach, reach + 1, device=self.slopes.device).float()
        apart = (distance[:, None, None] - self.offsets) / self.widths
        kernels = self.amplitudes.abs() * torch.sigmoid(self.amplitudes.sign() * apart)
        score = torch.log(kernels.sum(-1) + self.floors.abs() + LEAST)
        return (score - distance.abs()[:, None] * self.slopes).T


@dataclass(frozen=True)
class Block:
    """Queries `first:last` look at keys `first_key:last_key`."""

    first: int
    last: int
    first_key: int
    last_key: int


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
    """(H, queries, keys) for each block; blocks of one shape share one tensor.

    Args:
        table: (H, 2 R + 1) of `PositionBias.table`, wide enough for the farthest key.
    """
    reach = table.shape[1] // 2
    # By key minus query, so that rows of a window over it are queries, last one first.
    ahead = table.flip(1)
    made: dict[tuple[int, int, int], Tensor] = {}
    biases = []
    for block in blocks:
        queries, keys = block.last - block.first, block.last_key - block.first_key
        before = block.first - block.first_key
        shape = queries, keys, before
        if shape not in made:
            # Window p starts at key 0 minus query (queries - 1 - p).
            start = reach - before - (queries - 1)
            span = ahead[:, start : start + queries + keys - 1]
            made[shape] = span.unfold(1, keys, 1).flip(1)
        biases.append(made[shape])
    return biases


def attend(
    queries: Tensor,
    keys: Tensor,
    values: Tensor,
    blocks: list[Block],
    biases: list[Tensor],
    dropout: float,
) -> Tensor:
    """Attention of (B, H, T, D), block by block, to (B, H, T, D).

    Without gradients by the fused kernel of torch; with them in its parts, whose gradients come
    from matrix products and sums in a fixed order on every device.
    """
    heads = []
    for block, bias in zip(blocks, biases, strict=True):
        q = queries[:, :, block.first : block.last]
        k = keys[:, :, block.first_key : block.last_key]
        v = values[:, :, block.first_key : block.last_key]
        if torch.is_grad_enabled():
            scores = q @ k.transpose(-1, -2) * q.shape[-1] ** -0.5 + bias
            weights = F.dropout(scores.softmax(-1), dropout, training=dropout > 0)
            heads.append(weights @ v)
        else:
            mask = bias.to(q.dtype).expand(len(q), -1, -1, -1)
            heads.append(F.scaled_dot_product_attention(q, k, v, mask, dropout))
    return heads[0] if len(heads) == 1 else torch.cat(heads, 2)


class Attention(nn.Module):
    """Multi-head attention with a gated output."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.dropout = config.dropout
        self.bias = PositionBias(config)
        self.read = nn.Linear(config.channels, 3 * config.channels, bias=False)
        self.write = nn.Linear(config.channels, 2 * config.channels)

    def forward(self, x: Tensor, blocks: list[Block], biases: list[Tensor]) -> Tensor:
        """(B, T, channels) to the same shape."""
        batch, n_frames, channels = x.shape
        q, k, v = (
            self.read(x)
            .view(batch, n_frames, 3, self.heads, channels // self.heads)
            .permute(2, 0, 3, 1, 4)
        )
        seen = attend(q, k, v, blocks, biases, self.dropout if self.training else 0.0)
        return F.glu(self.write(seen.transpose(1, 2).reshape(batch, n_frames, channels)))
