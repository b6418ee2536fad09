"""The denoising network: gated residual blocks of DiffWave around stacks of Conformers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.diffusion.config import NetworkConfig
from gesturekit.diffusion.network.attention import Attention, Band, bands
from gesturekit.errors import ModelError

FREQUENCIES = 64
"""Number of sines, and of cosines, of the step embedding, from 1 to 1e4 radians per step."""


def neighbours(x: Tensor, dilation: int) -> Tensor:
    """Concatenate each frame (B, T, C) with those `dilation` before and after to (B, T, 3 C)."""
    padded = F.pad(x, (0, 0, dilation, dilation))
    n_frames = x.shape[1]
    return torch.cat([padded[:, i * dilation : i * dilation + n_frames] for i in range(3)], -1)


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
        if self.gathers:
            return F.linear(neighbours(x, self.dilation), self.weight, self.bias)
        before, here, after = F.linear(x, self.weight).chunk(3, -1)
        d, n_frames = self.dilation, x.shape[1]
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
    """Conformer layers of one residual block, before its gate."""

    def __init__(self, config: NetworkConfig, dilation: int) -> None:
        super().__init__()
        self.enter = nn.Linear(config.channels, config.channels)
        layers: Any = nn.ModuleList(Conformer(config, dilation) for _ in range(config.layers))
        self.layers: Sequence[Conformer] = layers  # torch's list lacks their type
        self.leave = nn.Linear(config.channels, 2 * config.channels)

    def forward(self, x: Tensor, bands: list[list[Band]]) -> Tensor:
        """Map (B, T, C), with the attention bands of each layer, to (B, T, 2 C)."""
        x = self.enter(x)
        for layer, band in zip(self.layers, bands, strict=True):
            x = layer(x, band)
        return self.leave(x)


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
        self.n_motion, self.n_condition, self.config = n_motion, n_condition, config
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
        self._check(condition)
        conditions, steps = self._conditions(condition), self._steps(step)
        return self._run(noisy, steps[:, :, None], conditions, self._bands(noisy.shape[1]))

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
        self._check(condition)
        steps = list(steps)
        conditions = self._conditions(condition).contiguous()
        embedded = self._steps(torch.tensor(steps, device=condition.device)).unbind(1)
        of_step = dict(zip(steps, embedded, strict=True))
        bands = self._bands(condition.shape[1])

        @torch.no_grad()
        def predict(noisy: Tensor, step: int) -> Tensor:
            return self._run(noisy, of_step[step][:, None, None], conditions, bands)

        return predict

    def _check(self, condition: Tensor) -> None:
        if condition.shape[-1] != self.n_condition:
            raise ModelError(
                f"condition: {condition.shape[-1]} numbers a frame, but the network was made for "
                f"{self.n_condition}; give the conditions that it was trained with"
            )

    def _conditions(self, condition: Tensor) -> Tensor:
        """Project a condition (B, T, C) to the input (blocks, B, T, channels) of each block."""
        if self.project_condition is None:
            return self.enter.weight.new_zeros(self.config.blocks, 1, 1, 1)
        projected = self.project_condition(condition.to(self.enter.weight.dtype))
        return projected.unflatten(-1, (self.config.blocks, -1)).movedim(-2, 0)

    def _steps(self, step: Tensor) -> Tensor:
        """Embed steps (B,) as the input (blocks, B, channels) of each block."""
        # In double precision: angles reach 1e6 radians, too large for float32.
        turn = 10 ** torch.linspace(0, 4, FREQUENCIES, dtype=torch.float64, device=step.device)
        angle = step.double()[:, None] * turn
        waves = torch.cat([angle.sin(), angle.cos()], 1).to(self.enter.weight.dtype)
        projected = self.project_step(self.embed_step(waves))
        return projected.unflatten(1, (self.config.blocks, -1)).movedim(1, 0)

    def _bands(self, n_frames: int) -> list[list[list[Band]]]:
        """Return the attention bands of each layer of each block; empty without attention."""
        return [
            [bands(layer.attention.bias, n_frames) for layer in stack.layers]
            for stack in self.stacks
            if isinstance(stack, ConformerStack)
        ]

    def _run(
        self, noisy: Tensor, steps: Tensor, conditions: Tensor, bands: list[list[list[Band]]]
    ) -> Tensor:
        x = self.enter(noisy.to(self.enter.weight.dtype)).relu_()
        total = 0
        for i, (stack, split) in enumerate(zip(self.stacks, self.split, strict=True)):
            y = x + (steps[i] + conditions[i])
            y = stack(y, bands[i]) if bands else stack(y)
            gate, signal = y.chunk(2, -1)
            kept, skipped = split(gate.sigmoid() * signal.tanh()).chunk(2, -1)
            x = (x + kept) * math.sqrt(0.5)
            total = total + skipped
        total = total * len(self.stacks) ** -0.5
        return self.leave(self.gather(total).relu_()).to(noisy.dtype)
