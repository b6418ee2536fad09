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
from gesturekit.diffusion.position_bias import Band, PositionBias, bands

FREQUENCIES = 64
"""Number of sines, and of cosines, of the step embedding, from 1 to 1e4 radians per step."""

Stack = Callable[[Tensor], Tensor]
"""A map from (B, T, C) to (B, T, 2 C) in a residual block."""


def attend(
    queries: Tensor, keys: Tensor, values: Tensor, bands: list[Band], dropout: float, *, fused: bool
) -> Tensor:
    """Compute attention (B, H, T, D) band by band and block by block.

    `fused` takes torch's kernel, which is faster; plain matrix products and sums have gradients
    that are deterministic on every device. Both compute the same.
    """
    by_band = []
    for band in bands:
        by_block = []
        for query_frames, key_frames, bias in band.blocks:
            q = queries[:, band.heads, query_frames]
            k, v = keys[:, band.heads, key_frames], values[:, band.heads, key_frames]
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
        sizes = (config.channels, config.feedforward), (config.feedforward, config.channels)
        self.widen, self.narrow = (
            DilatedConv(*size, dilation) if dilation else nn.Linear(*size, bias=False)
            for size in sizes
        )
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

    def bands(self, n_frames: int) -> list[list[Band]]:
        """Return the attention bands of each layer for clips of `n_frames`."""
        return [bands(layer.attention.bias, n_frames) for layer in self.layers]

    def forward(self, x: Tensor, bands: list[list[Band]]) -> Tensor:
        """Map (B, T, C), with the attention bands of each layer, to (B, T, 2 C)."""
        x = self.enter(x)
        for layer, layer_bands in zip(self.layers, bands, strict=True):
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
        self.project_step = nn.Linear(config.embedding, config.blocks * width)
        self.project_condition = (
            nn.Linear(n_condition, config.blocks * width) if n_condition else None
        )
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
    def for_condition(
        self, condition: Tensor, steps: Iterable[int]
    ) -> Callable[[Tensor, int], Tensor]:
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
        return [
            partial(stack, bands=stack.bands(n_frames))
            if isinstance(stack, ConformerStack)
            else stack
            for stack in self.stacks
        ]

    def _run(self, noisy: Tensor, steps: Tensor, conditions: Tensor, stacks: list[Stack]) -> Tensor:
        x = self.enter(noisy.to(self.enter.weight.dtype)).relu_()
        total = 0
        for step, condition, stack, split in zip(
            steps, conditions, stacks, self.split, strict=True
        ):
            x, skip = residual_block(x, step, condition, stack, split)
            total = total + skip
        total = total * len(stacks) ** -0.5
        return self.leave(self.gather(total).relu_()).to(noisy.dtype)
