"""Sampling of one motion: noise or a coarse level in, motion vectors out.

Inference is tiled, so that memory is bounded and there are no seams. A frame of a level depends on
the frames within reach of the convolutions only. So each level is generated tile by tile, each with
that many more frames at both sides (its halo), which are cut off. A short motion is one tile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gesturekit.errors import ModelError
from gesturekit.multires.backend import choose_backend
from gesturekit.multires.constraints.constraint import Constraint
from gesturekit.multires.network.generator import LevelGenerator, MultiresGenerator
from gesturekit.multires.network.resampling import resample, resample_part
from gesturekit.multires.sampling.conditions import LevelConditions
from gesturekit.multires.sampling.trained_model import RandomNoise, TrainedModel

TILE = 2048
"""Frames of a tile, which need about 50 MB; the halo of 16 frames is a small part of it."""

Condition = Callable[[int, int, int], Tensor]
"""condition(level, start, stop): (B, S, stop - start), the condition of these frames of a level."""


@dataclass(frozen=True, eq=False)
class Pyramid:
    """The levels of a trained network, for one motion.

    Attributes:
        model: the trained model.
        lengths: T_i, frames of each level.
        condition: conditions of each level; None for a model without any.
        noise: of random motions; None if noise is only given.
        rng_of: random generator of a level, by its index; a new one at each call.
        recalled: (1, D, T_i) normalised motion that replaces a level in random motions; None to
            generate all levels.
        recalled_level: index of that level.
    """

    model: TrainedModel
    lengths: Sequence[int]
    condition: LevelConditions | None
    noise: RandomNoise | None = None
    rng_of: Callable[[int], torch.Generator] | None = None
    recalled: Tensor | None = None
    recalled_level: int = 0

    def random(
        self, *, levels: int | None = None, constraint: Constraint | None = None
    ) -> np.ndarray:
        """Return the output (T_i, D) of the first `levels` levels, all by default.

        The first level gets noise, or a coarse level is recalled.

        Raises:
            ModelError: the output is not finite.
        """
        lengths, level, recalled = self.lengths[:levels], self.recalled_level, self.recalled
        if recalled is None:
            noises = self.noise.gaussian(lengths, self.rng_of)
            noises[0] = self.noise.shuffled(noises[0], [self._coarsest_styles()], self.rng_of(0))
            return self._sampled(noises, lengths, constraint)
        if len(lengths) <= level:
            return self.model.normaliser.to_values(resample(recalled, lengths[-1]))
        coarser = recalled if constraint is None else constraint(level, recalled)
        return self._above(level, coarser, lengths, constraint)

    def from_noise(self, noise: Tensor) -> np.ndarray:
        """Return the output (T, D) of all levels from noise (1, 1 or D, T_1) at the first only."""
        return self._sampled([noise, *[None] * (len(self.lengths) - 1)], self.lengths)

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
        coarser = self.model.normaliser.from_values(values)
        return self._above(level, coarser, self.lengths, constraint)

    def _above(
        self, level: int, coarser: Tensor, lengths: Sequence[int], constraint: Constraint | None
    ) -> np.ndarray:
        """Return the output (T, D) of the last of the levels with these lengths, given `level`."""
        first, lengths = level + 1, lengths[level + 1 :]
        noises = self.noise.gaussian(lengths, self.rng_of, first=first)
        return self._sampled(noises, lengths, constraint, first=first, coarser=coarser)

    def _coarsest_styles(self) -> list[int]:
        """Return the number of the style in each frame of the coarsest level, (T_1,)."""
        if self.condition is None or not self.condition.styles:
            return [0] * self.lengths[0]
        return self.condition.styles[0][0].argmax(dim=0).tolist()

    def _sampled(
        self,
        noises: Sequence[Tensor | None],
        lengths: Sequence[int],
        constraint: Constraint | None = None,
        *,
        first: int = 0,
        coarser: Tensor | None = None,
    ) -> np.ndarray:
        """Return the finest of these levels, (T, D) in their own units; see `sample`."""
        vectors = sample(
            self.model.network,
            noises,
            lengths,
            self.condition,
            first=first,
            coarser=coarser,
            constraint=constraint,
        )
        values = self.model.normaliser.to_values(vectors)
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
        coarser = noises[0].new_zeros(
            len(noises[0]), network.levels[0].layers[0].shape[1], lengths[0]
        )
    levels = network.levels[first : first + len(lengths)]
    backend = choose_backend("auto", levels)
    with backend.threads():
        for i, (level, noise, n_frames) in enumerate(
            zip(levels, noises, lengths, strict=True), first
        ):
            output = coarser.new_empty(*coarser.shape[:2], n_frames)
            reach = halo(level)
            for start, stop in tiles(n_frames, tile):
                begin, end = max(0, start - reach), min(n_frames, stop + reach)
                up = resample_part(coarser, n_frames, begin, end)
                tile_noise = up.new_zeros(len(up), 1, 1) if noise is None else noise[..., begin:end]
                given = None if condition is None else condition(i, begin, end)
                part = level(up, tile_noise, given, backend.convolve)
                output[..., start:stop] = part[..., start - begin : stop - begin]
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
