"""Noise of a trained multires model, and the levels of its pyramid, sampled in tiles.

Noise is Gaussian, or shuffled patches of the training recordings' z*. A recording is reconstructed
from its z* alone. Fresh noise need not cover all that the network can reconstruct, and short
patches of z* do: each stands for a piece of a recording, in a new context.

Sampling is tiled, so that memory is bounded and there are no seams. A frame of a level depends on
the frames within reach of the convolutions only. So each level is generated tile by tile, each with
that many more frames at both sides (its halo), which are cut off. A short motion is one tile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gesturekit.errors import ModelError
from gesturekit.multires.backend import choose_backend
from gesturekit.multires.conditions import LevelConditions
from gesturekit.multires.networks import LevelGenerator, MultiresGenerator
from gesturekit.multires.resampling import resample
from gesturekit.state.channels import CARRIERS

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel


class ZStarPatches:
    """Patches of z*, each drawn once in random order before any is drawn again.

    Args:
        z_stars: z* of each recording, (T_1,), or (D, T_1) with a value for each channel.
        styles: number of the style of each recording. Other styles get patches of all recordings.
        longest: frames of a patch at most. The cuts are random and differ in every round.
    """

    def __init__(self, z_stars: Sequence[Tensor], styles: Sequence[int], longest: int) -> None:
        self.by_style: dict[int, list[Tensor]] = {}
        for z_star, style in zip(z_stars, styles, strict=True):
            self.by_style.setdefault(style, []).append(z_star.reshape(-1, z_star.shape[-1]))
        self.all = [z_star.reshape(-1, z_star.shape[-1]) for z_star in z_stars]
        self.longest = longest

    def draw(self, styles: Sequence[int], rng: torch.Generator) -> Tensor:
        """Return (1, 1 or D, T_1) noise; each patch has the style of its first frame.

        Args:
            styles: (T_1,) number of the style of each frame.
            rng: source of the cuts and of the order.
        """
        rounds: dict[int, Iterator[Tensor]] = {}
        pieces: list[Tensor] = []
        done = 0
        while done < len(styles):
            style = styles[done]
            if style not in rounds:
                rounds[style] = self._rounds(self.by_style.get(style, self.all), rng)
            pieces.append(next(rounds[style]))
            done += pieces[-1].shape[-1]
        return torch.cat(pieces, dim=-1)[None, :, : len(styles)]

    def _rounds(self, z_stars: Sequence[Tensor], rng: torch.Generator) -> Iterator[Tensor]:
        """Yield patches (1 or D, T) without end; each round cuts all of (1 or D, T_1) anew."""
        while True:
            patches = []
            for z_star in z_stars:
                first = 1 + int(torch.randint(self.longest, (), generator=rng))
                edges = [0, *range(first, z_star.shape[-1], self.longest), z_star.shape[-1]]
                patches += [z_star[:, a:b] for a, b in zip(edges, edges[1:], strict=False)]
            for i in torch.randperm(len(patches), generator=rng).tolist():
                yield patches[i]


@dataclass(frozen=True, eq=False)
class RandomNoise:
    """Noise of random motions, in training and in generation.

    Attributes:
        sigma: (L,) standard deviation of the noise of each level.
        levels: number of the coarsest levels that get noise.
        patches: z* patches for the first level, or None for Gaussian noise there too.
    """

    sigma: Tensor
    levels: int
    patches: ZStarPatches | None

    def gaussian(
        self,
        lengths: Sequence[int],
        rng_of: Callable[[int], torch.Generator],
        *,
        first: int = 0,
        count: int = 1,
    ) -> list[Tensor | None]:
        """Draw Gaussian noise (B, 1, T_i) for each level, or None for levels without noise.

        Args:
            lengths: T_i, frames of each of these levels.
            rng_of: random generator of a level, by its index.
            first: index of the first of these levels.
            count: B.
        """
        return [
            torch.randn(count, 1, n, generator=rng_of(i)) * self.sigma[i]
            if i < self.levels
            else None
            for i, n in enumerate(lengths, first)
        ]

    def shuffled(
        self, gaussian: Tensor | None, styles: Sequence[Sequence[int]], rng: torch.Generator
    ) -> Tensor:
        """Return the noise (B, 1 or D, T_1) of the first level: z* patches if there are any.

        Args:
            gaussian: (B, 1, T_1), returned as it is where noise is not made of patches.
            styles: (B, T_1) number of the style of each frame.
            rng: random generator of the patches.
        """
        if self.patches is None:
            assert gaussian is not None
            return gaussian
        return torch.cat([self.patches.draw(row, rng) for row in styles])

    def clocked(
        self, state: np.ndarray, n_carriers: int, lengths: Sequence[int]
    ) -> list[Tensor | None]:
        """Return noise in the time of the hands' movement for states (B, C, T).

        That of level 1 is the mean of the hands' first carriers, the last `n_carriers` channels;
        white noise would move the body where the state says that it rests. Finer levels get none.
        """
        mixed = mixed_carriers(torch.from_numpy(state[:, state.shape[1] - n_carriers :]))
        first = self.sigma[0] * resample(mixed, lengths[0])
        return [first, *[None] * (len(lengths) - 1)]


def mixed_carriers(carriers: Tensor) -> Tensor:
    """Return the mean (B, 1, T) of the hands' first carriers, (B, 4 H, T), of variance 1."""
    first = carriers[:, ::CARRIERS]
    return first.sum(dim=1, keepdim=True) / first.shape[1] ** 0.5


@dataclass(frozen=True)
class TrainedSequence:
    """Data of a training sequence that its reconstruction needs.

    Attributes:
        frames: its length at the full rate.
        style: its style, or None.
    """

    frames: int
    style: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedNoise:
    """Noise of a trained model: scales, z*, and settings for drawing random noise.

    Attributes:
        sigma: (N, L) noise scale of each training sequence and level.
        z_star: noise from which each training sequence is reconstructed, by the sequence's name.
        sequences: length and style of each training sequence, by its name.
        z_star_shuffle: longest patch, in frames, when noise is made of z* patches; 0 for Gaussian
            noise.
        noise_levels: number of the coarsest levels that get noise.
    """

    sigma: Tensor
    z_star: Mapping[str, Tensor]
    sequences: Mapping[str, TrainedSequence]
    z_star_shuffle: int
    noise_levels: int

    def random(self, styles: tuple[str, ...]) -> RandomNoise:
        """Return the noise of random motions of a model with these styles."""
        patches = None
        if self.z_star_shuffle:
            names = sorted(self.z_star)
            owners = [styles.index(self.sequences[name].style) if styles else 0 for name in names]
            z_stars = [self.z_star[name] for name in names]
            patches = ZStarPatches(z_stars, owners, self.z_star_shuffle)
        return RandomNoise(self.sigma.mean(dim=0), self.noise_levels, patches)


TILE = 2048
"""Frames of a tile, which need about 50 MB; the halo of 16 frames is a small part of it."""

Constraint = Callable[[int, Tensor], Tensor]
"""constraint(level, output): the normalised output of a level, (1, D, T_i), with the constraint
applied before the next level adds detail: inpainting in a coarse-to-fine pyramid."""
Condition = Callable[[int, int, int], Tensor]
"""condition(level, start, stop): (B, S, stop - start), the condition of these frames of a level."""


@dataclass(frozen=True, eq=False)
class Pyramid:
    """The levels of a trained network, for one motion from random noise.

    Attributes:
        model: the trained model.
        lengths: T_i, frames of each level.
        condition: conditions of each level; None for a model without any.
        noise: of random motions.
        rng_of: random generator of a level, by its index; a new one at each call.
        state: (C, T) of a model with a state of movement, of which its noise is made; None to
            draw noise.
    """

    model: MultiresModel
    lengths: Sequence[int]
    condition: LevelConditions | None
    noise: RandomNoise
    rng_of: Callable[[int], torch.Generator]
    state: np.ndarray | None

    def random(
        self, *, levels: int | None = None, constraint: Constraint | None = None
    ) -> np.ndarray:
        """Return the output (T_i, D) of the first `levels` levels, all by default.

        Raises:
            ModelError: the output is not finite.
        """
        lengths = self.lengths[:levels]
        if self.state is not None:
            n_carriers = self.model.conditions.n_carriers
            noises = self.noise.clocked(self.state[None], n_carriers, lengths)
        else:
            noises = self.noise.gaussian(lengths, self.rng_of)
            styles = [0] * lengths[0]
            if self.condition is not None and self.condition.styles:
                styles = self.condition.styles[0][0].argmax(dim=0).tolist()
            noises[0] = self.noise.shuffled(noises[0], [styles], self.rng_of(0))
        return generated(self.model, noises, lengths, self.condition, constraint=constraint)

    def above(
        self, level: int, values: np.ndarray, constraint: Constraint | None = None
    ) -> np.ndarray:
        """Return the output (T, D) of the finer levels, given that of a level.

        Args:
            level: index of the level that is given.
            values: (T_i, D) in their own units; returned if the level is the finest.
            constraint: applied to the output of each finer level.

        Raises:
            ModelError: the output is not finite.
        """
        first, lengths = level + 1, self.lengths[level + 1 :]
        noises: list[Tensor | None] = [None] * len(lengths)
        if self.state is None:
            noises = self.noise.gaussian(lengths, self.rng_of, first=first)
        coarser = self.model.normaliser.from_values(values)
        return generated(
            self.model,
            noises,
            lengths,
            self.condition,
            first=first,
            coarser=coarser,
            constraint=constraint,
        )


def generated(
    model: MultiresModel,
    noises: Sequence[Tensor | None],
    lengths: Sequence[int],
    condition: LevelConditions | None,
    *,
    first: int = 0,
    coarser: Tensor | None = None,
    constraint: Constraint | None = None,
) -> np.ndarray:
    """Return the finest of these levels of a model, (T, D) in their own units; see `sample`.

    Raises:
        ModelError: the output is not finite.
    """
    vectors = sample(
        model.network,
        noises,
        lengths,
        condition,
        first=first,
        coarser=coarser,
        constraint=constraint,
    )
    return finite(model.normaliser.to_values(vectors))


def finite(values: np.ndarray) -> np.ndarray:
    """Return the output of a network; raise ModelError if it is not finite."""
    if not np.isfinite(values).all():
        raise ModelError("the model gave NaN; its weights are damaged or its training diverged")
    return values


@torch.no_grad()
def sample(
    network: MultiresGenerator,
    noises: Sequence[Tensor | None],
    lengths: Sequence[int],
    condition: Condition | None,
    *,
    first: int = 0,
    coarser: Tensor | None = None,
    constraint: Constraint | None = None,
    tile: int = TILE,
) -> Tensor:
    """Return the finest level of `network(noises, conditions, ...)`, in bounded memory.

    Args:
        network: the pyramid, in evaluation mode.
        noises: (B, 1, T_i) for each level; None means no noise, which the coarsest level needs.
        lengths: T_i, frames of each of these levels.
        condition: called for each tile of each level; None for a model without conditions.
        first: index of the first of these levels.
        coarser: (B, D, T) output of the level before `first`; None at the coarsest level. It is
            returned if there are no finer levels.
        constraint: applied to the output of each level before the next one.
        tile: frames generated at a time.

    Returns:
        (B, D, T); `tile` changes it by the rounding of sums only.
    """
    if coarser is None:
        assert noises[0] is not None
        n_columns = network.levels[0].layers[-1].shape[0]
        coarser = noises[0].new_zeros(len(noises[0]), n_columns, lengths[0])
    levels = network.levels[first : first + len(lengths)]
    backend = choose_backend("auto", *levels)
    with backend.threads():
        for i, (level, noise, n_frames) in enumerate(
            zip(levels, noises, lengths, strict=True), first
        ):
            output = coarser.new_empty(*coarser.shape[:2], n_frames)
            reach = halo(level)
            for start, stop in tiles(n_frames, tile):
                begin, end = max(0, start - reach), min(n_frames, stop + reach)
                up = resample(coarser, n_frames, begin, end)
                tile_noise = up.new_zeros(len(up), 1, 1) if noise is None else noise[..., begin:end]
                given = None if condition is None else condition(i, begin, end)
                made = level(up, tile_noise, given, backend.convolve)
                output[..., start:stop] = made[..., start - begin : stop - begin]
            coarser = output if constraint is None else constraint(i, output)
    return coarser


def halo(level: LevelGenerator) -> int:
    """Return the number of frames that a level sees to each side, at its own rate."""
    return sum(layer.padding for layer in level.layers)


def tiles(n_frames: int, tile: int) -> Iterator[tuple[int, int]]:
    """Return start and stop of each tile of `n_frames`; lengths differ by one frame at most."""
    count = -(-n_frames // tile)
    edges = [n_frames * i // count for i in range(count + 1)]
    return zip(edges[:-1], edges[1:], strict=True)
