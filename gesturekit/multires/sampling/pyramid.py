"""Sampling of one motion: noise or a coarse level in, motion vectors out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from gesturekit.errors import ModelError
from gesturekit.multires.constraints.constraint import Constraint
from gesturekit.multires.motion_vector import Normaliser
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.sampling.conditions import LevelConditions
from gesturekit.multires.sampling.noise import NoiseSource
from gesturekit.multires.sampling.tiling import sample


class Pyramid:
    """The levels of a trained network, for one motion.

    Args:
        network: the generators.
        normaliser: of motion vectors.
        lengths: T_i, frames of each level.
        condition: conditions of each level; None for a model without any.
        noise: source of noise; None if noise is only given.
        rng_of: random generator of a level, by its index; a new one at each call.
        recalled: (1, D, T_i) normalised motion that replaces a level in random motions; None to
            generate all levels.
        recalled_level: index of that level.
    """

    def __init__(
        self,
        network: MultiresGenerator,
        normaliser: Normaliser,
        lengths: Sequence[int],
        condition: LevelConditions | None,
        noise: NoiseSource | None = None,
        rng_of: Callable[[int], torch.Generator] | None = None,
        recalled: Tensor | None = None,
        recalled_level: int = 0,
    ) -> None:
        self.network, self.normaliser, self.lengths = network, normaliser, lengths
        self.condition, self.noise, self.rng_of = condition, noise, rng_of
        self.recalled, self.recalled_level = recalled, recalled_level

    def random(
        self, *, levels: int | None = None, constraint: Constraint | None = None
    ) -> np.ndarray:
        """Return the output (T_i, D) of the first `levels` levels, all by default.

        The first level gets noise, or a coarse level is recalled.

        Raises:
            ModelError: the output is not finite.
        """
        lengths = self.lengths[:levels]
        if self.recalled is not None:
            return self._above_recalled(lengths, constraint)
        noises = self.noise.gaussian(lengths, self.rng_of)
        noises[0] = self.noise.shuffled(noises[0], [self._coarsest_styles()], self.rng_of(0))
        return self._sampled(noises, lengths, constraint=constraint)

    def _above_recalled(self, lengths: Sequence[int], constraint: Constraint | None) -> np.ndarray:
        """Return the output (T_i, D) of the last of these levels, above the recalled one."""
        first, coarser = self.recalled_level + 1, self.recalled
        if len(lengths) < first:
            return self.normaliser.to_values(resample(coarser, lengths[-1]))
        if constraint is not None:
            coarser = constraint(self.recalled_level, coarser)
        lengths = lengths[first:]
        noises = self.noise.gaussian(lengths, self.rng_of, first=first)
        return self._sampled(noises, lengths, constraint, first=first, coarser=coarser)

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
        first, lengths = level + 1, self.lengths[level + 1 :]
        noises = self.noise.gaussian(lengths, self.rng_of, first=first)
        coarser = self.normaliser.from_values(values)
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
        """Return the finest of these levels, (T, D) in their own units; see `tiling.sample`."""
        vectors = sample(
            self.network,
            noises,
            lengths,
            self.condition,
            first=first,
            coarser=coarser,
            constraint=constraint,
        )
        values = self.normaliser.to_values(vectors)
        if not np.isfinite(values).all():
            raise ModelError("the model gave NaN; its weights are damaged or its training diverged")
        return values
