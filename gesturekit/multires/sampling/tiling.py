"""Tiled inference: sample a pyramid in bounded memory, without seams.

A frame of a level depends on the frames within reach of the convolutions only. So each level is
generated tile by tile, each with that many more frames at both sides (its halo), which are cut
off. A short motion is one tile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from gesturekit.multires.backend import choose_backend, requested_backend
from gesturekit.multires.constraints.constraint import Constraint
from gesturekit.multires.network.generator import LevelGenerator, MultiresGenerator
from gesturekit.multires.network.resampling import resample_part

TILE = 2048
"""Frames of a tile, which need about 50 MB; the halo of 16 frames is a small part of it."""

Condition = Callable[[int, int, int], Tensor]
"""condition(level, start, stop): (B, S, stop - start), the condition of these frames of a level."""


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
    backend = choose_backend(requested_backend(), levels)
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
