"""Tiled inference: noise predictions of long motions from overlapping tiles.

The network's cost and memory are linear in the length. Minutes are predicted at once, hours tile by
tile. Where two tiles overlap, their predictions are cross-faded at every denoising step: both tiles
continue from the same noisy motion, so there are no seams.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.sampling.experts import ProductOfExperts
from gesturekit.diffusion.sampling.solvers import Predict
from gesturekit.errors import ModelError

OVERLAP = 150
"""Least overlap of neighbouring tiles in frames, or a quarter of a tile if that is less. Tiles are
cross-faded over the middle third of the overlap; each outer third belongs to the tile whose border
is farther away."""


@dataclass(frozen=True, eq=False)
class Tile:
    """Frames first (included) to last (excluded), with weights (last - first,) float32."""

    first: int
    last: int
    weights: np.ndarray


def tiles_of(n_frames: int, size: int) -> list[Tile]:
    """Return evenly spaced tiles of at most `size` frames; weights add up to 1 at each frame.

    Raises:
        ModelError: tiles of less than four frames.
    """
    if size < 4:
        raise ModelError(f"window: {size} frames; give at least 4")
    if n_frames <= size:
        return [Tile(0, n_frames, np.ones(n_frames, np.float32))]
    overlap = min(OVERLAP, size // 4)
    count = -(-(n_frames - overlap) // (size - overlap))
    size = -(-(n_frames + (count - 1) * overlap) // count)
    starts = [round(k * (n_frames - size) / (count - 1)) for k in range(count)]
    rising = [np.ones(size)]
    for before, start in zip(starts, starts[1:], strict=False):
        shared = before + size - start
        third = shared / 3
        rising.append(np.clip((np.arange(size) + 0.5 - third) / third, 0.0, 1.0))
    tiles = []
    for k, start in enumerate(starts):
        weights = rising[k].copy()
        if k + 1 < count:
            own = starts[k + 1] - start
            weights[own:] -= rising[k + 1][: size - own]
        tiles.append(Tile(start, start + size, weights.astype(np.float32)))
    return tiles


def tiled(product: ProductOfExperts, size: int) -> Predict:
    """Return `product.predict`, in tiles of `size` frames if the motion is longer.

    In each tile, only experts with a weight there are run. No state that grows with the length is
    kept between two calls.
    """
    tiles = tiles_of(product.n_frames, size)
    if len(tiles) == 1:
        return product.predict

    def predict(noisy: Tensor, step: int) -> Tensor:
        total = torch.zeros_like(noisy)
        for tile in tiles:
            frames = slice(tile.first, tile.last)
            weights = torch.from_numpy(tile.weights).to(noisy.device, noisy.dtype)
            own = product.part(tile.first, tile.last).predict(noisy[:, frames], step)
            total[:, frames] += weights[:, None] * own
        return total

    return predict
