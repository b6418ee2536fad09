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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr, ndtri
from scipy.stats import rankdata
from torch import Tensor

from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.errors import FormatError, ModelError
from gesturekit.state.channels import CARRIERS, SPEED_FLOOR, StateChannels
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
from gesturekit.state.prediction import (
    AheadPrediction,
    FeatureWindow,
    Regression,
    WantedMovement,
    correlation,
)

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
        fast, groups = channels.fast, [recording.group for recording in recordings]
        lengths = [recording.values.shape[1] for recording in recordings]
        silence = np.empty(0) if conditioner is None else conditioner.silence(1)[0].astype(float)
        voices = [_voices(channels, each.speech, silence, fps) for each in recordings]
        active = np.concatenate(voices, axis=1) > 0.5
        # Where there is little speech or silence, all counts as speech.
        count = active.sum(axis=1)
        known = np.minimum(count, active.shape[1] - count) >= _LEAST_SECONDS * fps
        voiced = active | ~known[:, None]
        values = np.concatenate([each.values for each in recordings], axis=1)
        relative = np.concatenate([_relative(channels, each.values) for each in recordings], axis=1)
        scores = _scores(relative, voiced, np.repeat([*map(groups.index, groups)], lengths))
        wanted, usual, explained, noise = _explained(
            channels, recordings, scores, voiced, fps, conditioner
        )
        noise = noise / np.maximum(noise.std(axis=1, keepdims=True), 1e-6)
        parts = np.split(noise, np.cumsum(lengths)[:-1], axis=1)
        takes = len({recording.take for recording in recordings})
        within, width = within_takes([curves[~fast] for curves in parts], fps)
        return cls(
            channels=channels,
            fps=fps,
            wanted=wanted,
            silence=silence,
            mean=values.mean(axis=1),
            scale=np.maximum(values.std(axis=1), 1e-3),
            explained=explained,
            usual=usual,
            mixing=mixing(noise, fast),
            between=share_between_takes(within, takes),
            width=width,
            take=max(values.shape[1] / fps / takes, STEP),
            kernel=spectral_kernels([curves[fast] for curves in parts], fps),
            quantiles=_quantiles(relative, voiced, groups, lengths),
            response=np.repeat(np.quantile(values, _RESPONSE, axis=1).T[None], 2, axis=0),
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
        scores, is_fast = noise, self.channels.fast[:, None]
        if predicted is not None:
            assert self.wanted is not None
            (when, slow), (quiet, loud, size) = predicted, self.usual
            voice = voices[np.argmax(is_fast)]
            when = when / max(self.wanted.spread, 1e-9) - quiet - (loud - quiet) * voice
            when = np.clip(when / size, -_FURTHEST, _FURTHEST)
            # What the network does not follow is lost from the correlation with speech.
            fast = np.minimum(self.explained / self.followed, _MOST_EXPLAINED)[:, None] * known
            trusted = self.explained[:, None] * self.wanted.trust
            explained = np.where(is_fast, fast, trusted)
            scores = explained * np.where(is_fast, when, slow) + np.sqrt(1 - explained**2) * noise
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
            points = np.arange(math.floor(clock[0]), math.ceil(clock[-1]) + 1.0)
            for row in rows:  # smoothed in the time of the clock: still where it stands still
                curve, width = np.interp(points, clock, given[row]), _STROKE_POINTS / 2
                smooth = gaussian_filter1d(curve, width, mode="nearest")
                given[row] = np.interp(clock, points, smooth)
        normalised = (given - self.mean[:, None]) / self.scale[:, None]
        held = ~(self.channels.movement | self.channels.fast)
        normalised[held] = np.minimum(normalised[held], _HIGHEST)
        return normalised

    def _asked(self, values: np.ndarray) -> np.ndarray:
        """Return the channels (C, T) that a network needs to be given to show these."""
        curves = []
        for row, at, curve in zip(values, *self.response):  # piecewise linear; ends have slope 1
            beyond = np.minimum(row - at[0], 0.0) + np.maximum(row - at[-1], 0.0)
            curves.append(np.interp(row, at, curve) + beyond)
        return np.stack(curves)


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


def _explained(
    channels: StateChannels,
    recordings: Sequence[RecordedState],
    scores: np.ndarray,
    voiced: np.ndarray,
    fps: float,
    conditioner: SpeechConditioner | None,
) -> tuple[WantedMovement | None, np.ndarray, np.ndarray, np.ndarray]:
    """Return `wanted`, `usual` and `explained` of a process, and the rest of the scores, (C, T)."""
    fast = channels.fast
    usual, explained = np.array([0.0, 0.0, 1.0]), np.zeros(len(fast))
    if conditioner is None:
        return None, usual, explained, scores
    ends = np.cumsum([recording.values.shape[1] for recording in recordings])[:-1]
    wanted = WantedMovement.fit(
        [recording.speech for recording in recordings],
        [recording.values[fast].mean(axis=0) for recording in recordings],
        np.split(scores[channels.of_hands].mean(axis=0), ends),
        fps,
        conditioner.effort,
        (conditioner.acoustic, conditioner.prosody),
        takes=[recording.take for recording in recordings],
    )
    if not wanted.predicts:
        return None, usual, explained, scores
    when, in_speech = wanted.fast.left_out, voiced[np.argmax(fast)]
    assert when is not None and wanted.slow.left_out is not None
    loud = when[in_speech].mean()
    quiet = loud if in_speech.all() else when[~in_speech].mean()
    when = when - np.where(in_speech, loud, quiet)
    size = max(when.std(), 1e-6)
    rows = np.stack([wanted.slow.left_out, when / size])[fast.astype(int)]  # of each channel
    explained = np.clip((scores * rows).mean(axis=1), -_MOST_EXPLAINED, _MOST_EXPLAINED)
    # A hand that moves less where more was predicted is chance.
    explained[fast] = np.maximum(explained[fast], 0.0)
    trust = np.where(fast, 1.0, wanted.trust)
    noise = scores - (explained * trust)[:, None] * rows
    return wanted, np.array([quiet, loud, size]), explained, noise


def _scores(values: np.ndarray, voiced: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Return standard normal scores of values (C, T), by rank in each channel.

    Ranks are those among the frames with speech, or without, (C, T) bool, of the same group (T,).
    """
    scores = np.empty(values.shape)
    for group in np.unique(groups):
        for row, curve, loud in zip(scores, values, voiced):
            for frames in (loud & (groups == group), ~loud & (groups == group)):
                if frames.any():
                    row[frames] = ndtri((rankdata(curve[frames]) - 0.5) / frames.sum())
    return scores


def _quantiles(
    values: np.ndarray, voiced: np.ndarray, groups: Sequence[Group], lengths: Sequence[int]
) -> dict[Group, np.ndarray]:
    """Return `StateProcess.quantiles` of values and voice activity (C, T)."""
    asked: list[Group] = [(None, None)]
    for speaker, style in groups:
        asked += [(speaker, None), (None, style), (speaker, style)]
    result = {}
    for group in dict.fromkeys(asked):
        members = [all(g in (None, of) for g, of in zip(group, other)) for other in groups]
        chosen, rows = np.repeat(members, lengths), []
        for curve, loud in zip(values[:, chosen], voiced[:, chosen]):
            classes = (frames if frames.any() else ~frames for frames in (~loud, loud))
            rows.append([np.quantile(curve[frames], _SHARES) for frames in classes])
        result[group] = np.stack(rows, axis=1)
    return result


def mood_seed(seed: int, controls: Mapping[str, Any]) -> int:
    """Return the seed of the drawn state of movement: the control of that name, or `seed`."""
    return seed if controls["mood_seed"] is None else int(controls["mood_seed"])


def given_state(process: StateProcess, state: str | Path | np.ndarray, n_frames: int) -> np.ndarray:
    """Return a state (T, C) of a process, cut to a motion of T frames or held to its end.

    Args:
        process: of the model.
        state: (frames, C), or a .npy file of it.
        n_frames: T.

    Raises:
        ModelError: a state of another width, empty, or not finite.
        FormatError: its file cannot be read.
    """
    if not isinstance(state, np.ndarray):
        try:
            state = np.load(state, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise FormatError(
                f"{state}: not a .npy file of numbers, as numpy.save writes model.state"
            ) from error
    wanted, shape = len(process.channels.names), state.shape
    is_right = state.dtype.kind in "fiu" and len(shape) == 2 and shape[0] and shape[1] == wanted
    state = state[:n_frames].astype(float) if is_right else state
    if not is_right or not np.isfinite(state).all():
        raise ModelError(
            f"state: {state.dtype} of shape {shape}, not (frames, {wanted}) finite numbers; as "
            "model.state returns it"
        )
    return np.pad(state, ((0, max(0, n_frames - len(state))), (0, 0)), mode="edge")[:n_frames]


_WIDEST = (-1e6, 1e6)
_ARRAYS: dict[str, tuple[str, float, float]] = {
    "silence": ("S", *_WIDEST),
    "mean": ("C", *_WIDEST),
    "scale": ("C", 1e-6, 1e6),
    "explained": ("C", -1, 1),
    "usual": ("3", *_WIDEST),
    "mixing": ("C C", -2, 2),
    "between": ("C-F", 0, 1),
    "width": ("C-F", 0.1, 100),
    "kernel": ("F R", -2, 2),
    "quantiles": ("G 2 C Q", *_WIDEST),
    "response": ("2 C P", *_WIDEST),
    "followed": ("C", 0.1, 1),
}
"""Shape, least and largest value of the tensors of a process."""
_FACTORS = {"mean_counts": ("", 0, 1), "spread": ("", 0, 1e4)}
_TAKE = (0.1, 1e7)  # seconds; a single take may have hours
_MOST_POINTS = 1000  # of a filter, and of quantiles
_OF_REGRESSION = ("mean", "weights", "offset", "r")


def state_values(process: StateProcess) -> dict[str, Any]:
    """Return the plain values of a process."""
    about, wanted = None, process.wanted
    if wanted is not None:
        about = {"effort": list(wanted.effort), "mean_counts": wanted.mean_counts}
        about |= {"spread": wanted.spread, "across_takes": wanted.across_takes}
    return {
        "channels": list(process.channels.names),
        "take": process.take,
        "groups": [list(group) for group in process.quantiles],
        "wanted": about,
        "ahead": [
            {
                "look_ahead": prediction.look_ahead,
                "fast_columns": prediction.fast_columns.tolist(),
                "slow_columns": prediction.slow_columns.tolist(),
            }
            for prediction in process.ahead
        ],
    }


def state_tensors(process: StateProcess) -> dict[str, Tensor]:
    """Return the tensors of a process by name."""
    arrays = {name: getattr(process, name) for name in _ARRAYS}
    arrays["quantiles"] = np.stack(list(process.quantiles.values()))
    if process.wanted is not None:
        arrays |= {
            name: getattr(process.wanted, name) for name in ("fast_basis", "slow_basis", "voices")
        }
    predictions = {f"ahead.{i}.": each for i, each in enumerate(process.ahead)}
    for where, prediction in {"": process.wanted, **predictions}.items():
        for part in ("fast", "slow") if prediction else ():
            regression = getattr(prediction, part)
            arrays |= {f"{where}{part}.{n}": getattr(regression, n) for n in _OF_REGRESSION}
    return {f"state.{name}": torch.from_numpy(np.array(a, float)) for name, a in arrays.items()}


def load_state(
    values: Mapping[str, Any] | None,
    tensors: Mapping[str, Tensor],
    channels: StateChannels,
    fps: float,
    speech_size: int,
) -> StateProcess | None:
    """Read what `state_values` and `state_tensors` wrote; None for a model without a state.

    Args:
        values: of config.yaml.
        tensors: of the folder.
        channels: of the model's rig.
        fps: frames per second.
        speech_size: S, the number of speech features.

    Raises KeyError, IndexError or ValueError for values out of range, or tensors whose shapes do
    not fit the model.
    """
    if values is None:
        return None
    groups = [
        (None if speaker is None else str(speaker), None if style is None else int(style))
        for speaker, style in values["groups"]
    ]
    arrays = {name: tensors[f"state.{name}"].double().numpy() for name in _ARRAYS}
    n, n_fast = len(channels.names), int(channels.fast.sum())
    sizes = {"S": speech_size, "C": n, "F": n_fast, "C-F": n - n_fast, "G": len(groups)}
    for size, name in {"R": "kernel", "Q": "quantiles", "P": "response"}.items():
        sizes[size] = min(arrays[name].shape[-1], _MOST_POINTS)
    _check(arrays, _ARRAYS, sizes)
    if tuple(values["channels"]) != channels.names:
        raise ValueError(f"state: the rig has the channels {', '.join(channels.names)}")
    wanted, ahead = _load_predictions(values, tensors, fps, speech_size)
    process = StateProcess(
        channels=channels,
        fps=fps,
        wanted=wanted,
        take=float(np.clip(values["take"], *_TAKE)),
        quantiles=dict(zip(groups, arrays.pop("quantiles"), strict=True)),
        **arrays,
        ahead=ahead,
    )
    process.draw(0, np.zeros((speech_size, 2), np.float32))  # fails where something does not fit
    return process


def _load_predictions(
    values: Mapping[str, Any], tensors: Mapping[str, Tensor], fps: float, speech_size: int
) -> tuple[WantedMovement | None, tuple[AheadPrediction, ...]]:
    """Return the predictions from whole speech and from live speech."""
    about, ahead = values["wanted"], []
    if about is None:
        return None, ()

    def regressions(where: str) -> Iterator[Regression]:
        for part in ("fast", "slow"):
            names = (f"state.{where}{part}.{name}" for name in _OF_REGRESSION)
            mean, weights, offset, r = (tensors[name].numpy() for name in names)
            yield Regression(mean, weights, float(offset), float(r))

    factors = {name: float(about[name]) for name in _FACTORS}
    _check(factors, _FACTORS, {})
    fast, slow = regressions("")
    wanted = WantedMovement(
        fps=fps,
        effort=tuple(map(int, about["effort"])),
        fast_basis=tensors["state.fast_basis"].numpy(),
        slow_basis=tensors["state.slow_basis"].numpy(),
        fast=fast,
        slow=slow,
        mean_counts=factors["mean_counts"],
        spread=factors["spread"],
        across_takes=bool(about["across_takes"]),
        voices=tensors["state.voices"].numpy(),
    )
    window = FeatureWindow(np.zeros((round(fps) + 1, speech_size)), np.zeros((2, speech_size)))
    for i, row in enumerate(values["ahead"]):
        look_ahead = min(1.0, max(0.0, float(row["look_ahead"])))
        columns = [np.array(row[f"{part}_columns"], int) for part in ("fast", "slow")]
        fast, slow = regressions(f"ahead.{i}.")
        ahead.append(AheadPrediction(look_ahead, columns[0], columns[1], fast, slow))
        ahead[i](window, wanted)  # fails where something does not fit
    return wanted, tuple(ahead)


def _check(
    arrays: Mapping[str, Any],
    known: Mapping[str, tuple[str, float, float]],
    sizes: Mapping[str, int],
) -> None:
    """Raise ValueError for arrays of other shapes, or with values out of range."""
    for name, (axes, low, high) in known.items():
        shape = np.shape(array := arrays[name])
        wanted = tuple(int(sizes.get(axis, axis)) for axis in axes.split())
        if shape != wanted or not np.all((low <= array) & (array <= high)):
            raise ValueError(
                f"state.{name} has the shape {shape}; expected {wanted} and values from {low:g} to "
                f"{high:g}"
            )
