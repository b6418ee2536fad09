"""Sampling a pyramid in pieces of bounded length that fit together without a seam.

A level's frame depends on the frames around it and on nothing else: what lies further away than
the convolutions reach may as well be missing. So each level is made a piece at a time, each with
that many more frames at both sides (its halo), which are thrown away. A short motion is one piece.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.multires.interpolation import resample_part
from gesturekit.multires.networks import LevelGenerator, MultiresGenerator

CHUNK = 2048
"""Frames of a level made at a time: 16 of halo are little beside it, and they need some 50 MB."""

Condition = Callable[[int, int, int], Tensor]
"""condition(level, start, stop): (B, S, stop - start) what these frames of a level are told."""


@torch.no_grad()
def sample(
    network: MultiresGenerator,
    noises: Sequence[Tensor | None],
    lengths: Sequence[int],
    condition: Condition | None,
    *,
    chunk: int = CHUNK,
) -> Tensor:
    """The finest of `network(noises, conditions, lengths=lengths)`, in bounded memory beside it.

    Args:
        network: the pyramid, in evaluation mode.
        noises: (B, 1, T_i) for each level; None, but for the first, stands for no noise at all.
        lengths: T_i, frames of each level.
        condition: asked for each piece of each level; None leaves out the modulation.
        chunk: frames made at a time.

    Returns:
        (B, D, T), whatever `chunk` up to the rounding of sums.
    """
    batch, width = len(noises[0]), network.levels[0].layers[0].shape[1]
    coarser = noises[0].new_zeros(batch, width, lengths[0])
    for i, (level, noise, n_frames) in enumerate(zip(network.levels, noises, lengths, strict=True)):
        made = coarser.new_empty(batch, width, n_frames)
        reach = halo(level)
        for start, stop in pieces(n_frames, chunk):
            first, last = max(0, start - reach), min(n_frames, stop + reach)
            up = resample_part(coarser, n_frames, first, last)
            shaken = up.new_zeros(batch, 1, 1) if noise is None else noise[..., first:last]
            told = None if condition is None else condition(i, first, last)
            piece = level(up, shaken, told)
            made[..., start:stop] = piece[..., start - first : stop - first]
        coarser = made
    return coarser


def halo(level: LevelGenerator) -> int:
    """How many frames of its own rate a level sees to each side."""
    return sum(layer.padding for layer in level.layers)


def pieces(n_frames: int, chunk: int) -> Iterator[tuple[int, int]]:
    """Start and stop of each piece of `n_frames`, as equal as can be."""
    count = -(-n_frames // chunk)
    edges = [n_frames * i // count for i in range(count + 1)]
    return zip(edges[:-1], edges[1:], strict=True)


class SpeechCondition:
    """What each level hears, without a pyramid of the whole speech in memory.

    Args:
        speech: (T, S) float32 features at the finest level.
        lengths: T_i, frames of each level.
        residual: whether finer levels hear only what the coarser ones lack.
    """

    def __init__(self, speech: np.ndarray, lengths: Sequence[int], residual: bool) -> None:
        self.speech = speech
        self.lengths = lengths
        self.residual = residual

    def __call__(self, level: int, start: int, stop: int) -> Tensor:
        """(1, S, stop - start), frames `start` to `stop` of `condition_levels(...)[level]`."""
        if self.residual:
            heard = af.residual_level(self.speech, self.lengths, level, start, stop)
        else:
            heard = af.resample_frames(self.speech, self.lengths[level], start, stop)
        return torch.from_numpy(np.ascontiguousarray(heard.T))[None]
