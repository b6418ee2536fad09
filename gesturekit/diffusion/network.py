"""The denoising network, eps_hat(x_n, c, n): residual blocks of DiffWave around Conformers.

| paper (Fig. 2, section 3.2, A.1) | here |
|---|---|
| noisy poses to channels, to poses again | `enter`; `gather` and `leave` |
| embedding of the step n, its part in each block | `embed_step`, `project_step` |
| the condition c in each block | `project_condition` |
| a residual block, Fig. 2(b) | `residual_block` |
| its stack of L Conformers, or LDA-DW's convolution | `stacks` |
| its 1x1 convolution to residual and skip | `split` |
| a Conformer: attention, convolutions | `Conformer`: `attention`, `widen` and `narrow` |
| translation-invariant attention (TISA) | `Attention`, `PositionBias` |

The position bias of head h for a query d frames after its key (Wennberg and Henter 2021, with
slopes that the released code adds) is

    log(sum_k |a_hk| sigmoid(sign(a_hk) (d - o_hk) / s_hk) + |b_h| + 1e-8) - slope_h |d|

so a table over d is sufficient. The slopes are fixed and make attention local: the bias of the head
with the widest view falls by 37 nats at `farthest_view` frames. Attention is therefore computed in
blocks of frames with that many neighbours on both sides, fewer for heads with a narrower view. Cost
and memory are linear in the length.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.diffusion.config import NetworkConfig
from gesturekit.diffusion.noise_schedule import Predict

FREQUENCIES = 64
"""Number of sines, and of cosines, of the step embedding, from 1 to 1e4 radians per step."""

Band = tuple[slice, list[tuple[slice, slice, Tensor]]]
"""Heads of similar reach, and blocks: query frames, key frames, and bias (heads, queries, keys).

The queries of all blocks are all frames."""

Stack = Callable[[Tensor], Tensor]
"""A map from (B, T, C) to (B, T, 2 C) in a residual block."""


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
        places = (h / max(config.heads - 1, 1) for h in range(config.heads))
        views = [config.nearest_view * ratio**place for place in places]
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


def bands(bias: PositionBias, n_frames: int) -> list[Band]:
    """Group all heads into bands for a clip of `n_frames`.

    In a band, the widest reach is less than four times the narrowest. At the published sizes, four
    heads reach up to 16 frames and four up to 75. On a GPU all heads are one band.

    The bias of a block is sliding windows over the table (see `PositionBias.table`), made without
    index operations, so that gradients are deterministic on every device. Blocks of equal shape
    share it.
    """
    is_gpu = bias.slopes.device.type != "cpu"
    all_bands: list[Band] = []
    last = len(bias.reaches)
    while last > 0:
        reach = bias.reaches[last - 1]
        first = next(h for h in range(last) if is_gpu or 4 * bias.reaches[h] > reach)
        size = max(GPU_QUERIES if is_gpu else MIN_QUERIES, 4 * reach // 3)
        size = n_frames if n_frames <= size + 2 * reach else size
        # Ordered by key minus query, so that one window is one query; the last query comes first.
        widest = min(size + reach, n_frames)
        ahead = bias.table(widest)[first:last].flip(1)
        biases: dict[tuple[int, int, int], Tensor] = {}
        blocks = []
        for begin in range(0, n_frames, size):
            q = slice(begin, min(begin + size, n_frames))
            k = slice(max(begin - reach, 0), min(begin + size + reach, n_frames))
            queries, keys, before = shape = (q.stop - q.start, k.stop - k.start, begin - k.start)
            if shape not in biases:
                start = widest - before - (queries - 1)
                span = ahead[:, start : start + queries + keys - 1]
                # Contiguous: the fused kernel would otherwise copy it at every call.
                biases[shape] = span.unfold(1, keys, 1).flip(1).contiguous()
            blocks.append((q, k, biases[shape]))
        all_bands.append((slice(first, last), blocks))
        last = first
    return all_bands[::-1]


def attend(
    queries: Tensor, keys: Tensor, values: Tensor, bands: list[Band], dropout: float, *, fused: bool
) -> Tensor:
    """Compute attention (B, H, T, D) band by band and block by block.

    `fused` takes torch's kernel, which is faster; plain matrix products and sums have gradients
    that are deterministic on every device. Both compute the same.
    """
    by_band = []
    for heads, blocks in bands:
        by_block = []
        for query_frames, key_frames, bias in blocks:
            q = queries[:, heads, query_frames]
            k, v = keys[:, heads, key_frames], values[:, heads, key_frames]
            if fused:
                mask = bias.to(q.dtype).expand(len(q), -1, -1, -1)
                by_block.append(F.scaled_dot_product_attention(q, k, v, mask, dropout))
            else:
                scores = q @ k.transpose(-1, -2) * q.shape[-1] ** -0.5 + bias
                by_block.append(F.dropout(scores.softmax(-1), dropout) @ v)
        by_band.append(torch.cat(by_block, 2) if len(by_block) > 1 else by_block[0])
    return torch.cat(by_band, 1) if len(by_band) > 1 else by_band[0]


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
        q, k, v = self.read(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        dropout = self.dropout if self.training else 0.0
        attended = attend(q, k, v, bands, dropout, fused=not torch.is_grad_enabled())
        return F.glu(self.write(attended.transpose(1, 2).flatten(2)))


class DilatedConv(nn.Module):
    """A dilated convolution of kernel size 3 over (B, T, C), as one matrix product.

    The narrower side is shifted in time: either three input frames are concatenated, or three parts
    of the output are added.
    """

    def __init__(self, n_in: int, n_out: int, dilation: int, bias: bool = False) -> None:
        super().__init__()
        self.dilation = dilation
        self.gathers = n_in <= n_out
        shape = (n_out, 3 * n_in) if self.gathers else (3 * n_out, n_in)
        self.weight = nn.Parameter(torch.empty(shape))
        bound = (3 * n_in) ** -0.5
        nn.init.uniform_(self.weight, -bound, bound)
        self.bias = nn.Parameter(torch.empty(n_out).uniform_(-bound, bound)) if bias else None

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, T, n_in) to (B, T, n_out)."""
        d, n_frames = self.dilation, x.shape[1]
        if self.gathers:
            padded = F.pad(x, (0, 0, d, d))
            frames = torch.cat([padded[:, i * d : i * d + n_frames] for i in range(3)], -1)
            return F.linear(frames, self.weight, self.bias)
        before, here, after = F.linear(x, self.weight).chunk(3, -1)
        here = here + F.pad(before, (0, 0, d, 0))[:, :n_frames]
        here = here + F.pad(after, (0, 0, 0, d))[:, d:]
        return here if self.bias is None else here + self.bias


class Conformer(nn.Module):
    """Attention and a feed-forward part over one or three frames, both residual and normalised."""

    def __init__(self, config: NetworkConfig, dilation: int) -> None:
        super().__init__()
        self.attention = Attention(config)
        layer: Any = partial(nn.Linear, bias=False)
        if dilation:
            layer = partial(DilatedConv, dilation=dilation)
        self.widen = layer(config.channels, config.feedforward)
        self.narrow = layer(config.feedforward, config.channels)
        self.norm_attention = nn.LayerNorm(config.channels)
        self.norm = nn.LayerNorm(config.channels)
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, x: Tensor, bands: list[Band]) -> Tensor:
        """Map (B, T, channels) to the same shape."""
        x = self.norm_attention(x + self.dropout(self.attention(x, bands)))
        hidden = self.dropout(self.widen(x).relu_())
        return self.norm(x + self.dropout(self.narrow(hidden)))


class ConformerStack(nn.Module):
    """Conformer layers of one residual block."""

    def __init__(self, config: NetworkConfig, dilation: int) -> None:
        super().__init__()
        self.enter = nn.Linear(config.channels, config.channels)
        layers: Any = nn.ModuleList(Conformer(config, dilation) for _ in range(config.layers))
        self.layers: Sequence[Conformer] = layers  # torch's list lacks their type
        self.leave = nn.Linear(config.channels, 2 * config.channels)

    def forward(self, x: Tensor, all_bands: list[list[Band]]) -> Tensor:
        """Map (B, T, C), with the attention bands of each layer, to (B, T, 2 C)."""
        x = self.enter(x)
        for layer, layer_bands in zip(self.layers, all_bands, strict=True):
            x = layer(x, layer_bands)
        return self.leave(x)


def residual_block(
    x: Tensor, step: Tensor, condition: Tensor, stack: Stack, split: nn.Module
) -> tuple[Tensor, Tensor]:
    """Return the output and the skip connection of a residual block, Fig. 2(b); each (B, T, C).

    Args:
        x: (B, T, C), output of the block before.
        step: (B, 1, C), projected embedding of the step.
        condition: (B, T, C), projected condition.
        stack: of Conformers.
        split: 1x1 convolution from C to 2 C channels.
    """
    gate, signal = stack(x + (step + condition)).chunk(2, -1)
    residual, skip = split(gate.sigmoid() * signal.tanh()).chunk(2, -1)
    return (x + residual) * math.sqrt(0.5), skip


def kaiming(n_in: int, n_out: int) -> nn.Linear:
    """Return a linear layer, initialised like the 1x1 convolutions of DiffWave."""
    layer = nn.Linear(n_in, n_out)
    nn.init.kaiming_normal_(layer.weight)
    return layer


class Denoiser(nn.Module):
    """Prediction of the noise, velocity or clean motion from a noisy motion and its condition.

    `to(torch.bfloat16)` halves memory and, on CPUs with bfloat16 arithmetic, time; inputs and
    outputs keep their own precision.

    Args:
        n_motion: X, width of the motion vector.
        n_condition: C, width of the condition; 0 for an unconditional model.
        config: sizes.
    """

    def __init__(self, n_motion: int, n_condition: int, config: NetworkConfig) -> None:
        super().__init__()
        self.n_motion, self.config = n_motion, config
        width = config.channels
        self.enter = kaiming(n_motion, width)
        self.embed_step = nn.Sequential(
            nn.Linear(2 * FREQUENCIES, config.embedding),
            nn.SiLU(),
            nn.Linear(config.embedding, config.embedding),
            nn.SiLU(),
        )
        # The step and condition inputs of all blocks, concatenated.
        of_blocks = config.blocks * width
        self.project_step = nn.Linear(config.embedding, of_blocks)
        self.project_condition = nn.Linear(n_condition, of_blocks) if n_condition else None
        dilations = [config.dilations[i % len(config.dilations)] for i in range(config.blocks)]
        if config.architecture == "conformer":
            self.stacks = nn.ModuleList(ConformerStack(config, d) for d in dilations)
        else:
            stacks = [DilatedConv(width, 2 * width, d, bias=True) for d in dilations]
            for stack in stacks:
                nn.init.kaiming_normal_(stack.weight)
            self.stacks = nn.ModuleList(stacks)
        self.split = nn.ModuleList(kaiming(width, 2 * width) for _ in dilations)
        self.gather = kaiming(width, width)
        self.leave = nn.Linear(width, n_motion)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, noisy: Tensor, condition: Tensor, step: Tensor) -> Tensor:
        """Predict noise, velocity or clean motion for a batch of noisy motions.

        Args:
            noisy: (B, T, X).
            condition: (B, T, C).
            step: (B,) steps of the diffusion; fractional ones are allowed.

        Returns:
            (B, T, X).
        """
        conditions, steps = self._conditions(condition), self._steps(step)
        return self._run(noisy, steps[:, :, None], conditions, self._stacks(noisy.shape[1]))

    @torch.no_grad()
    def for_condition(self, condition: Tensor, steps: Iterable[int]) -> Predict:
        """Precompute everything that does not depend on the motion.

        Call it in eval mode, and again after a change of the weights.

        Args:
            condition: (B, T, C), or (1, T, C) for any number of motions.
            steps: all steps for which `predict` will be called.

        Returns:
            `predict(noisy (B, T, X), step) -> (B, T, X)`.
        """
        steps = list(steps)
        conditions = self._conditions(condition).contiguous()
        embedded = self._steps(torch.tensor(steps, device=condition.device)).unbind(1)
        of_step = dict(zip(steps, embedded, strict=True))
        stacks = self._stacks(condition.shape[1])

        @torch.no_grad()
        def predict(noisy: Tensor, step: int) -> Tensor:
            return self._run(noisy, of_step[step][:, None, None], conditions, stacks)

        return predict

    def _conditions(self, condition: Tensor) -> Tensor:
        """Project a condition (B, T, C) to the input (blocks, B, T, channels) of each block."""
        if self.project_condition is None:
            return self.enter.weight.new_zeros(self.config.blocks, 1, 1, 1)
        projected = self.project_condition(condition.to(self.enter.weight.dtype))
        return projected.unflatten(-1, (self.config.blocks, -1)).movedim(-2, 0)

    def _steps(self, step: Tensor) -> Tensor:
        """Embed steps (B,) as the input (blocks, B, channels) of each block."""
        # By default in double precision: angles reach 1e6 radians, too large for float32.
        precision = getattr(torch, self.config.step_angles)
        exponents = torch.linspace(0, 4, FREQUENCIES, dtype=torch.float64, device=step.device)
        angle = step.to(precision)[:, None] * 10 ** exponents.to(precision)
        waves = torch.cat([angle.sin(), angle.cos()], 1).to(self.enter.weight.dtype)
        projected = self.project_step(self.embed_step(waves))
        return projected.unflatten(1, (self.config.blocks, -1)).movedim(1, 0)

    def _stacks(self, n_frames: int) -> list[Stack]:
        """Return the stack of each block, with its attention bands for clips of `n_frames`."""
        made: list[Stack] = []
        for stack in self.stacks:
            if isinstance(stack, ConformerStack):
                of_layers = [bands(layer.attention.bias, n_frames) for layer in stack.layers]
                made.append(partial(stack, all_bands=of_layers))
            else:
                made.append(stack)
        return made

    def _run(self, noisy: Tensor, steps: Tensor, conditions: Tensor, stacks: list[Stack]) -> Tensor:
        x = self.enter(noisy.to(self.enter.weight.dtype)).relu_()
        total = 0
        for of_block in zip(steps, conditions, stacks, self.split, strict=True):
            x, skip = residual_block(x, *of_block)
            total = total + skip
        total = total * len(stacks) ** -0.5
        return self.leave(self.gather(total).relu_()).to(noisy.dtype)
