"""Standardisation of motion vectors to zero mean and unit variance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Standardiser:
    """Mean and scale of each number of a motion vector (appendix A.1).

    Attributes:
        mean: (X,) float32.
        scale: (X,) float32, above 0.
    """

    mean: Tensor
    scale: Tensor

    @classmethod
    def fit(cls, vectors: Sequence[np.ndarray], floor: np.ndarray | float = 1e-3) -> Standardiser:
        """Compute mean and standard deviation over all frames of the training motions.

        Args:
            vectors: (T, X) each.
            floor: least scale, a number or (X,). Without it, noise in a joint that hardly moves
                would count as much as a gesture.
        """
        n_frames = sum(map(len, vectors))
        mean = sum(values.sum(axis=0, dtype=np.float64) for values in vectors) / n_frames
        square = sum(((values - mean) ** 2).sum(axis=0) for values in vectors) / n_frames
        scale = np.maximum(np.sqrt(square), floor)
        return cls(torch.from_numpy(mean).float(), torch.from_numpy(scale).float())

    def to(self, device: torch.device) -> Standardiser:
        """Return a copy on another device."""
        return Standardiser(self.mean.to(device), self.scale.to(device))

    def forward(self, values: Tensor) -> Tensor:
        """Standardise values (..., X)."""
        return (values - self.mean) / self.scale

    def inverse(self, values: Tensor) -> Tensor:
        """Convert standardised values (..., X) back to their own units."""
        return values * self.scale + self.mean
