"""Recall library: training recordings at one level, and the selection of pieces for given
speech."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

import audio_features as af
from gesturekit.multires.recall.parts import SPEED_FLOOR, MotionPart, PassiveChannels
from gesturekit.multires.recall.pieces import ChoiceWeights, Pieces, PieceSearch
from gesturekit.multires.recall.wanted import WantedMovement

_REST = 0.1
"""Speed below which a part of the body rests, m/s on the reference body."""
_REST_SECONDS = 0.08
"""Standard deviation of the Gaussian that smooths the change between rest and movement."""
_FURTHEST_SECONDS = 0.4
"""Pieces are shown at most this much earlier or later than they were chosen for."""
_CHANGE_OF_TEMPO = 0.1
"""Cost of a change to the next tempo, in squared standard deviations of movement."""
_TEMPOS = (-1, 0, 1)
"""Slower, as recorded, and faster: change of the offset from frame to frame, in grid steps."""
_FRAMES_AT_ONCE = 1024


@dataclass(frozen=True)
class RecalledRecording:
    """A training recording as it is recalled.

    Attributes:
        motion: (D, T_l) normalised motion vectors at the recalled level.
        passive: (X, T_l) of the library's `PassiveChannels`.
        profiles: (2 P, T_l) movement of each part and its slow part, in standard deviations.
        directions: (2, T_l) movement of the first arm's hand, see `hand_directions`, scaled by how
            well it predicts the second hand; (0, T_l) if the second arm is chosen independently.
        speaker: its speaker; None if the corpus names none.
        style: number of its style; 0 without styles.
        defective: (P, T_l) bool, the frames in which each part jumps or pops.
    """

    motion: Tensor
    passive: Tensor
    profiles: Tensor
    directions: Tensor
    speaker: str | None
    style: int
    defective: Tensor


@dataclass(frozen=True, eq=False)
class RecalledMotion:
    """The pieces of each part of the body, for one motion.

    Attributes:
        parts: of the body.
        pieces: of each part.
        lengths: frames of each recording at the recalled level.
    """

    parts: tuple[MotionPart, ...]
    pieces: tuple[Pieces, ...]
    lengths: tuple[int, ...]

    def vectors(self, motions: Sequence[Tensor], n_frames: int) -> Tensor:
        """Return the motion vectors (D, n_frames) of the pieces.

        `motions` are the vectors of all recordings, (D, T_k) at any rate.
        """
        return self.channels(motions, [part.columns for part in self.parts], n_frames)

    def channels(
        self,
        curves: Sequence[Tensor],
        columns: Sequence[np.ndarray],
        n_frames: int,
        part: slice = slice(None),
    ) -> Tensor:
        """Return other recorded channels (X, n_frames), each from the pieces of its body part.

        Args:
            curves: (X, T_k) of each recording, at any rate.
            columns: the channels of each part.
            n_frames: frames of the whole motion.
            part: frames of the result.
        """
        result = curves[0].new_zeros(len(curves[0]), len(range(n_frames)[part]))
        for own, pieces in zip(columns, self.pieces, strict=True):
            if len(own):
                chosen = [curve[own] for curve in curves]
                result[own] = pieces.blend(chosen, self.lengths, n_frames, part)
        return result


@dataclass(frozen=True, eq=False)
class RecallLibrary:
    """Training recordings at the recalled level, and the prediction of movement from speech.

    Attributes:
        level: that is recalled, counted from 1 (coarsest).
        levels: L, of the pyramid.
        fps: frames per second of the finest level.
        piece: length of a piece, seconds.
        overlap: length of the cross-fade between two pieces, seconds.
        parts: of the body, recalled separately.
        recordings: at least one.
        spread: (2,) standard deviation of movement and of its slow part, log m/s.
        mean: mean movement, log m/s.
        wanted: prediction of movement from speech; None for a model without speech input.
        passive: joints and face channels that are recalled but not modelled.
        stretch: largest fraction by which pieces of an arm are played faster or slower, so that
            they move at the predicted times; 0 plays them as recorded.
        weights: of the choice.
    """

    level: int
    levels: int
    fps: float
    piece: float
    overlap: float
    parts: tuple[MotionPart, ...]
    recordings: tuple[RecalledRecording, ...]
    spread: np.ndarray
    mean: float
    wanted: WantedMovement | None
    passive: PassiveChannels
    stretch: float
    weights: ChoiceWeights = ChoiceWeights()

    @cached_property
    def lengths(self) -> tuple[int, ...]:
        """Frames of each recording at the recalled level."""
        return tuple(recording.motion.shape[-1] for recording in self.recordings)

    @cached_property
    def level_fps(self) -> float:
        """Frames per second of the recalled level."""
        return self.fps * 0.75 ** (self.levels - self.level)

    @cached_property
    def searches(self) -> tuple[PieceSearch, ...]:
        """One search for each part."""
        return tuple(
            PieceSearch(
                [recording.motion[part.columns].T.numpy() for recording in self.recordings],
                [self._profile(recording, i).T.numpy() for recording in self.recordings],
                max(2, round(part.length * self.piece * self.level_fps)),
                max(1, round(part.length * self.overlap * self.level_fps)),
                # Longer pieces meet less often, so that each border counts for more.
                replace(self.weights, continuity=part.length * self.weights.continuity),
                [recording.defective[i].numpy() for recording in self.recordings],
            )
            for i, part in enumerate(self.parts)
        )

    def _profile(self, recording: RecalledRecording, i: int) -> Tensor:
        """Return the profile by which a part's pieces are chosen: its movement, and its slow part.

        For the second arm, it also has the movement of the first hand at the same time.
        """
        own = recording.profiles[2 * i : 2 * i + 2]
        return torch.cat([own, recording.directions]) if i == 1 else own

    def recall(
        self,
        speech: np.ndarray,
        rng_of: Callable[[str], torch.Generator],
        *,
        liveliness: float = 1.0,
        speaker: str | None = None,
        styles: np.ndarray | None = None,
    ) -> RecalledMotion:
        """Choose the pieces of a motion.

        Args:
            speech: (S, T) features at the finest level; S is 0 without speech input.
            rng_of: random generator of a part, by its name.
            liveliness: factor on the hand speed that is predicted from the speech.
            speaker: use only this speaker's recordings, if there are any; None for all recordings.
            styles: (T_l,) number of the style in each frame of the level; None for any.
        """
        n_frames = af.level_lengths(speech.shape[1], self.levels)[self.level - 1]
        profile = np.full((n_frames, 2), np.nan)
        if self.wanted is not None:
            asked = self.wanted(speech) + math.log(liveliness)
            profile = averaged((asked - self.mean) / self.spread[:, None], n_frames).T
        elif liveliness != 1.0:
            profile[:, 1] = math.log(liveliness) / self.spread[1]
        pieces: list[Pieces] = []
        for i, (part, search) in enumerate(zip(self.parts, self.searches, strict=True)):
            allowed = self._allowed(search.piece, n_frames, speaker, styles)
            wanted = profile
            if i == 1:
                directions = [recording.directions for recording in self.recordings]
                beside = pieces[0].blend(directions, self.lengths, n_frames)
                wanted = np.concatenate([profile, beside.T.numpy()], axis=1)
            others = None
            if pieces and not part.is_arm:
                others = np.stack([arm.recorded_frames(self.lengths) for arm in pieces], axis=1)
            chosen = search.choose_from_any_frame(rng_of(part.name), wanted, allowed, others)
            if self.stretch and part.is_arm and self.wanted is not None:
                chosen = self._stretched(chosen, i, wanted.T)
            pieces.append(chosen)
        return RecalledMotion(self.parts, tuple(pieces), self.lengths)

    def _stretched(self, pieces: Pieces, i: int, wanted: np.ndarray) -> Pieces:
        """Play an arm's pieces faster or slower, to match the profile `wanted` (C, T_l).

        They are matched by the profile with which they were chosen, without its slow part, which
        hardly changes.
        """
        counting = np.delete(np.arange(len(wanted)), 1)
        curves = [self._profile(recording, i)[counting] for recording in self.recordings]
        own = pieces.blend(curves, self.lengths, pieces.n_frames).double().numpy()
        scale = self.searches[i].scale[counting, None] / self.searches[i].scale[0]
        own, wanted = scale * own, scale * wanted[counting]
        return replace(pieces, offsets=time_offsets(own, wanted, self.level_fps, self.stretch))

    def detail(self, choice: RecalledMotion, n_frames: int) -> np.ndarray:
        """Return how much detail finer levels may add to each column, (D, n_frames), 0 to 1.

        It is 0 in the `calmed` columns of a part while its recalled pieces rest, so that rests are
        kept, and 1 while they move fast, and in all other columns.
        """
        rows = [np.array([2 * i, 2 * i + 1]) for i in range(len(self.parts))]
        curves = [recording.profiles for recording in self.recordings]
        profiles = choice.channels(curves, rows, n_frames).numpy()
        shares = np.ones((len(self.recordings[0].motion), n_frames), np.float32)
        for i, part in enumerate(self.parts):
            if len(part.calmed):
                speed = np.exp(profiles[2 * i] * self.spread[0] + self.mean) - SPEED_FLOOR
                share = np.clip((speed - _REST) / (part.full_detail - _REST), 0.0, 1.0)
                shares[part.calmed] = gaussian_filter1d(share, _REST_SECONDS * self.fps)
        return shares

    def _allowed(
        self, piece: int, n_frames: int, speaker: str | None, styles: np.ndarray | None
    ) -> np.ndarray | None:
        """Return (T, K) the recordings allowed for a piece at each frame; None for all.

        If no recording of the style is as long as a piece, all styles are allowed; then, if the
        speaker has none in that style, all speakers are allowed.
        """
        long_enough = np.array(self.lengths) >= piece
        allowed = np.ones((n_frames, len(self.recordings)), bool)
        wanted = []
        if styles is not None:
            own = np.array([recording.style for recording in self.recordings])
            wanted.append(own == np.asarray(styles)[:, None])
        if speaker is not None:
            wanted.append(np.array([recording.speaker == speaker for recording in self.recordings]))
        for recordings in wanted:
            narrower = allowed & recordings
            some = (narrower & long_enough).any(axis=1)
            allowed[some] = narrower[some]
        return None if allowed.all() else allowed


def averaged(curves: np.ndarray, n_frames: int) -> np.ndarray:
    """Return curves (C, T) averaged over each of `n_frames` equal parts of their duration."""
    total = np.concatenate([np.zeros((len(curves), 1)), np.cumsum(curves, axis=1)], axis=1)
    edges = np.linspace(0, curves.shape[1], n_frames + 1)
    at = np.arange(curves.shape[1] + 1)
    rows = np.array([np.interp(edges, at, row) for row in total]).reshape(len(curves), len(edges))
    return np.diff(rows) / np.diff(edges)


def time_offsets(own: np.ndarray, asked: np.ndarray, fps: float, stretch: float) -> np.ndarray:
    """Return the offsets with which recalled movement is closest to the movement predicted from
    speech.

    Dynamic time warping with three tempos: as recorded, and `stretch` faster and slower. The
    offsets are those with the lowest sum of squared differences and costs of changes of tempo.
    Recorded speeds are compared as they are, whatever the tempo: the aim is to move at other times,
    not faster.

    Args:
        own: (C, T) profile of the pieces: their movement, in standard deviations, and any other
            curves to be aligned.
        asked: (C, T) profile predicted from speech.
        fps: frames per second of both.
        stretch: fraction by which pieces may be played faster or slower, above 0.

    Returns:
        (T,) frames: frame t shows the pieces at t plus this offset.
    """
    n_frames, furthest = own.shape[1], int(_FURTHEST_SECONDS * fps / stretch)
    offsets = stretch * np.arange(-furthest, furthest + 1)
    steps = np.subtract.outer(_TEMPOS, _TEMPOS)
    changes = _CHANGE_OF_TEMPO * np.square(steps)[:, :, None]
    cost = np.zeros((len(_TEMPOS), len(offsets)))  # of the best path to each tempo and offset
    before = np.zeros((n_frames, *cost.shape), np.int8)  # the tempo that it had until then
    for t, difference in enumerate(_differences(own, asked, offsets)):
        if t:
            # The first axis is the tempo until this frame, the second the one that leads to it.
            totals = cost[:, None] + changes
            before[t] = _moved(totals.argmin(axis=0), 0)
            cost = _moved(totals.min(axis=0), np.inf)
        cost = cost + difference
    tempo, offset = np.unravel_index(cost.argmin(), cost.shape)
    path = np.empty(n_frames, int)
    for t in reversed(range(n_frames)):
        path[t] = offset
        tempo, offset = before[t, tempo, offset], offset - _TEMPOS[tempo]
    return offsets[path]


def _differences(own: np.ndarray, asked: np.ndarray, offsets: np.ndarray) -> Iterator[np.ndarray]:
    """Yield, for each frame, the squared differences (O,) at all offsets."""
    frames = np.arange(own.shape[1])
    for start in range(0, len(frames), _FRAMES_AT_ONCE):
        part = slice(start, start + _FRAMES_AT_ONCE)
        times = frames[part, None] + offsets
        rows = zip(own, asked, strict=True)
        yield from sum(
            np.square(np.interp(times, frames, curve) - goal[part, None]) for curve, goal in rows
        )


def _moved(rows: np.ndarray, outside: float) -> np.ndarray:
    """Return each tempo's row (3, O) one frame later, at the offsets that it has led to."""
    moved = np.full_like(rows, outside)
    for row, result, step in zip(rows, moved, _TEMPOS, strict=True):
        n = len(row) - abs(step)
        result[max(0, step) :][:n] = row[max(0, -step) :][:n]
    return moved
