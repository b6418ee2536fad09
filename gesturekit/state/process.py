"""Random process from which the state of movement is drawn, fitted to the training recordings.

Speech tells little of the state, so a mean of what speakers do would be calmer and narrower than
any of them. The state is drawn, for each motion anew (a Gaussian copula):

- Each channel has standard normal scores, by rank among the recordings of the same speaker and
  style; fast channels by rank among the frames with speech, or among those without. A drawn score
  becomes the recorded value of the same rank, so that drawn values are distributed as recorded
  ones, however skewed those are.
- A score is the part that speech predicts, plus noise with the rest of the variance, correlated
  between channels as in the recordings. Noise of slow channels has a component that changes from
  take to take and one that changes within a take; noise of fast channels has the recorded spectrum.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr, ndtri
from scipy.stats import rankdata

from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.state.channels import CARRIERS, SPEED_FLOOR, StateChannels
from gesturekit.state.live import AheadPrediction
from gesturekit.state.noise import (
    STEP,
    STEPS_OF_TAKE,
    filtered,
    gaussian,
    mixing,
    share_between_takes,
    spectral_kernels,
    within_takes,
)
from gesturekit.state.prediction import WantedMovement, correlation

_SHARES = (np.arange(201) + 0.5) / 201
"""Shares of the quantiles between which recorded values are interpolated."""
_VOICE_SECONDS, _PAUSE_SECONDS = 0.1, 0.5
"""Smoothing of voice activity, and of the pauses in which slow predictions are trusted in full."""
_LEAST_SECONDS = 5.0
"""Seconds of silence, and of speech, from which both have distributions of their own."""
_FURTHEST = 3.0
"""Predictions of fast movement are limited to this many standard deviations."""
_MOST_EXPLAINED = 0.95
_RESPONSE = (np.arange(41) + 0.5) / 41
"""Shares of the quantiles at which a network's response is measured."""
_DAMPING, _LEAST_FOLLOWED = 0.8, 0.6
_HIGHEST = 2.0
"""Standard deviations above the mean to which it is limited where hands are held and how wide they
move: a hand that is held as high as ever, and moves as wide as ever, would leave its range."""
_USUAL_SPEEDS = 2.0
"""Unit of the speeds that a network gets: this times the usual speed of the hand."""
_RELATIVE_FLOOR = 0.02
"""Added to speeds, m/s, where fast movement is relative to slow movement, see `_relative`."""
_STROKE, _STROKE_POINTS = 0.15, 4
"""Metres that a hand moves while its carrier changes by its correlation length, and the points of
white noise in it."""

Group = tuple[str | None, int | None]
"""Speaker and number of the style; None for any."""


@dataclass(frozen=True, eq=False)
class RecordedState:
    """State of a training recording.

    Attributes:
        values: (C, T) channels.
        speech: (S, T) features; S is 0 without speech input.
        take: its recording session.
        group: its speaker and style.
    """

    values: np.ndarray
    speech: np.ndarray
    take: str
    group: Group


@dataclass(frozen=True, eq=False)
class StateProcess:
    """Random process of the C channels, F of them fast.

    Attributes:
        channels: of the rig.
        fps: frames per second.
        wanted: prediction from speech; None without.
        silence: (S,) features of silence; S is 0 without speech input.
        mean: (C,) of the recordings.
        scale: (C,) their standard deviation.
        explained: (C,) correlation of the scores with their prediction.
        usual: mean of the fast prediction in silence and in speech, and its deviation from them.
        mixing: (C, C) Cholesky factor of the noise's correlation between channels.
        between: (C - F,) share of the variance of slow noise between takes.
        width: (C - F,) smoothness of slow noise within takes, seconds, see `_WIDTHS`.
        take: smoothness of slow noise between takes, seconds.
        kernel: (F, 2 R + 1) filters of fast noise.
        quantiles: {speaker and style: (2, C, Q) recorded values in silence and in speech}.
        response: (2, C, P) values of each channel, ascending, and those that a network needs to be
            given so that its motion shows them.
        followed: (C,) correlation of what a network's motion shows with what it was given.
        ahead: predictions for live speech.
    """

    channels: StateChannels
    fps: float
    wanted: WantedMovement | None
    silence: np.ndarray
    mean: np.ndarray
    scale: np.ndarray
    explained: np.ndarray
    usual: np.ndarray
    mixing: np.ndarray
    between: np.ndarray
    width: np.ndarray
    take: float
    kernel: np.ndarray
    quantiles: Mapping[Group, np.ndarray]
    response: np.ndarray
    followed: np.ndarray
    ahead: tuple[AheadPrediction, ...] = ()

    @classmethod
    def fit(
        cls,
        channels: StateChannels,
        recordings: Sequence[RecordedState],
        fps: float,
        conditioner: SpeechConditioner | None,
    ) -> StateProcess:
        """Fit to the recordings.

        Args:
            channels: of the rig.
            recordings: at least one.
            fps: frames per second.
            conditioner: of the speech features; None without speech input.
        """
        fast, values = channels.fast, [recording.values for recording in recordings]
        silence = np.empty(0) if conditioner is None else conditioner.silence(1)[0].astype(float)
        voices = [_voices(channels, each.speech, silence, fps) for each in recordings]
        voiced = _voiced(voices, fps)
        groups = [recording.group for recording in recordings]
        relative = [_relative(channels, curves) for curves in values]
        scores = _scores(relative, voiced, groups)
        wanted, usual, explained, noise = _explained(
            channels, recordings, scores, voiced, fps, conditioner
        )
        ends = np.cumsum([curves.shape[1] for curves in values])[:-1]
        parts = np.split(noise / np.maximum(noise.std(axis=1, keepdims=True), 1e-6), ends, axis=1)
        takes = len({recording.take for recording in recordings})
        within, width = within_takes([curves[~fast] for curves in parts], fps)
        pooled = np.concatenate(values, axis=1)
        return cls(
            channels=channels,
            fps=fps,
            wanted=wanted,
            silence=silence,
            mean=pooled.mean(axis=1),
            scale=np.maximum(pooled.std(axis=1), 1e-3),
            explained=explained,
            usual=usual,
            mixing=mixing(np.concatenate(parts, axis=1), fast),
            between=share_between_takes(within, takes),
            width=width,
            take=max(pooled.shape[1] / fps / takes, STEP),
            kernel=spectral_kernels([curves[fast] for curves in parts], fps),
            quantiles=_quantiles(relative, voiced, groups),
            response=np.repeat(np.quantile(pooled, _RESPONSE, axis=1).T[None], 2, axis=0),
            followed=np.ones(len(fast)),
        )

    def calibrated(self, wanted: np.ndarray, shown: np.ndarray) -> StateProcess:
        """Return the process of a network that was asked for `wanted` and shows `shown`, (C, T).

        A network moves a little where it should rest. Asked for less, it shows what was wanted.
        Only speeds are asked for so: a hand that is asked to move wider also moves faster.
        """
        asked, answers = (np.quantile(rows, _RESPONSE, axis=1).T for rows in (wanted, shown))
        values, given = self.response
        more = [np.interp(*row) for row in zip(values, asked, asked - answers)]
        of_speed = (self.channels.movement | self.channels.fast)[:, None]
        given = np.maximum.accumulate(given + _DAMPING * of_speed * np.array(more), axis=1)
        followed = [correlation(*rows) for rows in zip(wanted, shown)]
        return replace(
            self,
            response=np.stack([values, given]),
            followed=np.clip(followed, _LEAST_FOLLOWED, 1.0),
        )

    def draw(
        self,
        seed: int,
        speech: np.ndarray,
        group: Group = (None, None),
        *,
        first: int = 0,
        liveliness: float = 1.0,
    ) -> np.ndarray:
        """Draw the channels (C, T) of frames `first` to `first + T - 1` of a motion.

        Args:
            seed: of the noise.
            speech: (S, T) features of these frames.
            group: speaker and style; all recordings stand for a pair that there is not.
            first: number of the first frame; below 0 before the motion begins.
            liveliness: factor on the speed of slow movement.
        """
        noise = self.noise(seed, first + np.arange(speech.shape[1]))
        predicted = None if self.wanted is None else self.wanted(speech)
        return self.values(
            noise, self.voices(speech), predicted, group=group, liveliness=liveliness
        )

    def voices(self, speech: np.ndarray) -> np.ndarray:
        """Return (C, T) the voice activity that each channel depends on, from features (S, T)."""
        return _voices(self.channels, speech, self.silence, self.fps)

    def with_voice(self, values: np.ndarray, speech: np.ndarray) -> np.ndarray:
        """Return channels (C, T) and the voice activity of features (S, T), (C + 1, T)."""
        return np.concatenate([values, voice_activity(speech, self.silence, self.fps)[None]])

    def scores(self, values: np.ndarray, speech: np.ndarray) -> np.ndarray:
        """Return normal scores of channels (C, T), by rank among the recordings.

        `speech` is (S, T), as ranks in silence are others than those in speech.
        """
        values = _relative(self.channels, values)
        quiet, loud = (
            [np.interp(*row) for row in zip(values, quantiles, repeat(_SHARES))]
            for quantiles in self.quantiles[None, None]
        )
        return ndtri(np.where(self.voices(speech) > 0.5, loud, quiet))

    def values(
        self,
        noise: np.ndarray,
        voices: np.ndarray,
        predicted: tuple[np.ndarray, np.ndarray] | None,
        *,
        group: Group = (None, None),
        liveliness: float = 1.0,
        known: float | np.ndarray = 1.0,
    ) -> np.ndarray:
        """Return the channels (C, T) of noise.

        Args:
            noise: (C, T), see `noise`.
            voices: (C, T), see `voices`.
            predicted: fast and slow movement (T,), see `WantedMovement`; None without.
            group: speaker and style.
            liveliness: factor on the speed of slow movement.
            known: (T,) factor on the correlation of fast movement with its prediction.
        """
        scores = noise
        if predicted is not None:
            explained, means = self._predicted(*predicted, voices[np.argmax(self.channels.fast)])
            explained = explained * np.where(self.channels.fast[:, None], known, 1.0)
            scores = explained * means + np.sqrt(1 - explained**2) * scores
        quantiles = self.quantiles.get(group, self.quantiles[None, None])
        ranks = ndtr(scores)
        # The recorded value of the same rank for each score.
        quiet, loud = (
            np.stack([np.interp(*row) for row in zip(ranks, repeat(_SHARES), rows)])
            for rows in quantiles
        )
        values = _absolute(self.channels, quiet + voices * (loud - quiet))
        values[self.channels.movement] += math.log(liveliness)
        return values

    def _predicted(
        self, when: np.ndarray, slow: np.ndarray, voice: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how much predictions count, and the predictions in standard deviations, (C, T)."""
        assert self.wanted is not None
        quiet, loud, size = self.usual
        when = when / max(self.wanted.spread, 1e-9) - quiet - (loud - quiet) * voice
        when = np.clip(when / size, -_FURTHEST, _FURTHEST)
        is_fast = self.channels.fast[:, None]
        # What the network does not follow is lost from the correlation with speech.
        fast = np.minimum(self.explained / self.followed, _MOST_EXPLAINED)
        counts = np.where(is_fast, fast[:, None], self.explained[:, None] * self.wanted.trust)
        return counts, np.where(is_fast, when, slow)

    def noise(self, seed: int, frames: np.ndarray) -> np.ndarray:
        """Return the noise (C, N) at frames (N,)."""
        fast, result = self.channels.fast, np.empty((len(self.mixing), len(frames)))
        seconds = (frames + 0.5) / self.fps
        slow = self.mixing[np.ix_(~fast, ~fast)]
        kernels = [gaussian(width / STEP, self.width.max() / STEP) for width in self.width]
        within = filtered(seed, slow, kernels, seconds / STEP)
        kernels = [gaussian(STEPS_OF_TAKE, STEPS_OF_TAKE)] * len(slow)
        take = filtered(seed + 1, slow, kernels, seconds * (STEPS_OF_TAKE / self.take))
        share = self.between[:, None]
        result[~fast] = np.sqrt(share) * take + np.sqrt(1 - share) * within
        together = self.mixing[np.ix_(fast, fast)]
        result[fast] = filtered(seed + 2, together, list(self.kernel), frames.astype(float))
        return result

    def clocks(self, values: np.ndarray) -> np.ndarray:
        """Return (H, T) by how much each hand's clock goes on in each frame of channels (C, T).

        A clock goes as fast as its hand moves, and stands still while the hand rests.
        """
        return self._speeds(values) * (_STROKE_POINTS / _STROKE / self.fps)

    def _speeds(self, values: np.ndarray) -> np.ndarray:
        """Return the speeds of the hands (H, T), m/s, of channels (C, T)."""
        movement = values[self.channels.of_hands] + values[self.channels.fast]
        return np.maximum(np.exp(movement) - SPEED_FLOOR, 0.0)

    def carriers(self, seed: int, clocks: np.ndarray) -> np.ndarray:
        """Return four carriers for each hand, (4 H, T): smooth noise in the time of its movement.

        With them a network can turn the state into strokes: it cannot integrate a speed.

        Args:
            seed: of the noise.
            clocks: (H, T) times of the hands' clocks.
        """
        kernels = [gaussian(_STROKE_POINTS / 2, _STROKE_POINTS / 2)] * CARRIERS
        noise = [
            filtered(seed + 3 + k, np.eye(CARRIERS), kernels, clock)
            for k, clock in enumerate(clocks)
        ]
        # Uniform, as arms have limits: rare large values would lift them out of their range.
        return math.sqrt(12.0) * (ndtr(np.concatenate(noise)) - 0.5)

    def condition(
        self, seed: int, values: np.ndarray, clocks: np.ndarray | None = None
    ) -> np.ndarray:
        """Return what a network gets, (C + H + 4 H, T) float32.

        These are the normalised channels, the hands' speeds and the carriers. Channels have the
        logarithm of speed, but a motion is in proportion to the speed itself.

        Args:
            seed: of the carriers.
            values: (C, T) channels.
            clocks: (H, T) times of the hands' clocks; None if they begin with the first frame.
        """
        if clocks is None:
            clocks = np.cumsum(self.clocks(values), axis=1)
        usual = np.exp(self.mean[self.channels.of_hands])[:, None]
        speeds = self._speeds(self._asked(values)) / (_USUAL_SPEEDS * usual)
        rows = self.given(values, clocks), speeds, self.carriers(seed, clocks)
        return np.concatenate(rows).astype(np.float32)

    def given(self, values: np.ndarray, clocks: np.ndarray | None = None) -> np.ndarray:
        """Return the normalised channels (C, T) of `condition`, without speeds and carriers."""
        if clocks is None:
            clocks = np.cumsum(self.clocks(values), axis=1)
        given = self._asked(values)
        for rows, clock in zip(self.channels.held, clocks):
            given[rows] = [_in_time_of(row, clock) for row in given[rows]]
        normalised = (given - self.mean[:, None]) / self.scale[:, None]
        held = ~(self.channels.movement | self.channels.fast)
        normalised[held] = np.minimum(normalised[held], _HIGHEST)
        return normalised

    def _asked(self, values: np.ndarray) -> np.ndarray:
        """Return the channels (C, T) that a network needs to be given to show these."""
        return np.stack([_continued(*row) for row in zip(values, *self.response)])


def _relative(channels: StateChannels, values: np.ndarray) -> np.ndarray:
    """Return channels (C, T) with fast movement that is alike at rest and in movement.

    The logarithm of a speed plus its floor hardly varies at rest. With a smaller floor it does.
    """
    result, slow = values.copy(), values[channels.of_hands]
    speeds = (np.exp(row) - SPEED_FLOOR for row in (slow + values[channels.fast], slow))
    fast, usual = (np.log(np.maximum(speed, 0.0) + _RELATIVE_FLOOR) for speed in speeds)
    result[channels.fast] = fast - usual
    return result


def _absolute(channels: StateChannels, values: np.ndarray) -> np.ndarray:
    """Return the inverse (C, T) of `_relative`."""
    result, slow = values.copy(), values[channels.of_hands]
    usual = np.maximum(np.exp(slow) - SPEED_FLOOR, 0.0) + _RELATIVE_FLOOR
    speed = np.maximum(usual * np.exp(values[channels.fast]) - _RELATIVE_FLOOR, 0.0)
    result[channels.fast] = np.log(speed + SPEED_FLOOR) - slow
    return result


def _in_time_of(values: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """Return values (T,) smoothed in the time of a clock (T,): they stand still where it does."""
    points = np.arange(math.floor(clock[0]), math.ceil(clock[-1]) + 1.0)
    smooth = gaussian_filter1d(np.interp(points, clock, values), _STROKE_POINTS / 2, mode="nearest")
    return np.interp(clock, points, smooth)


def _continued(values: np.ndarray, at: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """Return the curve through (at, curve) at values (T,), piecewise linear; ends have slope 1."""
    beyond = np.minimum(values - at[0], 0.0) + np.maximum(values - at[-1], 0.0)
    return np.interp(values, at, curve) + beyond


def voice_activity(speech: np.ndarray, silence: np.ndarray, fps: float) -> np.ndarray:
    """Return (T,) 1 where features (S, T) are as usual, 0 where they are those of silence (S,).

    Normalised features are about 0 in speech.
    """
    size = float(silence @ silence)
    if size < 1e-6:
        return np.ones(speech.shape[1])
    away = np.clip(1 - silence @ speech / size, 0.0, 1.0)
    smooth = gaussian_filter1d(away, _VOICE_SECONDS * fps, mode="nearest")
    return np.clip(2 * smooth - 0.5, 0.0, 1.0)


def _voices(
    channels: StateChannels, speech: np.ndarray, silence: np.ndarray, fps: float
) -> np.ndarray:
    """Return (C, T) the voice activity that the distribution of each channel depends on.

    Fast channels follow it at once, slow movement over pauses, and other channels not at all.
    """
    voice = voice_activity(speech, silence, fps)
    paused = gaussian_filter1d(voice, _PAUSE_SECONDS * fps, mode="nearest")
    result = np.ones((len(channels.names), len(voice)))
    result[channels.fast] = voice
    result[channels.movement] = np.clip(2 * paused - 0.5, 0.0, 1.0)
    return result


def _voiced(voices: Sequence[np.ndarray], fps: float) -> list[np.ndarray]:
    """Return (C, T_k) bool, True in speech; everywhere where there is little speech or silence."""
    active = np.concatenate(voices, axis=1) > 0.5
    count = active.sum(axis=1)
    known = np.minimum(count, active.shape[1] - count) >= _LEAST_SECONDS * fps
    return [(voice > 0.5) | ~known[:, None] for voice in voices]


def _explained(
    channels: StateChannels,
    recordings: Sequence[RecordedState],
    scores: Sequence[np.ndarray],
    voiced: Sequence[np.ndarray],
    fps: float,
    conditioner: SpeechConditioner | None,
) -> tuple[WantedMovement | None, np.ndarray, np.ndarray, np.ndarray]:
    """Return `wanted`, `usual` and `explained` of a process, and the rest of the scores, (C, T)."""
    fast, noise = channels.fast, np.concatenate(scores, axis=1)
    usual, explained = np.array([0.0, 0.0, 1.0]), np.zeros(len(fast))
    if conditioner is None:
        return None, usual, explained, noise
    wanted = WantedMovement.fit(
        [recording.speech for recording in recordings],
        [recording.values[fast].mean(axis=0) for recording in recordings],
        [curves[channels.of_hands].mean(axis=0) for curves in scores],
        fps,
        conditioner.effort,
        (conditioner.acoustic, conditioner.prosody),
        takes=[recording.take for recording in recordings],
    )
    if not wanted.predicts:
        return None, usual, explained, noise
    in_speech = np.concatenate([flags[np.argmax(fast)] for flags in voiced])
    usual, predicted = _predictions(wanted, in_speech)
    rows = predicted[fast.astype(int)]  # of each channel
    explained = np.clip((noise * rows).mean(axis=1), -_MOST_EXPLAINED, _MOST_EXPLAINED)
    # A hand that moves less where more was predicted is chance.
    explained[fast] = np.maximum(explained[fast], 0.0)
    trust = np.where(fast, 1.0, wanted.trust)
    return wanted, usual, explained, noise - (explained * trust)[:, None] * rows


def _predictions(wanted: WantedMovement, voiced: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `StateProcess.usual`, and the predictions of left-out slow and fast movement, (2, T).

    `voiced` is (T,) bool, True in speech.
    """
    assert wanted.fast.left_out is not None and wanted.slow.left_out is not None
    when = wanted.fast.left_out
    loud = when[voiced].mean()
    quiet = loud if voiced.all() else when[~voiced].mean()
    when = when - np.where(voiced, loud, quiet)
    size = max(when.std(), 1e-6)
    return np.array([quiet, loud, size]), np.stack([wanted.slow.left_out, when / size])


def _scores(
    curves: Sequence[np.ndarray], classes: Sequence[np.ndarray], groups: Sequence[object]
) -> list[np.ndarray]:
    """Return standard normal scores of curves (C, T_k), by rank in each channel.

    Ranks are those among the frames of the same class (C, T_k), bool, of the same group.
    """
    result = [np.empty(curve.shape) for curve in curves]
    for group in dict.fromkeys(groups):
        members = [k for k, other in enumerate(groups) if other == group]
        pooled = np.concatenate([curves[k] for k in members], axis=1)
        flags = np.concatenate([classes[k] for k in members], axis=1)
        scores = np.empty(pooled.shape)
        for row, values, flag in zip(scores, pooled, flags, strict=True):
            for frames in (flag, ~flag):
                if frames.any():
                    row[frames] = ndtri((rankdata(values[frames]) - 0.5) / frames.sum())
        edges = np.cumsum([curves[k].shape[1] for k in members])[:-1]
        for k, rows in zip(members, np.split(scores, edges, axis=1), strict=True):
            result[k] = rows
    return result


def _quantiles(
    values: Sequence[np.ndarray], voiced: Sequence[np.ndarray], groups: Sequence[Group]
) -> dict[Group, np.ndarray]:
    """Return `StateProcess.quantiles` of values and voice activity (C, T_k)."""
    asked: list[Group] = [(None, None)]
    for speaker, style in groups:
        asked += [(speaker, None), (None, style), (speaker, style)]
    result = {}
    for group in dict.fromkeys(asked):
        members = [
            k
            for k, other in enumerate(groups)
            if all(name in (None, theirs) for name, theirs in zip(group, other, strict=True))
        ]
        pooled = np.concatenate([values[k] for k in members], axis=1)
        loud = np.concatenate([voiced[k] for k in members], axis=1)
        rows = [
            [np.quantile(curve[frames if frames.any() else ~frames], _SHARES) for frames in classes]
            for curve, *classes in zip(pooled, ~loud, loud)
        ]
        result[group] = np.stack(rows, axis=1)
    return result
