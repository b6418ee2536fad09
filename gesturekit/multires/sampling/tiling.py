"""Sampling a pyramid in pieces of bounded length that fit together without a seam.

A level's frame depends on the frames around it and on nothing else: what lies further away than
the convolutions reach may as well be missing. So each level is made a piece at a time, each with
that many more frames at both sides (its halo), which are thrown away. A short motion is one piece.

With `backend: auto` motions of up to `SHORT` frames are made by torch alone, which needs tens of
milliseconds, longer ones by compiled kernels, which are three times as fast and take seconds to
compile if numba's cache is empty. The number of frames alone decides: the same request gives the
same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.multires.backend import choose_backend, requested_backend
from gesturekit.multires.network.generator import LevelGenerator, MultiresGenerator
from gesturekit.multires.network.resampling import resample_part
from gesturekit.multires.network.skeleton_conv import convolve_dense

CHUNK = 2048
"""Frames of a level made at a time: 16 of halo are little beside it, and they need some 50 MB."""
SHORT = 1024
"""Frames of the finest level asked for, margins included, up to which nothing is compiled."""

Condition = Callable[[int, int, int], Tensor]
"""condition(level, start, stop): (B, S, stop - start) what these frames of a level are told."""


@torch.no_grad()
def sample(
    network: MultiresGenerator,
    noises: Sequence[Tensor | None],
    lengths: Sequence[int],
    condition: Condition | None,
    *,
    first: int = 0,
    coarser: Tensor | None = None,
    hold: Callable[[int, Tensor], Tensor] | None = None,
    chunk: int = CHUNK,
) -> Tensor:
    """The finest of `network(noises, conditions, ...)`, in bounded memory beside it.

    Args:
        network: the pyramid, in evaluation mode.
        noises: (B, 1, T_i) for each level; None, but for the first of all, stands for no noise.
        lengths: T_i, frames of each of these levels.
        first: index of the first of these levels.
        coarser: (B, D, T) the level before `first`; None at the first level of all. Without any
            level above it, it is what comes back.
        condition: asked for each piece of each level; None leaves out the modulation.
        hold: given the number of a level and all that it made, (B, D, T_i); what it gives back
            goes on to the next level. See `holding`.
        chunk: frames made at a time.

    Returns:
        (B, D, T), whatever `chunk` up to the rounding of sums.
    """
    if coarser is None:
        coarser = noises[0].new_zeros(
            len(noises[0]), network.levels[0].layers[0].shape[1], lengths[0]
        )
    levels = network.levels[first : first + len(lengths)]
    requested = requested_backend()
    backend = choose_backend(requested, levels)
    plain = requested == "auto" and max(lengths, default=0) <= SHORT
    convolve = convolve_dense if plain else backend.convolve
    with backend.threads():
        for i, (level, noise, n_frames) in enumerate(
            zip(levels, noises, lengths, strict=True), first
        ):
            made = coarser.new_empty(*coarser.shape[:2], n_frames)
            reach = halo(level)
            for start, stop in pieces(n_frames, chunk):
                begin, end = max(0, start - reach), min(n_frames, stop + reach)
                up = resample_part(coarser, n_frames, begin, end)
                shaken = up.new_zeros(len(up), 1, 1) if noise is None else noise[..., begin:end]
                told = None if condition is None else condition(i, begin, end)
                piece = level(up, shaken, told, convolve)
                made[..., start:stop] = piece[..., start - begin : stop - begin]
            coarser = made if hold is None else hold(i, made)
    return coarser


def halo(level: LevelGenerator) -> int:
    """How many frames of its own rate a level sees to each side."""
    return sum(layer.padding for layer in level.layers)


def pieces(n_frames: int, chunk: int) -> Iterator[tuple[int, int]]:
    """Start and stop of each piece of `n_frames`, as equal as can be."""
    count = -(-n_frames // chunk)
    edges = [n_frames * i // count for i in range(count + 1)]
    return zip(edges[:-1], edges[1:], strict=True)


class LevelConditions:
    """What each level is told, without a pyramid of the whole speech in memory.

    Args:
        speech: (T, S) float32 features at the finest level; no columns where nothing is heard.
        lengths: T_i, frames of each level.
        residual: whether finer levels hear only what the coarser ones lack.
        styles: (1, K, T_i) for each level, or none.
    """

    def __init__(
        self,
        speech: np.ndarray,
        lengths: Sequence[int],
        residual: bool,
        styles: Sequence[Tensor] = (),
    ) -> None:
        self.speech = speech
        self.lengths = lengths
        self.residual = residual
        self.styles = styles

    def __call__(self, level: int, start: int, stop: int) -> Tensor:
        """(1, S + K, stop - start), frames `start` to `stop` of `condition_levels(...)[level]`."""
        parts = []
        if self.speech.shape[1]:
            if self.residual:
                heard = af.residual_level(self.speech, self.lengths, level, start, stop)
            else:
                heard = af.resample_frames(self.speech, self.lengths[level], start, stop)
            parts.append(torch.from_numpy(np.ascontiguousarray(heard.T))[None])
        if self.styles:
            parts.append(self.styles[level][..., start:stop])
        return torch.cat(parts, dim=1)
