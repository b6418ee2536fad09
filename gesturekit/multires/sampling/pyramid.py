"""A trained pyramid that was told what to make: noise or a coarse level in, motion vectors out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gesturekit.errors import ModelError
from gesturekit.multires.constraints.constraint import Hold, normalised, plain_values
from gesturekit.multires.sampling.noise import Recall
from gesturekit.multires.sampling.tiling import LevelConditions, sample

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel


class Pyramid:
    """A model's levels for one motion.

    Args:
        model: whose levels.
        lengths: frames of each level.
        features: (T, S) float32 of the speech at the finest level; no columns where nothing is
            heard.
        styles: (1, K, T_i) for each level, or none.
        chance: where the noise of a level, counted from 0, is drawn from; None for a pyramid that
            is only given noise.
    """

    def __init__(
        self,
        model: MultiresModel,
        lengths: Sequence[int],
        features: np.ndarray,
        styles: Sequence[Tensor],
        chance: Callable[[int], torch.Generator] | None = None,
    ) -> None:
        self.model, self.lengths, self.chance = model, lengths, chance
        self.condition = None
        if features.shape[1] or styles:
            self.condition = LevelConditions(features, lengths, model.residual, styles)

    def random(self, *, levels: int | None = None, hold: Hold | None = None) -> np.ndarray:
        """(T_i, D) what the first `levels` (all of them by default) make of noise that is drawn.

        Args:
            levels: how many.
            hold: what each of them is held to, see `holding`.

        Raises:
            ModelError: the model gives no numbers.
        """
        lengths = self.lengths[:levels]
        noises = [self._noise(), *self._finer_noise(1, len(lengths))]
        return self._plain(sample(self.model.network, noises, lengths, self.condition, hold=hold))

    def from_noise(self, noise: Tensor) -> np.ndarray:
        """(T, D) what all levels make of noise (1, 1 or D, T_1) at the first and none above."""
        noises = [noise, *[None] * (len(self.lengths) - 1)]
        return self._plain(sample(self.model.network, noises, self.lengths, self.condition))

    def above(self, level: int, values: np.ndarray, hold: Hold | None = None) -> np.ndarray:
        """(T, D) what finer levels make of the vectors (T_i, D) in the place of a level.

        Args:
            level: which, from 0.
            values: in their own units. Of the finest level they come back.
            hold: what each finer level is held to, see `holding`.

        Raises:
            ModelError: the model gives no numbers.
        """
        finer = self.lengths[level + 1 :]
        vectors = sample(
            self.model.network,
            self._finer_noise(level + 1, len(self.lengths)),
            finer,
            self.condition,
            first=level + 1,
            coarser=normalised(self.model.normaliser, values),
            hold=hold,
        )
        return self._plain(vectors)

    def _finer_noise(self, first: int, stop: int) -> list[Tensor | None]:
        """(1, 1, T_i) for each of these levels, or none for those above `noise_levels`."""
        model = self.model
        return [
            torch.randn(1, 1, self.lengths[i], generator=self.chance(i)) * model.sigma[:, i].mean()
            if i < model.noise_levels
            else None
            for i in range(first, stop)
        ]

    def _noise(self) -> Tensor:
        """(1, 1 or D, T_1) that a random motion begins with."""
        model, n_frames, rng = self.model, self.lengths[0], self.chance(0)
        if not model.z_star_shuffle:
            return torch.randn(1, 1, n_frames, generator=rng) * model.sigma[:, 0].mean()
        names = sorted(model.z_star)
        owners, wanted = [0] * len(names), [0] * n_frames
        if model.styles:
            owners = [model.styles.index(model.sequences[name].style) for name in names]
            told = self.condition(0, 0, n_frames)[0, -len(model.styles) :]
            wanted = told.argmax(dim=0).tolist()
        return Recall([model.z_star[name] for name in names], owners, model.z_star_shuffle)(
            wanted, rng
        )

    def _plain(self, vectors: Tensor) -> np.ndarray:
        """(T, 6 K + C + 3) normalised vectors (1, D, T) in their own units."""
        values = plain_values(self.model.normaliser, vectors)
        if not np.isfinite(values).all():
            raise ModelError("the model gave NaN; its weights are damaged or it was trained badly")
        return values
