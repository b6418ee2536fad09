"""Trained multires model: one value, which goes whole to the sampler, and its noise.

Noise is Gaussian, or shuffled patches of the training recordings' z*. A recording is reconstructed
from its z* alone. Fresh noise need not cover all that the network can reconstruct, and short
patches of z* do: each stands for a piece of a recording, in a new context.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gesturekit.model import Inputs
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.recall.library import RecallLibrary
from gesturekit.multires.sampling.conditions import Conditions
from gesturekit.training.trained_model import BaseModel


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
        parts: list[Tensor] = []
        done = 0
        while done < len(styles):
            style = styles[done]
            if style not in rounds:
                rounds[style] = self._rounds(self.by_style.get(style, self.all), rng)
            parts.append(next(rounds[style]))
            done += parts[-1].shape[-1]
        return torch.cat(parts, dim=-1)[None, :, : len(styles)]

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
        self, gaussian: Tensor, styles: Sequence[Sequence[int]], rng: torch.Generator
    ) -> Tensor:
        """Return the noise (B, 1 or D, T_1) of the first level: z* patches if there are any.

        Args:
            gaussian: (B, 1, T_1), returned as it is where noise is not made of patches.
            styles: (B, T_1) number of the style of each frame.
            rng: random generator of the patches.
        """
        if self.patches is None:
            return gaussian
        return torch.cat([self.patches.draw(row, rng) for row in styles])


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


@dataclass(eq=False, repr=False, kw_only=True)
class TrainedModel(BaseModel):
    """A trained model, as its folder stores it; `MultiresModel` adds generation.

    Attributes:
        normaliser: mean and scale of motion vectors.
        network_config: architecture of the pyramid.
        network: the generators.
        noise: the model's noise.
        library: recordings that are recalled; None for a model without recall.
        fastest: ground speed in the fastest second of the training motion, m/s.
    """

    kind: ClassVar[str] = "multires"

    representation: MultiresRepresentation
    normaliser: Normaliser
    conditions: Conditions
    network_config: NetworkConfig
    network: MultiresGenerator
    noise: TrainedNoise
    library: RecallLibrary | None
    fastest: float

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        speech = self.conditions.conditioner
        return Inputs(speech=speech is not None, words=speech is not None and speech.takes_words)
