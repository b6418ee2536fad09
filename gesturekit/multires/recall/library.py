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
from gesturekit.multires.recall.parts import (
    SPEED_FLOOR,
    MotionPart,
    PassiveChannels,
    slow_rows,
)
from gesturekit.multires.recall.pieces import ChoiceWeights, Pieces, PieceSearch
from gesturekit.multires.recall.slow_state import SlowState
from gesturekit.state.ahead import AheadPrediction
from gesturekit.state.prediction import WantedMovement, slow_part
from gesturekit.state.process import recorded_quantiles, recorded_values

_REST = 0.1
"""Speed below which a part of the body rests, m/s on the reference body."""
_REST_SECONDS = 0.08
"""Standard deviation of the Gaussian that smooths the change between rest and movement."""
_FURTHEST_SECONDS = 0.4
"""Pieces are shown at most this much earlier or later than they were chosen for."""
_CHANGE_OF_TEMPO = 0.1
"""Cost of a change to the next tempo, in squared standard deviations of movement."""
_COPIED_ARM = 0.25
"""Factor on `ChoiceWeights.copied` for the second arm."""
_SHRINKAGE = 0.5
"""Shrinkage of the second hand's directions, see `PieceSearch`."""
_TRUNK_CONTINUITY = 3.0
"""Factor on `ChoiceWeights.continuity` for the trunk and legs: feet slide where stances differ."""
_CLEAR = 0.5
"""Correlation from which `ChoiceWeights.movement` has its full weight. A choice among many pieces
follows any prediction more closely than it deserves, a weak one most of all."""
LEAST_R = 0.2
"""Least correlation by which predicted movement is divided, so that its peaks are as large as those
of the pieces that are stretched to match it."""
_TEMPOS = (-1, 0, 1)
"""Slower, as recorded, and faster: change of the offset from frame to frame, in grid steps."""
_FRAMES_AT_ONCE = 1024


@dataclass(frozen=True)
class RecalledRecording:
    """A training recording as it is recalled.

    Attributes:
        motion: (D, T_l) normalised motion vectors at the recalled level.
        passive: (X, T_l) of the library's `PassiveChannels`.
        profiles: (P, T_l) movement of each part, in standard deviations.
        states: (S, T_l) slow channels of all parts, see `slow_states`.
        directions: (4, T_l) directions of both hands, see `hand_directions`, weighted by their
            correlation; (0, T_l) without arms.
        speaker: its speaker; None if the corpus names none.
        style: number of its style; 0 without styles.
        defective: (P, T_l) bool, the frames in which each part jumps or pops.
    """

    motion: Tensor
    passive: Tensor
    profiles: Tensor
    states: Tensor
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

    def profiles(self, recordings: Sequence[RecalledRecording], n_frames: int) -> np.ndarray:
        """Return the movement (P, n_frames) of the pieces of each part."""
        rows = [np.array([i]) for i in range(len(self.parts))]
        curves = [recording.profiles for recording in recordings]
        return self.channels(curves, rows, n_frames).numpy()

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
        spread: standard deviation of movement, log m/s.
        mean: mean movement, log m/s.
        slow_state: process from which the slow channels of a motion are drawn.
        wanted: prediction of movement from speech; None for a model without speech input.
        passive: joints and face channels that are recalled but not modelled.
        stretch: largest fraction by which pieces of an arm are played faster or slower, so that
            they move at the predicted times; 0 plays them as recorded.
        weights: of the choice.
        ahead: predictions for live speech, by look-ahead; none in a model that cannot stream.
    """

    level: int
    levels: int
    fps: float
    piece: float
    overlap: float
    parts: tuple[MotionPart, ...]
    recordings: tuple[RecalledRecording, ...]
    spread: float
    mean: float
    slow_state: SlowState
    wanted: WantedMovement | None
    passive: PassiveChannels
    stretch: float
    weights: ChoiceWeights = ChoiceWeights()
    ahead: tuple[AheadPrediction, ...] = ()

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
        return self.searches_of(self.piece, self.overlap, self.weights)

    def searches_of(
        self, piece: float, overlap: float, weights: ChoiceWeights
    ) -> tuple[PieceSearch, ...]:
        """Return a search for each part, with pieces and cross-fades of these seconds."""
        return tuple(
            PieceSearch(
                [recording.motion[part.columns].T.numpy() for recording in self.recordings],
                [profile.T.numpy() for profile in self._profiles[i]],
                [recording.states[rows].T.numpy() for recording in self.recordings],
                max(2, round(part.length * piece * self.level_fps)),
                max(1, round(part.length * overlap * self.level_fps)),
                (self._r**2, *[_SHRINKAGE] * 2)[: 3 if i == 1 else 1],
                # Longer pieces meet less often, so that each border counts for more.
                replace(
                    weights,
                    movement=weights.movement * min(1.0, self._r / _CLEAR),
                    continuity=part.length
                    * weights.continuity
                    * (1 if part.is_arm else _TRUNK_CONTINUITY),
                    copied=weights.copied * (_COPIED_ARM if part.is_arm else 1),
                ),
                [recording.defective[i].numpy() for recording in self.recordings],
            )
            for i, (part, rows) in enumerate(zip(self.parts, self.rows, strict=True))
        )

    @property
    def _r(self) -> float:
        """Correlation of fast movement with its prediction from speech; 0 if it is negative."""
        return 0.0 if self.wanted is None else max(self.wanted.fast.r, 0.0)

    @cached_property
    def rows(self) -> tuple[slice, ...]:
        """Rows of each part in `RecalledRecording.states`."""
        return slow_rows(self.parts)

    @cached_property
    def _profiles(self) -> tuple[list[Tensor], ...]:
        """Profiles (C, T_k) of each part by which its pieces are chosen: its fast movement.

        The slow movement is among the slow channels. For the second arm, the profile also has the
        directions of its hand.
        """
        profiles = tuple(map(list, self.fast_movement))
        for k, recording in enumerate(self.recordings):
            if len(profiles) > 1:
                profiles[1][k] = torch.cat([profiles[1][k], recording.directions[2:]])
        return profiles

    @cached_property
    def fast_movement(self) -> tuple[list[Tensor], ...]:
        """Fast movement (1, T_k) of each part, in standard deviations of movement."""
        fast = [
            recording.profiles
            - torch.from_numpy(slow_part(recording.profiles.numpy(), self.level_fps))
            for recording in self.recordings
        ]
        return tuple([own[i : i + 1] for own in fast] for i in range(len(self.parts)))

    @cached_property
    def _quantiles(self) -> dict[bytes, np.ndarray]:
        """Quantiles (S, Q) of all slow channels, by the recordings that are used."""
        return {}

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
            rng_of: random generator of the choice for each part, by its name, and of the slow
                state, by the name mood.
            liveliness: factor on the hand speed that is drawn.
            speaker: use only this speaker's recordings, if there are any; None for all recordings.
            styles: (T_l,) number of the style in each frame of the level; None for any.
        """
        n_frames = af.level_lengths(speech.shape[1], self.levels)[self.level - 1]
        fast, predicted = np.full(n_frames, np.nan), None
        if self.wanted is not None:
            fast, predicted = averaged(np.stack(self.wanted(speech)), n_frames)
        scores = self.slow_state.draw(rng_of("mood"), n_frames, self.level_fps, predicted)
        fast = fast / self.spread
        pieces: list[Pieces] = []
        for i, (part, search) in enumerate(zip(self.parts, self.searches, strict=True)):
            allowed = self.allowed(search.piece, n_frames, speaker, styles)
            states = self.drawn_states(scores, i, allowed)
            states[:, 0] += math.log(liveliness)
            wanted = fast[:, None]
            others = first = None
            if i == 1:
                first = pieces[0].first
                directions = [recording.directions[:2] for recording in self.recordings]
                beside = pieces[0].blend(directions, self.lengths, n_frames)
                wanted = np.concatenate([wanted, beside.T.numpy()], axis=1)
            if pieces:
                others = np.stack([arm.recorded_frames(self.lengths) for arm in pieces], axis=1)
            pieces.append(
                search.choose_from_any_frame(
                    rng_of(part.name), wanted, states, allowed, others, first=first
                )
            )
            if i == 1 and self.stretch and self._r:
                pieces = self._stretched(pieces, fast)
        return RecalledMotion(self.parts, tuple(pieces), self.lengths)

    def drawn_states(self, scores: np.ndarray, i: int, allowed: np.ndarray | None) -> np.ndarray:
        """Return the slow channels (T_l, S) of a part: recorded values of the drawn scores.

        Values are those of the recordings that are `allowed` (T_l, K) in each frame.
        """
        rows = self.rows[i]
        scores = scores[rows]
        if allowed is None:
            every = np.ones(len(self.recordings), bool)
            return recorded_values(scores, self._quantiles_of(every)[rows]).T
        result = np.empty_like(scores)
        for own in np.unique(allowed, axis=0):
            here = (allowed == own).all(axis=1)
            result[:, here] = recorded_values(scores[:, here], self._quantiles_of(own)[rows])
        return result.T

    def _quantiles_of(self, used: np.ndarray) -> np.ndarray:
        """Return the quantiles (S, Q) of the slow channels of the recordings `used` (K,) bool."""
        key = used.tobytes()
        if key not in self._quantiles:
            pairs = zip(self.recordings, used, strict=True)
            recorded = [recording.states.numpy() for recording, own in pairs if own]
            self._quantiles[key] = recorded_quantiles(recorded)
        return self._quantiles[key]

    def _stretched(self, pieces: Sequence[Pieces], fast: np.ndarray) -> list[Pieces]:
        """Play the pieces of both arms faster or slower, to match predicted fast movement (T_l,).

        Both arms have the same tempo, so that two-handed gestures stay together.
        """
        own = []
        for i, arm in enumerate(pieces):
            curves = [profile[:1] for profile in self._profiles[i]]
            own.append(arm.blend(curves, self.lengths, arm.n_frames).double().numpy())
        # A conditional mean has the right times, but smaller peaks than the pieces have.
        assert self.wanted is not None
        goals = np.stack([fast / max(self.wanted.fast.r, LEAST_R)] * len(own))
        offsets = time_offsets(np.concatenate(own), goals, self.level_fps, self.stretch)
        return [replace(arm, offsets=offsets) for arm in pieces]

    def detail(self, profiles: np.ndarray) -> np.ndarray:
        """Return how much detail finer levels may add to each column, (D, T), 0 to 1.

        It is 0 in the `calmed` columns of a part while its recalled pieces rest, so that rests are
        kept, and 1 while they move fast, and in all other columns. `profiles` (P, T) are those of
        the pieces, see `RecalledMotion.profiles`.
        """
        shares = np.ones((len(self.recordings[0].motion), profiles.shape[1]), np.float32)
        for i, part in enumerate(self.parts):
            if len(part.calmed):
                speed = np.exp(profiles[i] * self.spread + self.mean) - SPEED_FLOOR
                share = np.clip((speed - _REST) / (part.full_detail - _REST), 0.0, 1.0)
                shares[part.calmed] = gaussian_filter1d(share, _REST_SECONDS * self.fps)
        return shares

    def allowed(
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
