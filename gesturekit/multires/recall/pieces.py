"""Pieces of recordings that make up a motion, and their choice by a beam search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

BEAM = 48
"""Width of the beam: number of sequences of pieces that are kept."""
_STEPS_AT_ONCE = 64
"""Pieces whose distances to all recorded frames are in memory at once."""
_FORGETTING = 0.95
"""Decay of the use counts after each piece, so that long motions may reuse pieces after some
time."""


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
        shown = self.recordings[piece], self.starts[piece] + into
        earlier = np.maximum(piece - 1, 0)
        before = self.recordings[earlier], self.starts[earlier] + into + self.hop
        return cross_faded(curves, lengths, shown, before, weight)

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


def cross_faded(
    curves: Sequence[Tensor],
    lengths: Sequence[int],
    shown: tuple[np.ndarray, np.ndarray],
    before: tuple[np.ndarray, np.ndarray],
    weight: np.ndarray,
) -> Tensor:
    """Return curves (C, M) of recordings, faded over from other ones.

    Args:
        curves: (C, T_k) of each recording, at any frame rate.
        lengths: frames of each recording at the recalled level.
        shown: recording and frame at the recalled level, (M,) each.
        before: the same for what is faded over from.
        weight: (M,) of `shown`, 0 to 1.
    """
    result = _sampled(curves, lengths, *shown)
    fading = np.flatnonzero(weight < 1.0)
    if len(fading):
        earlier = _sampled(curves, lengths, *(own[fading] for own in before))
        share = torch.from_numpy(weight[fading]).to(result.dtype)
        result[:, fading] = share * result[:, fading] + (1 - share) * earlier
    return result


def _sampled(
    curves: Sequence[Tensor], lengths: Sequence[int], recordings: np.ndarray, frames: np.ndarray
) -> Tensor:
    """Return the curves (C, M) at these frames (M,) of the recalled level."""
    result = curves[0].new_empty(len(curves[0]), len(recordings))
    for k in np.unique(recordings):
        here = np.flatnonzero(recordings == k)
        curve = curves[k]
        at = np.clip((frames[here] + 0.5) * (curve.shape[-1] / lengths[k]) - 0.5, 0, None)
        result[:, here] = _interpolated(curve, np.minimum(at, curve.shape[-1] - 1))
    return result


def _interpolated(curve: Tensor, at: np.ndarray) -> Tensor:
    """Return the curve (C, T) at fractional frames (M,), from 0 to T - 1, as (C, M).

    Interpolation is by Catmull-Rom splines, because linear interpolation would flatten the peaks of
    fast gestures.
    """
    # numpy gathers a few frames several times faster than torch.
    frames, low, last = curve.numpy(), at.astype(int), curve.shape[-1] - 1
    weights = spline_weights((at - low).astype(frames.dtype))
    around = [np.clip(low + i, 0, last) for i in TAPS]
    found = sum(w * frames[:, i] for w, i in zip(weights, around, strict=True))
    return torch.from_numpy(found)


TAPS = (-1, 0, 1, 2)
"""Frames that a Catmull-Rom spline needs, relative to the one at or before its time."""


def spline_weights(part: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the weights (M,) of the `TAPS`, a `part` (M,) of a frame after the second one."""
    return (
        part * ((2 - part) * part - 1) / 2,
        ((3 * part - 5) * part**2 + 2) / 2,
        part * ((4 - 3 * part) * part + 1) / 2,
        (part - 1) * part**2 / 2,
    )


@dataclass(frozen=True)
class ChoiceWeights:
    """Weights of the cost terms in the choice of pieces.

    Attributes:
        movement: squared difference of predicted and recorded fast movement, in standard
            deviations.
        slow: squared difference of drawn and recorded slow movement, in standard deviations.
        place: the same for the place where a hand is held, and for how wide it reaches.
        together: in the choice of the second arm, squared difference between its hand's directions
            and those of the first hand in the motion so far.
        continuity: mean squared difference of the normalised vectors over the cross-fade.
        used: number of recent uses of the same recorded frames.
        copied: fraction of a piece in which all parts chosen before show the same moment of the
            same recording; a quarter of it for the second arm, whose gestures may be two-handed.
        defective: 1 for a piece with motion-capture errors. If all pieces have errors, they are
            used nevertheless.
        chance: scale of the Gumbel noise that makes seeds differ.
    """

    movement: float = 24.0
    slow: float = 12.0
    place: float = 0.5
    together: float = 2.5
    continuity: float = 3.0
    used: float = 0.25
    copied: float = 12.0
    defective: float = 30.0
    chance: float = 0.5


class PieceSearch:
    """Search for the pieces of recordings that fit a movement profile.

    Args:
        vectors: (T_k, C) normalised motion of each recording at the recalled level.
        profiles: (T_k, 1) fast movement of each recording, in standard deviations; or (T_k, 3),
            followed by the directions of the hand, to compare with those of the other one.
        states: (T_k, S) slow channels of each recording: movement, then places.
        piece: frames of a piece; no more than the longest recording has.
        overlap: frames of the cross-fade; at most half a piece, so that each ends before the next.
        shrinkage: (C,) weight of the square of each column of a profile, from 0 to 1, where the
            wanted one is a prediction. The plain squared difference (1) would prefer pieces that
            vary as little as predictions. With the square of the prediction's correlation, the
            cost is the logarithm of how much likelier the prediction makes a piece, for Gaussians.
        weights: of the choice.
        defective: (T_k,) bool, the frames of each recording in which the part jumps or pops.
    """

    def __init__(
        self,
        vectors: Sequence[np.ndarray],
        profiles: Sequence[np.ndarray],
        states: Sequence[np.ndarray],
        piece: int,
        overlap: int,
        shrinkage: Sequence[float],
        weights: ChoiceWeights,
        defective: Sequence[np.ndarray],
    ) -> None:
        self.piece = max(1, min(piece, max(map(len, vectors))))
        self.overlap = max(0, min(overlap, self.piece // 2))
        self.hop = self.piece - self.overlap
        self.weights = weights
        usable = [max(0, len(vector) - self.piece + 1) for vector in vectors]
        self.recording = np.repeat(np.arange(len(vectors)), usable)
        self.start = np.concatenate([np.arange(count) for count in usable])
        self.first = np.cumsum([0, *map(len, vectors)])
        self.frame = self.first[self.recording] + self.start
        self.vectors = np.concatenate(vectors).astype(np.float32)
        counts = [weights.movement, weights.together, weights.together]
        self.scale = np.sqrt(np.array(counts[: profiles[0].shape[1]]) / self.piece)
        self.profiles = np.concatenate(
            [
                self._windows(profile)
                for profile, count in zip(profiles, usable, strict=True)
                if count
            ]
        )
        self.squares = np.square(self.profiles) * np.repeat(shrinkage, self.piece)
        pooled = np.concatenate(states)
        counts = [weights.slow] + [weights.place] * (pooled.shape[1] - 1)
        # Squares of states far from their mean would be inexact in float32.
        self.usual_states = pooled.mean(axis=0)
        self.of_states = np.sqrt(np.array(counts)) / np.maximum(pooled.std(axis=0), 1e-6)
        self.states = self._means(pooled)[self.frame].astype(np.float32)
        self.squares_of_states = np.square(self.states).sum(axis=1)
        counts = np.cumsum([0, *np.concatenate(defective)])
        has_some = counts[self.frame + self.piece] > counts[self.frame]
        self.defects = weights.defective * has_some.astype(np.float32)
        # Frames of the recordings in bins of a piece's length, in which uses are counted.
        self.bins = np.stack([self.frame, self.frame + self.piece - 1]) // self.piece
        self.n_bins = int(self.bins.max()) + 1

    def _windows(self, profile: np.ndarray) -> np.ndarray:
        """Return the weighted profile (N, C * piece) of every window of (T, C)."""
        scaled = (profile * self.scale).astype(np.float32)
        windows = np.lib.stride_tricks.sliding_window_view(scaled, self.piece, axis=0)
        return windows.reshape(len(windows), -1)

    def _means(self, states: np.ndarray) -> np.ndarray:
        """Return the weighted means (T - piece + 1, S) of states (T, S) in each window."""
        scaled = (states - self.usual_states) * self.of_states
        total = np.cumsum(np.pad(scaled, ((1, 0), (0, 0))), axis=0)
        return (total[self.piece :] - total[: -self.piece]) / self.piece

    def choose_from_any_frame(
        self, rng: torch.Generator, *rows: np.ndarray | None, first: int | None = None
    ) -> Pieces:
        """Return the pieces for the `rows` (T, ...) of `choose`, beginning inside the first piece.

        The offset into the first piece is random, so that the joins, and with them the chosen
        pieces, differ between seeds.
        """
        if first is None:
            first = int(torch.randint(self.hop, (), generator=rng))
        earlier = ((first, 0), (0, 0))
        wider: list[Any] = [
            None if row is None else np.pad(row, earlier, mode="edge") for row in rows
        ]
        return self.choose(rng, *wider).beginning_at(first)

    def choose(
        self,
        rng: torch.Generator,
        wanted: np.ndarray,
        states: np.ndarray,
        allowed: np.ndarray | None = None,
        others: np.ndarray | None = None,
    ) -> Pieces:
        """Return the pieces for a wanted profile.

        Args:
            rng: random numbers.
            wanted: (T, 1) or (T, 3) like `profiles`; NaN matches anything.
            states: (T, S) wanted slow channels.
            allowed: (T, K) bool, the recordings that may be used in each frame; None for all.
            others: (T, P) `Pieces.recorded_frames` of the other parts, so that the parts do not
                together copy a recording; None if there are none.
        """
        n_frames = len(wanted)
        count = max(1, -(-(n_frames - self.overlap) // self.hop))
        missing = max(0, count * self.hop + self.overlap - n_frames)
        after = ((0, missing), (0, 0))
        asked = self._windows(np.pad(wanted, after, mode="edge"))[:: self.hop][:count]
        slow = self._means(np.pad(states, after, mode="edge"))[:: self.hop][:count]
        middle = np.minimum(np.arange(count) * self.hop + self.piece // 2, n_frames - 1)
        states = np.empty((count, min(BEAM, len(self.start))), int)
        before = np.empty_like(states)
        cost = np.zeros(states.shape[1], np.float32)
        used = np.zeros((states.shape[1], self.n_bins), np.float32)
        for first in range(0, count, _STEPS_AT_ONCE):
            part = slice(first, first + _STEPS_AT_ONCE)
            for n, distance in enumerate(self._distances(asked[part], slow[part]), first):
                if others is not None:
                    distance = distance + self.weights.copied * self._copied(others[n * self.hop :])
                if allowed is not None:
                    distance = np.where(allowed[middle[n]][self.recording], distance, np.inf)
                states[n], before[n], cost, used = self._step(
                    distance - self._chance(rng), states[n - 1] if n else None, cost, used
                )
        best = int(cost.argmin())
        chosen = np.empty(count, int)
        for n in reversed(range(count)):
            chosen[n] = states[n, best]
            best = before[n, best]
        return Pieces(self.recording[chosen], self.start[chosen], self.hop, self.overlap, n_frames)

    def following(
        self,
        rng: torch.Generator,
        wanted: np.ndarray,
        states: np.ndarray,
        used: np.ndarray,
        *,
        allowed: np.ndarray | None = None,
        others: np.ndarray | None = None,
        shown: int | None = None,
    ) -> int:
        """Return the start of the best piece for the next frames, without search beyond them.

        Args:
            rng: random numbers.
            wanted: (piece, 1) or (piece, 3) like `profiles`; NaN matches anything.
            states: (S,) wanted slow channels.
            used: (bins,) recent uses of each part of the recordings; the new one is added.
            allowed: (K,) bool, the recordings that may be used; None for all.
            others: (piece, P) as in `choose`.
            shown: frame that is shown now, numbered across all recordings; None at the beginning.
        """
        asked = (wanted * self.scale).astype(np.float32).T.reshape(1, -1)
        slow = ((states - self.usual_states) * self.of_states)[None]
        cost = self._distances(asked, slow)[0] - self._chance(rng)
        cost += self.weights.used * used[self.bins].mean(axis=0)
        if others is not None:
            cost += self.weights.copied * self._copied(others)
        if allowed is not None:
            cost = np.where(allowed[self.recording], cost, np.inf)
        if shown is not None:
            starts = np.arange(len(self.start))
            cost += self.weights.continuity * self._differences(np.array([shown]), starts)[0]
        best = int(cost.argmin())
        used *= _FORGETTING ** (self.hop / self.piece)
        np.add.at(used, self.bins[:, best], 0.5)  # both may be the same
        return best

    def _distances(self, asked: np.ndarray, slow: np.ndarray) -> np.ndarray:
        """Return the cost (N, S) of each start, apart from its neighbours and chance.

        Args:
            asked: (N, C * piece) wanted profiles, weighted; NaN matches anything.
            slow: (N, S) wanted slow channels, weighted.
        """
        known = ~np.isnan(asked)
        asked = np.where(known, asked, 0.0)
        return (
            np.square(asked).sum(axis=1)[:, None]
            - 2 * asked @ self.profiles.T
            + known @ self.squares.T
            + np.square(slow).sum(axis=1)[:, None]
            - 2 * slow @ self.states.T
            + self.squares_of_states
            + self.defects
        )

    def _copied(self, others: np.ndarray) -> np.ndarray:
        """Return the share (S,) of a piece in which all other parts show the same moment as it.

        It is given for each start. Moments are the same if they are at most an eighth of a piece
        apart. `others` (T, P) begin with the piece; after their end, nothing is copied.
        """
        others = others[: self.piece]
        # The start with which each frame of the piece would show what each other part does.
        starts = others - np.arange(len(others))[:, None]
        margin = self.piece / 8
        first = np.ceil(starts.max(axis=1) - margin).astype(int)
        after = np.floor(starts.min(axis=1) + margin).astype(int) + 1
        same = first < after
        counts = np.zeros(len(self.vectors) + 1)
        for edges, step in ((first, 1), (after, -1)):
            np.add.at(counts, np.clip(edges[same], 0, len(self.vectors)), step)
        return np.cumsum(counts)[self.frame] / self.piece

    def _step(
        self, distance: np.ndarray, last: np.ndarray | None, cost: np.ndarray, used: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Extend every sequence by a piece.

        Args:
            distance: (S,) cost of each start, beside the pieces before.
            last: (B,) starts of the last pieces; None at the first.
            cost: (B,) of each sequence so far.
            used: (B, bins) uses of each part of the recordings.

        Returns:
            New `last`, the sequence that each extends, and new `cost` and `used`.
        """
        size = len(cost)
        starts = np.argpartition(distance, size - 1)[:size]
        if last is not None:
            # Among hours of recordings, what continues a piece would seldom be one of the nearest.
            starts = np.union1d(starts, self._continuations(last))
        total = np.repeat(cost[:, None], len(starts), axis=1)
        if last is not None:
            after = self.frame[last] + self.hop
            total += self.weights.continuity * self._differences(after, starts)
            total += self.weights.used * used[:, self.bins[:, starts]].mean(axis=1)
        origin = total.argmin(axis=0)
        cost = total[origin, np.arange(len(starts))] + distance[starts]
        kept = np.argpartition(cost, size - 1)[:size]
        starts, origin, cost = starts[kept], origin[kept], cost[kept]
        used = _FORGETTING * used[origin]
        for bins in self.bins[:, starts]:
            used[np.arange(size), bins] += 0.5
        return starts, origin, cost, used

    def _continuations(self, last: np.ndarray) -> np.ndarray:
        """Return the starts at which the recordings continue after these pieces (B,)."""
        after = last + self.hop
        after, before = after[after < len(self.start)], last[after < len(self.start)]
        return after[self.recording[after] == self.recording[before]]

    def _differences(self, frames: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Return (B, B') the mean squared difference between recorded frames and pieces.

        `frames` (B,) follow the pieces before, numbered across all recordings.
        """
        if not self.overlap:
            return np.zeros((len(frames), len(starts)), np.float32)
        span = np.arange(self.overlap)
        after = np.minimum(frames[:, None] + span, len(self.vectors) - 1)
        ends = self.vectors[after].reshape(len(frames), -1)
        heads = self.vectors[self.frame[starts][:, None] + span].reshape(len(starts), -1)
        squares = np.square(ends).sum(axis=1)[:, None] + np.square(heads).sum(axis=1)
        return np.maximum(squares - 2 * ends @ heads.T, 0.0) / ends.shape[1]

    def _chance(self, rng: torch.Generator) -> np.ndarray:
        """Return Gumbel noise (S,)."""
        uniform = torch.rand(len(self.start), generator=rng, dtype=torch.float64).numpy()
        return self.weights.chance * -np.log(-np.log(np.clip(uniform, 1e-12, 1 - 1e-12)))
