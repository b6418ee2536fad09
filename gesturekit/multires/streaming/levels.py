"""Finer levels of the frames around the current one, prepared once for a whole stream."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gesturekit.multires.backend import choose_backend
from gesturekit.multires.network.generator import Film, LevelGenerator
from gesturekit.multires.network.resampling import resample_part
from gesturekit.multires.network.skeleton_conv import SLOPE, SkeletonConv1d
from gesturekit.multires.sampling.conditions import LevelConditions
from gesturekit.multires.sampling.trained_model import TrainedModel, halo


class _Level(NamedTuple):
    """One level, for the frames that the next one depends on.

    Attributes:
        layers: convolutions.
        up: (T of the coarser level, T) upsampling.
        features: (T of the features, T) their resampling.
        embedding: (E, S) weights of the speech features.
        offset: (E, T) the rest of the embedding: its bias, and a style.
        rectified: False for a linear embedding.
        gains: (2 C of the modulated layers, E) weights of gains and shifts.
        shifts: (2 C of the modulated layers, 1) their biases.
        kept: frames that are not only context.
    """

    layers: Sequence[SkeletonConv1d]
    up: Tensor
    features: Tensor
    embedding: Tensor
    offset: Tensor
    rectified: bool
    gains: Tensor
    shifts: Tensor
    kept: slice


class FinerLevels:
    """Levels above the recalled one, without noise, for a part of a window.

    The result is that of `sampling.trained_model.sample`, but for rounding. It takes a third of the
    time: frames on which the part does not depend are not computed, resampling is a product with a
    matrix, and all gains and shifts of a level are one product.

    Args:
        model: with speech input and recall.
        lengths: T_i, frames of each level in the window.
        styles: (1, K, T_i) for each level, or empty.
        part: frames of the finest level that are wanted.

    Attributes:
        recalled: frames of the recalled level on which they depend.
    """

    def __init__(
        self, model: TrainedModel, lengths: Sequence[int], styles: Sequence[Tensor], part: range
    ) -> None:
        first, self._levels = model.recall_library.level, list[_Level]()
        networks = model.network.levels[first:]
        self._backend = choose_backend("auto", *networks)
        self._columns = model.conditions.columns
        identity = np.eye(lengths[-1], dtype=np.float32)
        condition = LevelConditions([identity] * len(lengths), lengths, model.conditions.residual)
        for i in reversed(range(first, len(lengths))):
            level = model.network.levels[i]
            begin = max(0, part.start - halo(level))
            end = min(lengths[i], part.stop + halo(level))
            kept = slice(part.start - begin, part.stop - begin)
            up = resample_part(torch.eye(lengths[i - 1]), lengths[i], begin, end)
            used = np.flatnonzero(up.any(dim=1).numpy())
            part = range(int(used[0]), int(used[-1]) + 1)
            style = styles[i][0, :, begin:end] if styles else torch.empty(0, end - begin)
            up, features = up[part.start : part.stop], condition(i, begin, end)[0]
            self._levels.insert(0, _prepared(level, up, features, style, kept))
        self.recalled = part

    def __call__(self, recalled: Tensor, speech: np.ndarray) -> Tensor:
        """Return the normalised motion vectors (D, len(part)).

        Args:
            recalled: (D, T) normalised motion at the frames `self.recalled`.
            speech: (T, S) features of the window.
        """
        features = torch.from_numpy(speech[:, self._columns].T.astype(np.float32))
        with torch.inference_mode(), self._backend.threads():
            for level in self._levels:
                up = recalled @ level.up
                recalled = (self._added(level, up, features) + up)[:, level.kept]
        return recalled

    def _added(self, level: _Level, x: Tensor, features: Tensor) -> Tensor:
        """Return the detail (D, T) that a level adds to x (D, T)."""
        y = level.embedding @ (features @ level.features) + level.offset
        y = F.leaky_relu(y, SLOPE) if level.rectified else y
        films = torch.addmm(level.shifts, level.gains, y)
        for i, layer in enumerate(level.layers):
            if len(films):
                gain, shift, films = films.split([len(x), len(x), len(films) - 2 * len(x)])
                x = torch.addcmul(shift, x, gain)
            slope = 1.0 if i == len(level.layers) - 1 else SLOPE
            x = self._backend.convolve([layer], x[None], slope, slope)[0]
        return x


@torch.no_grad()
def _prepared(
    level: LevelGenerator, up: Tensor, features: Tensor, style: Tensor, kept: slice
) -> _Level:
    """Return a level for its conditions: `features`, see `_Level`, and style (K, T)."""
    assert level.embed.bias is not None
    weight = level.embed.weight[..., 0]
    speech, own = weight.split([weight.shape[1] - len(style), len(style)], dim=1)
    offset = level.embed.bias[:, None] + own @ style
    gains, shifts = zip(*(rows for film in level.films for rows in _padded(film)), strict=True)
    rows = torch.cat(gains), torch.cat(shifts)[:, None]
    return _Level(level.layers, up, features, speech, offset, level.rectify_embedding, *rows, kept)


def _padded(film: Film) -> list[tuple[Tensor, Tensor]]:
    """Return weights (C, E) and biases (C,) of gain and shift; 1 and 0 where a channel has none."""
    return [
        (
            F.pad(weight[..., 0], (0, 0, 1, 0))[film.index],
            F.pad(bias, (1, 0))[film.index] + usual,
        )
        for (weight, bias), usual in (
            (film.gain.parameters(), 1.0),
            (film.shift.parameters(), 0.0),
        )
    ]
