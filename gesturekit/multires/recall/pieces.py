"""Sequence of pieces of recordings that makes up a motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Pieces:
    """Consecutive pieces of recordings, each cross-faded into the next.

    All numbers are in frames of the recalled level.

    Attributes:
        recordings: (N,) index of each piece's recording.
        starts: (N,) first frame of each piece in its recording.
        hop: frames from the start of one piece to the start of the next.
        overlap: frames of the cross-fade between two pieces.
        n_frames: length of the motion, at most `N * hop + overlap - first`.
        first: frame of the first piece with which the motion begins.
        offsets: (n_frames,) time shift of each frame into the pieces; None if they are played as
            recorded.
    """

    recordings: np.ndarray
    starts: np.ndarray
    hop: int
    overlap: int
    n_frames: int
    first: int = 0
    offsets: np.ndarray | None = None

    def beginning_at(self, first: int) -> Pieces:
        """Return the same motion without its first `first` frames, which may be up to a piece."""
        return replace(self, first=first, n_frames=self.n_frames - first)

    def borders(self) -> np.ndarray:
        """Return the fractional frame (N - 1,) at the middle of each cross-fade, before
        stretching."""
        return np.arange(1, len(self.starts)) * self.hop + self.overlap / 2 - self.first

    def blend(
        self,
        curves: Sequence[Tensor],
        lengths: Sequence[int],
        n_frames: int,
        part: slice = slice(None),
    ) -> Tensor:
        """Return the curves (C, n_frames) of this motion, or a part of their frames.

        Args:
            curves: (C, T_k) of each recording, at any frame rate.
            lengths: frames of each recording at the recalled level.
            n_frames: frames of the whole motion, at any frame rate.
            part: frames of the result.
        """
        piece, into = self._shown(n_frames, part)
        weight = np.ones(len(into))
        if self.overlap:
            fading = piece > 0
            weight[fading] = np.clip((into[fading] + 0.5) / self.overlap, 0.0, 1.0)
        result = self._sampled(curves, lengths, piece, into)
        fading = np.flatnonzero(weight < 1.0)
        if len(fading):
            before = self._sampled(curves, lengths, piece[fading] - 1, into[fading] + self.hop)
            share = torch.from_numpy(weight[fading]).to(result.dtype)
            result[:, fading] = share * result[:, fading] + (1 - share) * before
        return result

    def recorded_frames(self, lengths: Sequence[int]) -> np.ndarray:
        """Return (n_frames,) the recorded frame that each frame shows, numbered across all
        recordings.

        In a cross-fade it is the frame of the later piece.
        """
        piece, into = self._shown(self.n_frames, slice(None))
        return np.cumsum([0, *lengths])[self.recordings[piece]] + self.starts[piece] + into

    def _shown(self, n_frames: int, part: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return the piece of each frame, and how far into it the frame is, both (M,)."""
        # Every rate divides the duration into equal frames (`af.level_lengths`).
        time = (np.arange(n_frames)[part] + 0.5) * (self.n_frames / n_frames) - 0.5
        if self.offsets is not None:
            time += np.interp(time, np.arange(self.n_frames), self.offsets)
        time += self.first
        piece = np.clip(np.floor(time / self.hop).astype(int), 0, len(self.starts) - 1)
        return piece, time - piece * self.hop

    def _sampled(
        self, curves: Sequence[Tensor], lengths: Sequence[int], piece: np.ndarray, into: np.ndarray
    ) -> Tensor:
        """Return the curves (C, M) at `into` (M,) frames after the start of each `piece` (M,)."""
        result = curves[0].new_empty(len(curves[0]), len(piece))
        owner = self.recordings[piece]
        for k in np.unique(owner):
            here = np.flatnonzero(owner == k)
            curve = curves[k]
            at = self.starts[piece[here]] + into[here] + 0.5
            at = np.clip(at * (curve.shape[-1] / lengths[k]) - 0.5, 0, curve.shape[-1] - 1)
            result[:, here] = _interpolated(curve, at)
        return result


def _interpolated(curve: Tensor, at: np.ndarray) -> Tensor:
    """Return the curve (C, T) at fractional frames (M,), from 0 to T - 1, as (C, M).

    Interpolation is by Catmull-Rom splines, because linear interpolation would flatten the peaks of
    fast gestures.
    """
    low, last = at.astype(int), curve.shape[-1] - 1
    part = torch.from_numpy(at - low).to(curve.dtype)
    weights = (
        part * ((2 - part) * part - 1),
        (3 * part - 5) * part**2 + 2,
        part * ((4 - 3 * part) * part + 1),
        (part - 1) * part**2,
    )
    around = [np.clip(low + i, 0, last) for i in (-1, 0, 1, 2)]
    return sum(w * curve[:, i] for w, i in zip(weights, around, strict=True)) / 2
