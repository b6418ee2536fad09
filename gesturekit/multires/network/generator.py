"""Generators of the pyramid (section 3 of Moreno-Villamarin et al. 2024, eqs. 6, 7 and 10)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.film import Film, modulated_blocks
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.network.skeleton_conv import (
    SLOPE,
    Convolve,
    convolve_dense,
    skeleton_layers,
)


class LevelGenerator(nn.Module):
    """Generator of one level: adds detail to the coarser motion, eqs. 6, 7 and 10.

    G_i(x, z, y) = g_i(FiLM(up(x) + z, y)) + up(x), with g_i a chain of skeleton convolutions.
    """

    def __init__(
        self, representation: MultiresRepresentation, n_condition: int, config: NetworkConfig
    ) -> None:
        super().__init__()
        self.layers = skeleton_layers(representation, config, output=True)
        if not n_condition:
            self.films = nn.ModuleList()
            return
        blocks = modulated_blocks(representation, config)
        self.embed = nn.Conv1d(n_condition, config.embedding, 1)
        self.rectify_embedding = config.rectify_embedding
        modulated = self.layers[:1] if config.film == "input" else self.layers
        self.films = nn.ModuleList(
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
            condition: (B, S, T) speech features and style of this level; None skips the FiLM.
            convolve: implementation of the convolutions.
        """
        y = None
        if condition is not None and self.films:
            y = self.embed(condition)
            if self.rectify_embedding:
                y = F.leaky_relu(y, SLOPE)
        x = up + noise
        modulated = 0 if y is None else len(self.films)
        if modulated <= 1:
            x = self.films[0](x, y) if modulated else x
            return convolve(self.layers, x, SLOPE, 1.0) + up
        for i, layer in enumerate(self.layers):
            if i:
                x = F.leaky_relu(x, SLOPE)
            if i < modulated:
                x = self.films[i](x, y)
            x = convolve([layer], x, 1.0, 1.0)
        return x + up


class MultiresGenerator(nn.Module):
    """Generators G_1 ... G_L, coarse to fine. Their motion is normalised."""

    def __init__(
        self, representation: MultiresRepresentation, n_condition: int, config: NetworkConfig
    ) -> None:
        super().__init__()
        self.levels = nn.ModuleList(
            LevelGenerator(representation, n_condition, config) for _ in range(config.levels)
        )

    def forward(
        self,
        noises: Sequence[Tensor | None],
        conditions: Sequence[Tensor] | None,
        *,
        first: int = 0,
        coarser: Tensor | None = None,
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
            lengths: frames of each of these levels.
            convolve: implementation of the convolutions.
        """
        made = []
        for i, (noise, n_frames) in enumerate(zip(noises, lengths, strict=True)):
            level = self.levels[first + i]
            if coarser is None:
                up = noise.new_zeros(len(noise), level.layers[0].shape[1], n_frames)
            else:
                up = resample(coarser.detach(), n_frames)
            if noise is None:
                noise = up.new_zeros(len(up), 1, n_frames)
            coarser = level(up, noise, None if conditions is None else conditions[i], convolve)
            made.append(coarser)
        return made
