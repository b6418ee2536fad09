"""Generators and discriminators of the pyramid (section 3 of Moreno-Villamarin et al. 2024)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.motion.parts import unidentified, upper_body
from gesturekit.multires import losses
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.resampling import reflect, resample
from gesturekit.multires.network.skeleton_conv import SkeletonConv1d, block_neighbours, chained

SLOPE = 0.2
"""Of the leaky rectifiers, as in GANimator."""


class Film(nn.Module):
    """Feature-wise linear modulation of chosen channels (eqs. 8 to 10).

    gamma = 1 + f(y) and delta = h(y), both per frame; f and h start at zero, so that the
    modulation starts as the identity. Other channels pass untouched.

    Args:
        embedding: width of y.
        channels: (C,) bool, which channels are modulated.
    """

    where: Tensor

    def __init__(self, embedding: int, channels: np.ndarray) -> None:
        super().__init__()
        index = torch.zeros(len(channels), dtype=torch.long)
        index[torch.from_numpy(channels)] = torch.arange(1, int(channels.sum()) + 1)
        # Column 0 of the padded gain and shift is "no change"; all other channels point at it.
        self.register_buffer("where", index, persistent=False)
        self.gain = nn.Conv1d(embedding, int(channels.sum()), 1)
        self.shift = nn.Conv1d(embedding, int(channels.sum()), 1)
        for layer in (self.gain, self.shift):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """x (B, C, T) modulated by y (B, embedding, T)."""
        gamma = F.pad(self.gain(y), (0, 0, 1, 0)).index_select(1, self.where)
        delta = F.pad(self.shift(y), (0, 0, 1, 0)).index_select(1, self.where)
        return x + x * gamma + delta


class LevelGenerator(nn.Module):
    """G_i: adds what a coarser motion lacks, G_i = g_i(FiLM(up + z)) + up (eqs. 6, 7, 10)."""

    def __init__(
        self, representation: MultiresRepresentation, n_condition: int, config: NetworkConfig
    ) -> None:
        super().__init__()
        near = block_neighbours(representation, config.neighbour_distance)
        sizes = [
            representation.block_sizes,
            *((width,) * len(near) for width in config.channels),
            representation.block_sizes,
        ]
        self.layers = nn.ModuleList(
            SkeletonConv1d(near, sizes[i], sizes[i + 1], config.kernel)
            for i in range(len(sizes) - 1)
        )
        # Without any condition there is nothing to embed and nothing to modulate by.
        if not n_condition:
            self.films = nn.ModuleList()
            return
        blocks = modulated_blocks(representation, config)
        self.embed = nn.Conv1d(n_condition, config.embedding, 1)
        self.rectify_embedding = config.rectify_embedding
        modulated = sizes[:1] if config.film == "input" else sizes[:-1]
        self.films = nn.ModuleList(
            Film(config.embedding, np.repeat(blocks, size)) for size in modulated
        )

    def forward(
        self, up: Tensor, noise: Tensor, condition: Tensor | None, compiled: bool = True
    ) -> Tensor:
        """One level of motion.

        Args:
            up: (B, D, T) the coarser level's motion, upsampled; zeros at the first level.
            noise: (B, 1, T), shared by all channels.
            condition: (B, S, T) speech features and style of this level; None leaves out the
                modulation.
            compiled: see `chained`.

        Returns:
            (B, D, T).
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
            return chained(self.layers, x, SLOPE, compiled=compiled) + up
        for i, layer in enumerate(self.layers):
            if i:
                x = F.leaky_relu(x, SLOPE)
            if i < modulated:
                # After the convolution and before its rectifier would do as well; here the
                # modulated signal is what the next convolution reads.
                x = self.films[i](x, y)
            x = layer(x, compiled)
        return x + up


class LevelDiscriminator(nn.Module):
    """D_i: a score for each patch of a motion; it does not hear the speech, but may be told styles.

    A style adds a score of its own on the last features (projection, Miyato and Koyama 2018).
    """

    def __init__(
        self, representation: MultiresRepresentation, config: NetworkConfig, n_styles: int = 0
    ) -> None:
        super().__init__()
        near = block_neighbours(representation, config.neighbour_distance)
        sizes = [representation.block_sizes, *((w,) * len(near) for w in config.channels)]
        self.layers = nn.ModuleList(
            SkeletonConv1d(near, sizes[i], sizes[i + 1], config.kernel)
            for i in range(len(sizes) - 1)
        )
        self.score = nn.Conv1d(sum(sizes[-1]), 1, config.kernel)
        if n_styles:
            self.styled = nn.Conv1d(sum(sizes[-1]), n_styles, config.kernel, bias=False)

    def slopes(self, n_frames: int, told: Tensor | None = None) -> Tensor:
        """(1 or B, C, T) what each frame of the last features adds to the score of a motion.

        The mean over time of a mirrored convolution is a weighted sum of what goes into it.
        """
        heads = self.score.weight
        if told is not None:
            heads = heads + torch.einsum("bk,kct->bct", told, self.styled.weight)
        return heads @ taken(n_frames, heads.shape[-1]).to(heads)

    def forward(self, x: Tensor, told: Tensor | None = None) -> Tensor:
        """The mean score of all patches of a motion, one around each frame.

        Args:
            x: (B, D, T).
            told: (B, K) one-hot styles; a row of zeros tells nothing.

        Returns:
            (B,).
        """
        x = chained(self.layers, x, SLOPE, SLOPE)
        # Not in half precision: scores are small differences, and their means run over time.
        with torch.autocast(x.device.type, enabled=False):
            x = x.to(self.score.weight.dtype)
            return (x * self.slopes(x.shape[-1], told)).sum(dim=(1, 2)) + self.score.bias


@lru_cache(maxsize=64)
def taken(n_frames: int, kernel: int) -> Tensor:
    """(taps, T): how often the mean over time of a mirrored convolution takes a frame by a tap."""
    windows = reflect(torch.eye(n_frames), kernel // 2).unfold(-1, kernel, 1)
    return windows.sum(dim=1).T.contiguous() / n_frames


class MultiresGenerator(nn.Module):
    """G_1 ... G_L, coarse to fine. All motion inside is normalised."""

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
    ) -> list[Tensor]:
        """Levels `first` to `first + len(noises) - 1` of a motion.

        Args:
            noises: (B, 1, T_i) for each level; None stands for no noise at all.
            conditions: (B, S, T_i) for each of these levels, or None.
            first: index of the first level wanted.
            coarser: (B, D, T) the level before `first`; None at the first level of all.
            lengths: frames of each of these levels.

        Returns:
            a (B, D, T_i) for each level. Gradients do not run from a level into the one before.
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
            coarser = level(up, noise, None if conditions is None else conditions[i])
            made.append(coarser)
        return made


def modulated_blocks(representation: MultiresRepresentation, config: NetworkConfig) -> np.ndarray:
    """(B,) bool: the blocks that the condition modulates.

    Speech never modulates a contact nor the root's displacement; `modulate: all` means them too,
    and so does `upper` on a rig whose upper body cannot be identified: a style modulates all of it.
    """
    nameless = config.modulate == "upper" and unidentified(representation.skeleton)
    if config.modulate == "all" or nameless:
        return np.ones(len(representation.block_sizes), dtype=bool)
    if config.modulate == "upper":
        names = set(upper_body(representation.skeleton))
    else:
        skeleton = representation.skeleton
        names = {skeleton.names[skeleton.index(name)] for name in config.modulate}
    joints = [name in names for name in representation.joints]
    return np.array(joints + [False] * (len(representation.block_sizes) - len(joints)))


def gradient_penalty(
    discriminator: nn.Module,
    real: Tensor,
    fake: Tensor,
    mix: Tensor,
    penalty_on: str = "window",
    told: Tensor | None = None,
) -> Tensor:
    """Mean of (||grad D|| - 1)^2 between real and fake motions (eq. 13, Gulrajani et al. 2017).

    Args:
        discriminator: gives a score of each motion, the mean of its patches'.
        real: (B, D, T).
        fake: (B, D, T).
        mix: (B, 1, 1), uniform in [0, 1].
        penalty_on: whose norm is penalised, see `LossConfig.penalty_on`.
        told: (B, K) styles of both, for a discriminator that is told.
    """
    between = (mix * fake + (1 - mix) * real).requires_grad_(True)
    score = discriminator(between, told).sum()
    (gradient,) = torch.autograd.grad(score, between, create_graph=True)
    return losses.gradient_penalty(gradient, penalty_on)
