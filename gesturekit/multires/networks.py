"""Networks of the pyramid in plain torch (Moreno-Villamarin et al. 2024, section 3).

`LevelGenerator` is G_i with FiLM (eqs. 6 to 10), `LevelDiscriminator` is D_i, and `TorchBackend`
defines the operations that the CPU engine computes faster.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.multires import losses
from gesturekit.multires.config import LossConfig, NetworkConfig
from gesturekit.multires.layers import (
    SLOPE,
    Convolve,
    SkeletonConv1d,
    convolve_dense,
    modulated_blocks,
    module_list,
    reflect,
    resample,
    skeleton_layers,
)
from gesturekit.multires.motion_vector import MultiresRepresentation


class Film(nn.Module):
    """Modulation of chosen channels, gamma * x + delta (eqs. 8 to 10).

    gamma = 1 + f(y) and delta = h(y), both per frame. f and h are initialised to zero, so that an
    untrained modulation is the identity. Other channels are not changed.

    Args:
        embedding: channels of y.
        channels: (C,) bool, True for modulated channels.
    """

    index: Tensor

    def __init__(self, embedding: int, channels: np.ndarray) -> None:
        super().__init__()
        index = torch.zeros(len(channels), dtype=torch.long)
        index[torch.from_numpy(channels)] = torch.arange(1, int(channels.sum()) + 1)
        # Channel 0 of the padded gain and shift is zero; every channel not modulated points at it.
        self.register_buffer("index", index, persistent=False)
        self.gain = nn.Conv1d(embedding, int(channels.sum()), 1)
        self.shift = nn.Conv1d(embedding, int(channels.sum()), 1)
        for parameter in (*self.gain.parameters(), *self.shift.parameters()):
            nn.init.zeros_(parameter)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """Return x (B, C, T) modulated by y (B, embedding, T)."""
        gamma = F.pad(self.gain(y), (0, 0, 1, 0)).index_select(1, self.index)
        delta = F.pad(self.shift(y), (0, 0, 1, 0)).index_select(1, self.index)
        return x + x * gamma + delta


class LevelGenerator(nn.Module):
    """Generator of one level: adds detail to the coarser motion, eqs. 6, 7 and 10.

    G_i(x, z, s) = g_i(FiLM(up(x) + z, y)) + up(x), with y = S_i(s) the embedding of the condition
    and g_i a chain of skeleton convolutions. With `film: all` each of them is modulated; with
    `film: concatenate` none is, and y is a part of the input: g_i(up(x) + z, y) + up(x).
    """

    def __init__(
        self, representation: MultiresRepresentation, n_condition: int, config: NetworkConfig
    ) -> None:
        super().__init__()
        self.concatenates = bool(n_condition) and config.film == "concatenate"
        n_concatenated = config.embedding if self.concatenates else 0
        self.layers = skeleton_layers(
            representation, config, output=True, n_concatenated=n_concatenated
        )
        self.rectify_embedding, self.residual = config.rectify_embedding, config.residual
        self.embed, self.films = None, module_list(list[Film]())
        if n_condition:
            self.embed = nn.Conv1d(n_condition, config.embedding, 1)
            blocks = modulated_blocks(representation, config)
            modulated = self.layers[: {"input": 1, "concatenate": 0}.get(config.film)]
            self.films = module_list(
                Film(config.embedding, np.repeat(blocks, layer.sizes[0])) for layer in modulated
            )

    def forward(
        self,
        up: Tensor,
        noise: Tensor,
        condition: Tensor | None,
        convolve: Convolve = convolve_dense,
    ) -> Tensor:
        """Return the motion of this level, (B, D, T).

        Args:
            up: (B, D, T) the coarser level's motion, upsampled; zeros at the first level.
            noise: (B, 1, T), shared by all channels.
            condition: (B, S, T) speech features and style of this level; not used by a level
                without conditions.
            convolve: implementation of the convolutions.
        """
        x, y = up + noise, None
        if self.embed is not None and condition is not None:
            y = self.embed(condition)
            y = F.leaky_relu(y, SLOPE) if self.rectify_embedding else y
            x = torch.cat([x, y], dim=1) if self.concatenates else x
        # Layers between one modulation and the next.
        chains = [[layer] for layer in self.layers] if len(self.films) > 1 else [self.layers]
        for i, chain in enumerate(chains):
            x = x if y is None or self.concatenates else self.films[i](x, y)
            x = convolve(chain, x, SLOPE, 1.0 if i == len(chains) - 1 else SLOPE)
        return x + up if self.residual else x


class MultiresGenerator(nn.Module):
    """Generators G_1 ... G_L, coarse to fine. Their motion is normalised."""

    def __init__(
        self, representation: MultiresRepresentation, n_condition: int, config: NetworkConfig
    ) -> None:
        super().__init__()
        self.levels = module_list(
            LevelGenerator(representation, n_condition, config) for _ in range(config.levels)
        )

    def forward(
        self,
        noises: Sequence[Tensor | None],
        conditions: Sequence[Tensor] | None,
        *,
        first: int = 0,
        coarser: Tensor | None = None,
        recorded: Sequence[Tensor] = (),
        lengths: Sequence[int],
        convolve: Convolve = convolve_dense,
    ) -> list[Tensor]:
        """Return the motion of levels `first` to `first + len(noises) - 1`, (B, D, T_i) each.

        Gradients do not flow from a level into the coarser one.

        Args:
            noises: (B, 1, T_i) for each level; None stands for zeros.
            conditions: (B, S, T_i) for each of these levels, or None.
            first: index of the first of these levels.
            coarser: (B, D, T) motion of level `first - 1`; None if `first` is 0.
            recorded: (B, D, T_i) motion of each of these levels that the next one upsamples in
                place of the generated one (eq. 15 as printed); empty for the generated ones.
            lengths: frames of each of these levels.
            convolve: implementation of the convolutions.
        """
        made: list[Tensor] = []
        for i, (noise, n_frames) in enumerate(zip(noises, lengths, strict=True)):
            level = self.levels[first + i]
            if coarser is None:
                assert noise is not None
                up = noise.new_zeros(len(noise), level.layers[-1].shape[0], n_frames)
            else:
                up = resample(coarser.detach(), n_frames)
            if noise is None:
                noise = up.new_zeros(len(up), 1, n_frames)
            made.append(level(up, noise, conditions[i] if conditions else None, convolve))
            coarser = recorded[i] if recorded else made[-1]
        return made


class LevelDiscriminator(nn.Module):
    """Patch discriminator D_i of one level; it has no speech input.

    With styles, each style adds a learnt projection of the last features to the score (projection
    discriminator, Miyato and Koyama 2018).
    """

    def __init__(
        self, representation: MultiresRepresentation, config: NetworkConfig, n_styles: int = 0
    ) -> None:
        super().__init__()
        self.layers = skeleton_layers(representation, config, output=False, n_concatenated=0)
        width = self.layers[-1].shape[0]
        self.score = nn.Conv1d(width, 1, config.kernel)
        if n_styles:
            self.styled = nn.Conv1d(width, n_styles, config.kernel, bias=False)

    def score_weights(self, n_frames: int, style: Tensor | None = None) -> Tensor:
        """Return the weight of each feature in the mean score, (1 or B, C, T).

        The mean over time of the last, reflect-padded convolution is linear in its input, so that
        it is a weighted sum and no convolution.

        Args:
            n_frames: T.
            style: (B, K) one-hot, or None.
        """
        kernels = self.score.weight
        if style is not None:
            kernels = kernels + torch.einsum("bk,kct->bct", style, self.styled.weight)
        return kernels @ tap_frequencies(n_frames, kernels.shape[-1]).to(kernels)

    def forward(
        self, x: Tensor, style: Tensor | None = None, convolve: Convolve = convolve_dense
    ) -> Tensor:
        """Return the mean score of all patches of each motion, (B,). There is one patch around each
        frame.

        Args:
            x: (B, D, T).
            style: (B, K) one-hot; zeros for a motion without a style.
            convolve: implementation of the convolutions.
        """
        assert self.score.bias is not None
        x = convolve(self.layers, x, SLOPE, SLOPE)
        # Scores are means over time with small differences: too fine for half precision.
        with torch.autocast(x.device.type, enabled=False):
            x = x.to(self.score.weight.dtype)
            return (x * self.score_weights(x.shape[-1], style)).sum(dim=(1, 2)) + self.score.bias


@lru_cache(maxsize=64)
def tap_frequencies(n_frames: int, kernel: int) -> Tensor:
    """Return how often each frame is multiplied by each kernel tap, divided by T: (kernel, T).

    It is the average over time of a reflect-padded convolution, without its weights.
    """
    windows = reflect(torch.eye(n_frames), kernel // 2).unfold(-1, kernel, 1)
    return windows.sum(dim=1).T.contiguous() / n_frames


T = TypeVar("T")


class TorchBackend:
    """Dense convolutions and autograd: the definition of what every backend computes.

    Args:
        reason: why this backend was chosen, for the log.
    """

    name = "torch"

    def __init__(self, reason: str) -> None:
        self.reason = reason

    def convolve(
        self, layers: Sequence[SkeletonConv1d], x: Tensor, slope: float, last_slope: float
    ) -> Tensor:
        """Return the output of a chain of convolutions; see `convolve_dense`."""
        return convolve_dense(layers, x, slope, last_slope)

    def discriminator_gradients(
        self,
        discriminators: Sequence[LevelDiscriminator],
        reals: Sequence[Tensor],
        fakes: Sequence[Tensor],
        mixes: Sequence[Tensor],
        config: LossConfig,
        styles: Sequence[Tensor | None],
    ) -> Tensor:
        """Set the parameters' `grad` to the gradients of the discriminator loss (eqs. 12 and 13).

        Args:
            discriminators: one per level; all following arguments have one entry per discriminator.
            reals: (B, D, T_i).
            fakes: (B, D, T_i).
            mixes: (B, 1, 1) uniform in [0, 1], interpolation weights of the gradient penalty.
            config: weights of the losses.
            styles: (B, K) one-hot, of each recording and of the fake with the same index; None for
                a discriminator without styles.

        Returns:
            (levels,) values of eq. 12, without weights.
        """
        return torch.stack(
            [
                self._level_gradients(*level, config)
                for level in zip(discriminators, reals, fakes, mixes, styles, strict=True)
            ]
        )

    def _level_gradients(
        self,
        discriminator: LevelDiscriminator,
        real: Tensor,
        fake: Tensor,
        mix: Tensor,
        style: Tensor | None,
        config: LossConfig,
    ) -> Tensor:
        def score(motions: Tensor) -> Tensor:
            repeats = len(motions) // len(real)
            repeated = None if style is None else torch.cat([style] * repeats)
            return discriminator(motions, repeated, self.convolve)

        gap = losses.discriminator_gap(*score(torch.cat([fake, real])).split(len(real)))
        penalty = losses.gradient_penalty(score, real, fake, mix, config.penalty_on)
        loss = config.discriminator_scale * gap + config.gradient_penalty * penalty
        parameters = list(discriminator.parameters())
        for parameter, gradient in zip(
            parameters, torch.autograd.grad(loss, parameters), strict=True
        ):
            parameter.grad = gradient
        return gap.detach()

    def run_tasks(self, *tasks: Callable[[], T]) -> list[T]:
        """Run independent tasks and return their results."""
        return [task() for task in tasks]

    def threads(self) -> AbstractContextManager[None]:
        """Return a context that shares the CPU threads between torch and this backend."""
        return nullcontext()
