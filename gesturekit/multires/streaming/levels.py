"""Levels of the frames around the current one, prepared once for a whole stream."""

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
from gesturekit.multires.sampling.trained_model import TrainedModel, halo, mixed_carriers
from gesturekit.state.channels import averaged


class _Level(NamedTuple):
    """One level, for the frames that the next one depends on.

    Attributes:
        layers: convolutions.
        up: (T of the coarser level, T) upsampling; None for the first level.
        features: (T of the features, T) their resampling.
        means: (T of the features, T) averages, for the channels of the state of movement.
        plain: (T of the features, T) interpolation, for its carriers.
        embedding: (E, S + C + H + 4 H) weights of the speech features and of the state.
        offset: (E, T) the rest of the embedding: its bias, and a style.
        rectified: False for a linear embedding.
        gains: (2 C of the modulated layers, E) weights of gains and shifts.
        shifts: (2 C of the modulated layers, 1) their biases.
        kept: frames that are not only context.
    """

    layers: Sequence[SkeletonConv1d]
    up: Tensor | None
    features: Tensor
    means: Tensor
    plain: Tensor
    embedding: Tensor
    offset: Tensor
    rectified: bool
    gains: Tensor
    shifts: Tensor
    kept: slice


class WindowLevels:
    """All levels of a model with a state of movement, for part of a window.

    The result is that of `sampling.trained_model.sample`, but for rounding. It takes a third of the
    time: frames on which the part does not depend are not computed, resampling is a product with a
    matrix, and all gains and shifts of a level are one product.

    Args:
        model: with speech input and a state of movement.
        lengths: T_i, frames of each level in the window.
        styles: (1, K, T_i) for each level, or empty.
        part: frames of the finest level that are wanted.
    """

    def __init__(
        self, model: TrainedModel, lengths: Sequence[int], styles: Sequence[Tensor], part: range
    ) -> None:
        self._levels = list[_Level]()
        self._backend = choose_backend("auto", *model.network.levels)
        self._columns = model.conditions.columns
        state = model.conditions.state
        self._n_carriers = 0 if state is None else state.n_carriers
        identity = np.eye(lengths[-1], dtype=np.float32)
        condition, interpolated = (
            LevelConditions([identity] * len(lengths), lengths, residual)
            for residual in (model.conditions.residual, False)
        )
        for i in reversed(range(len(lengths))):
            level = model.network.levels[i]
            begin = max(0, part.start - halo(level))
            end = min(lengths[i], part.stop + halo(level))
            kept = slice(part.start - begin, part.stop - begin)
            up, part = None, range(begin, end)
            if i:
                weights = resample_part(torch.eye(lengths[i - 1]), lengths[i], begin, end)
                used = np.flatnonzero(weights.any(dim=1).numpy())
                part = range(int(used[0]), int(used[-1]) + 1)
                up = weights[part.start : part.stop]
            style = styles[i][0, :, begin:end] if styles else torch.empty(0, end - begin)
            matrices = (
                condition(i, begin, end)[0],
                torch.from_numpy(averaged(identity, lengths[i], begin, end)),
                interpolated(i, begin, end)[0],
            )
            self._levels.insert(0, _prepared(level, up, matrices, style, kept, len(self._columns)))
        self._sigma = model.noise.sigma.mean(dim=0)[0]

    def __call__(self, speech: np.ndarray, state: np.ndarray) -> Tensor:
        """Return the normalised motion vectors (D, len(part)).

        Args:
            speech: (T, S) features of the window.
            state: (C + H + 4 H, T) of the window, see `StateProcess.condition`.
        """
        features = torch.from_numpy(speech[:, self._columns].T.astype(np.float32))
        stated = torch.from_numpy(state)
        channels, carriers = stated.split([len(stated) - self._n_carriers, self._n_carriers])
        motion: Tensor | None = None
        with torch.inference_mode(), self._backend.threads():
            for level in self._levels:
                own = carriers @ level.plain
                given = torch.cat([features @ level.features, channels @ level.means, own])
                if level.up is None or motion is None:
                    noise = self._sigma * mixed_carriers(own[None])[0]
                    motion = self._added(level, noise.expand(level.layers[0].shape[1], -1), given)
                else:
                    up = motion @ level.up
                    motion = self._added(level, up, given) + up
                motion = motion[:, level.kept]
        assert motion is not None
        return motion

    def _added(self, level: _Level, x: Tensor, given: Tensor) -> Tensor:
        """Return the detail (D, T) that a level adds to x (D, T), from its condition."""
        y = level.embedding @ given + level.offset
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
    level: LevelGenerator,
    up: Tensor | None,
    matrices: tuple[Tensor, Tensor, Tensor],
    style: Tensor,
    kept: slice,
    n_features: int,
) -> _Level:
    """Return a level for its conditions: `matrices` from `features` on, see `_Level`.

    `style` is (K, T), and `n_features` is S.
    """
    assert level.embed.bias is not None
    weight = level.embed.weight[..., 0]
    n_state = weight.shape[1] - n_features - len(style)
    speech, own, state = weight.split([n_features, len(style), n_state], dim=1)
    offset = level.embed.bias[:, None] + own @ style
    gains, shifts = zip(*(rows for film in level.films for rows in _padded(film)), strict=True)
    rows = torch.cat(gains), torch.cat(shifts)[:, None]
    embedding = torch.cat([speech, state], dim=1)
    return _Level(
        level.layers, up, *matrices, embedding, offset, level.rectify_embedding, *rows, kept
    )


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
