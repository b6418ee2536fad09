"""Inputs of models on motion frames: speech features, normalised for any speaker, and styles."""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import ThreadpoolController

import audio_features as af
from audio_features.track import Method
from audio_features.wave import stands_for_sound
from audio_features.words import takes_words
from gesturekit.errors import ModelError
from gesturekit.motion.motion import Motion

log = logging.getLogger(__name__)

LIMIT = 6.0
"""Normalised features are kept within this many standard deviations."""

_PRIOR_SECONDS = 1.0
"""Weight of the training mean when a clip's own mean is estimated, in seconds of speech."""

Normalisation = Literal["clip", "corpus", "none"]
"""clip: level the speech and centre features clip by clip. corpus: zero mean and unit variance over
all training frames (Alexanderson et al. 2023, A.1). none: leave level and features as they are."""

Speech = str | Path | af.Wave | ArrayLike
"""A sound file, a `Wave`, or samples as `Wave.from_array` takes them."""

RawFeatures = tuple[np.ndarray, np.ndarray]
"""Result of `extract`: features (T, S), not normalised, and speech activity (T,), bool."""

_ACTIVITY_HOP = 0.01
"""Seconds between frames of the speech activity."""

_LONGEST_SECONDS = 86_400.0
"""Limit for motion without speech, so that a typing error cannot exhaust the memory."""

BLEND_SECONDS = 1.0
"""Length of the transition from one style to the next, centred on the border."""

_SPAN = re.compile(r"(?P<name>.+)@(?P<start>\d+(\.\d+)?)-(?P<end>\d+(\.\d+)?)")

_FRAMES_AT_ONCE = 4096  # normalised, so that an hour of wide features is in memory once


_libraries = cache(ThreadpoolController)


def one_blas_thread() -> AbstractContextManager[object]:
    """Limit numpy's matrix products to one thread, within a `with` block.

    Their last bits depend on the number of threads, and with it all motion made of them.
    """
    return _libraries().limit(limits=1, user_api="blas")


@dataclass(frozen=True, eq=False)
class SpeechConditioner:
    """Extracts features, puts them on motion frames by true time, and normalises them.

    By default each clip is centred on the mean of its own active speech. This maps a new voice,
    microphone and room to the mean of the training voices. The scale is the standard deviation in
    training, so that monotonous speech stays monotonous and silence stays silent. The training
    mean replaces the clip's own where the clip holds little or no speech, and always in columns
    whose mean carries information (those that the extractor's `centred` leaves out).

    Attributes:
        extractor: an extractor of `audio_features`.
        fps: frames per second of the motion.
        align: interpolation to the motion frames, see `FeatureTrack.to_rate`.
        centre: (S,) mean of active speech in training.
        scale: (S,) standard deviation of centred active speech in training.
        normalisation: one of `Normalisation`.
        components: (W, N) projection of the W `wide` columns to N components, which follow the
            other columns; None for all columns as they are.
        vad: voice activity detection: sound without voice is replaced by silence before features
            are extracted, in training and in generation (`audio_features.speech_only`).
    """

    extractor: Any
    fps: float
    align: Method
    centre: np.ndarray
    scale: np.ndarray
    normalisation: Normalisation = "clip"
    components: np.ndarray | None = None
    vad: bool = True

    @classmethod
    def fit(
        cls,
        clips: Iterable[RawFeatures],
        extractor: Any,
        fps: float,
        align: Method,
        normalisation: Normalisation = "clip",
    ) -> SpeechConditioner:
        """Learn centre and scale from training speech, paired and unpaired alike.

        Args:
            clips: the result of `extract` for each clip.
            extractor: the extractor that made them.
            fps: frames per second of the motion.
            align: see `FeatureTrack.to_rate`.
            normalisation: one of `Normalisation`.
        """
        about, dim = (extractor, fps, align), extractor.dim
        if normalisation == "none":
            return cls(*about, np.zeros(dim), np.ones(dim), normalisation)
        if normalisation == "corpus":
            values = np.concatenate([values for values, _ in clips]).astype(np.float64)
            spread = np.maximum(values.std(axis=0), 1e-3)
            return cls(*about, values.mean(axis=0), spread, normalisation)
        each = (values[active].astype(np.float64) for values, active in clips)
        moments = [(s.mean(axis=0), s.var(axis=0) * len(s), len(s)) for s in each if len(s)]
        if not moments:
            return cls(*about, np.zeros(dim), np.ones(dim))
        centres, spreads, frames = zip(*moments, strict=True)
        within = np.sum(spreads, axis=0) / np.sum(frames)
        between = np.where(extractor.centred, 0.0, np.var(centres, axis=0))
        scale = np.maximum(np.sqrt(within + between), 1e-3)
        return cls(*about, np.mean(centres, axis=0), scale)

    @property
    def dim(self) -> int:
        """S, the number of features."""
        wide, count = (0, 0) if self.components is None else self.components.shape
        return self.extractor.dim - wide + count

    @property
    def takes_words(self) -> bool:
        """True if the features include the words beside a recording."""
        return takes_words(self.extractor)

    @property
    def files(self) -> tuple[af.Files, ...]:
        """Extractors that read the files of own features."""
        return tuple(part for part in parts_of(self.extractor) if isinstance(part, af.Files))

    @property
    def effort(self) -> tuple[int, ...]:
        """Columns of vocal effort (`af.Effort`); empty without that extractor."""
        return tuple(i for i, name in enumerate(self._names) if name.startswith("effort_"))

    @property
    def prosody(self) -> tuple[int, ...]:
        """Columns of `af.Prosody` and `af.ProsodicRange`; empty without these extractors."""
        prosodic = {*af.Prosody().names, *af.ProsodicRange().names}
        return tuple(i for i, name in enumerate(self._names) if name in prosodic)

    @property
    def acoustic(self) -> tuple[int, ...]:
        """Columns that are not components."""
        return tuple(range(len(self._names)))

    @property
    def _names(self) -> tuple[str, ...]:
        """Names of the columns that are not components."""
        names = np.array(self.extractor.names)
        if self.components is not None:
            names = names[~wide_columns(self.extractor, self.components.shape[1])]
        return tuple(names)

    def reduced(self, clips: Iterable[RawFeatures], count: int) -> SpeechConditioner:
        """Return a conditioner with the wide features reduced to `count` principal components.

        The components are those of the normalised training speech. One factor scales all of them
        to a mean variance of 1, so that distances keep their proportions. `wide_columns` tells
        which features are wide.

        Args:
            clips: the result of `extract` for each clip.
            count: N.
        """
        wide = wide_columns(self.extractor, count)
        if not wide.any():
            return self
        second, total, frames = np.zeros((wide.sum(), wide.sum())), np.zeros(wide.sum()), 0
        with one_blas_thread():
            for clip in clips:
                values = self.normalise(*clip)[:, wide].astype(np.float64)
                second += values.T @ values
                total += values.sum(axis=0)
                frames += len(values)
            mean = total / max(frames, 1)
            variances, axes = np.linalg.eigh(second / max(frames, 1) - np.outer(mean, mean))
        kept = np.maximum(variances[: -count - 1 : -1], 0.0)
        axes = axes[:, : -count - 1 : -1]
        # The sign of an axis is arbitrary: the largest weight is positive.
        axes *= np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(count)])
        share = kept.sum() / max(np.maximum(variances, 0.0).sum(), 1e-12)
        log.info(
            "%d of %d speech features reduced to %d components with %.0f%% of their variance.",
            *(wide.sum(), self.extractor.dim, count, 100 * share),
        )
        projection = axes / max(np.sqrt(kept.mean()), 1e-3)
        return replace(self, components=np.ascontiguousarray(projection, np.float32))

    def __call__(
        self, wave: af.Wave, n_frames: int | None = None, vad: bool | None = None
    ) -> np.ndarray:
        """Return (T, S) float32 normalised features; warn if the sound has no speech.

        Args:
            wave: the sound.
            n_frames: T; by default from the length of the sound.
            vad: whether to replace sound without voice by silence; by default as in training.
        """
        name, vad = wave.source or "the speech", self.vad if vad is None else vad
        is_features = stands_for_sound(name)
        if is_features and len(self.files) < len(parts_of(self.extractor)):
            raise ModelError(f"{name}: features, but this model computes its own: give the sound")
        with one_blas_thread():
            speech = af.speech_only(wave) if vad else wave
        if wave.is_silent and not is_features:
            log.warning("%s: silent; the motion will be idle", name)
        elif speech.is_silent and not wave.is_silent:
            text = "no voice found: the motion will be idle; vad=False (--no-vad) follows it"
            log.warning("%s: %s", name, text)
        level = self.normalisation == "clip"
        with one_blas_thread():
            features = extract(speech, self.extractor, self.fps, self.align, n_frames, level=level)
        return self.normalise(*features)

    def normalise(self, values: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Normalise the result of `extract`, and reduce wide features to their components.

        Args:
            values: (T, D), the extractor's columns.
            active: (T,) speech activity.

        Returns:
            (T, S) float32.
        """
        total = values[active].sum(axis=0, dtype=np.float64)
        return self.scaled(values, self.clip_centre(total, active.sum()))

    def clip_centre(self, total: ArrayLike, count: float) -> np.ndarray:
        """Return the centre (D,) of a clip.

        Args:
            total: (D,) sum of the features over its active frames.
            count: number of these frames.
        """
        if self.normalisation != "clip":
            return self.centre
        prior = _PRIOR_SECONDS * self.fps
        centre = (np.asarray(total) + prior * self.centre) / (count + prior)
        return np.where(self.extractor.centred, centre, self.centre)

    def scaled(self, values: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Normalise features (T, D) of a clip with this centre (D,); return (T, S) float32."""
        limit = LIMIT if self.normalisation == "clip" else np.inf
        normalised = np.empty((len(values), self.dim), np.float32)
        for start in range(0, len(values), _FRAMES_AT_ONCE):
            frames = slice(start, start + _FRAMES_AT_ONCE)
            columns = np.clip((values[frames] - centre) / self.scale, -limit, limit)
            if self.components is not None:
                wide = wide_columns(self.extractor, self.components.shape[1])
                with one_blas_thread():
                    parts = [columns[:, ~wide], columns[:, wide] @ self.components]
                columns = np.concatenate(parts, axis=1)
            normalised[frames] = columns
        return normalised

    def silence(self, n_frames: int) -> np.ndarray:
        """Return the normalised features of silence, (T, S) float32."""
        rate, seconds = 16000, max(1.0, n_frames / self.fps)
        nothing = af.Wave(np.zeros(int(np.ceil(seconds * rate)), np.float32), rate)
        with one_blas_thread():
            values, active = extract(nothing, self.extractor, self.fps, self.align, n_frames)
        # Features from files are unknown for silence: the mean of training stands for them.
        parts = parts_of(self.extractor)
        unknown = np.repeat([part in self.files for part in parts], [part.dim for part in parts])
        values[:, unknown] = self.centre[unknown]
        return self.normalise(values, active)


def detects_voice(extractor: Any, vad: bool | None) -> bool:
    """Return `vad`, or if it is None, True unless the features are those of music (`af.Music`)."""
    is_music = any(isinstance(part, af.Music) for part in parts_of(extractor))
    return not is_music if vad is None else vad


def parts_of(extractor: Any) -> tuple[Any, ...]:
    """Return the extractors of a stack, or the extractor alone."""
    return extractor.parts if isinstance(extractor, af.Stack) else (extractor,)


def wide_columns(extractor: Any, count: int) -> np.ndarray:
    """Return D flags, true for columns of the extractors in a stack that have more than `count`.

    Vocal effort is never wide: the state of movement needs its columns.
    """
    parts = parts_of(extractor)
    wide = [part.dim > count and not isinstance(part, af.Effort) for part in parts]
    return np.repeat(wide, [part.dim for part in parts])


def extract(
    wave: af.Wave,
    extractor: Any,
    fps: float,
    align: Method,
    n_frames: int | None = None,
    *,
    level: bool = True,
) -> RawFeatures:
    """Return features (T, S) float32 on motion frames and speech activity (T,), bool.

    Normalises the loudness first (`Wave.at_level`) unless `level` is False.
    """
    n_frames = wave.n_frames(fps) if n_frames is None else n_frames
    track = af.cache_from_environment().extract(extractor, wave.at_level() if level else wave)
    values = track.to_rate(fps, n_frames=n_frames, method=align).values
    activity = wave.active()
    nearest = np.round(np.arange(n_frames) / fps / _ACTIVITY_HOP).astype(int)
    return values, activity[np.minimum(nearest, len(activity) - 1)]


def as_speech(speech: Any, sample_rate: int | None) -> str | Path | af.Wave | None:
    """Return the speech given to a model, with an array of samples as a `Wave`; reads no file.

    Args:
        speech: a `Speech`: a file, a `Wave`, samples (N,) or (N, channels), (samples, rate in Hz),
            or None.
        sample_rate: Hz; only with an array.

    Raises:
        ModelError: several sounds, a rate with speech that has its own, or without speech.
        AudioError: an array without rate, or one that is not sound.
    """
    is_pair = isinstance(speech, tuple) and len(speech) == 2 and np.ndim(speech[1]) == 0
    if is_pair and np.ndim(speech[0]) > 0 and sample_rate is None:
        speech, sample_rate = speech
    files, problem = (str, os.PathLike, af.Wave), ""
    kinds = (*files, np.ndarray)
    if isinstance(speech, list | tuple) and any(isinstance(each, kinds) for each in speech):
        ways = "call generate for each, or gesturekit.render for all"
        problem = f"speech is a list of {len(speech)} sounds: {ways}"
    elif speech is not None and not isinstance(speech, files):
        return af.Wave.from_array(speech, sample_rate, "speech")
    elif sample_rate is not None:
        reason = "no speech is given" if speech is None else "a file or a Wave has its own rate"
        problem = f"sample_rate={sample_rate!r} is only for an array of samples: {reason}"
    if problem:
        raise ModelError(problem)
    return speech


def to_output_rate(
    motion: Motion, fps: float, wave: af.Wave | None, seconds: float | None
) -> Motion:
    """Resample generated motion to `fps`, with the frame count of its request.

    The count is the duration of the sound, `seconds` or, without both, of the motion, times `fps`,
    rounded.
    """
    if fps == motion.fps:
        return motion
    if seconds is not None:
        return motion.resample(fps, max(1, int(np.floor(seconds * fps + 0.5))))
    return motion.resample(fps, None if wave is None else max(1, wave.n_frames(fps)))


def speech_features(
    conditioner: SpeechConditioner | None,
    speech: str | Path | af.Wave | None,
    seconds: float | None,
    fps: float,
    vad: bool | None = None,
) -> np.ndarray:
    """Return the speech features (T, S) float32 of a request; S is 0 without speech input.

    Args:
        conditioner: the model's; None for a model without speech input.
        speech: an audio file or a `Wave`; None for silence lasting `seconds`.
        seconds: length without speech.
        fps: frames per second of the motion.
        vad: see `Controls.vad`.

    Raises:
        ModelError: speech for a model without speech input, neither speech nor seconds or both,
            less than a frame, or more than a day without speech.
        AudioError: the speech cannot be read.
    """
    if speech is not None:
        if conditioner is None or seconds is not None:
            problem = "speech: this model takes no speech; give seconds instead (--seconds)"
            both = "seconds cannot be combined with speech, which sets the length"
            raise ModelError(problem if conditioner is None else both)
        wave = speech if isinstance(speech, af.Wave) else af.Wave.load(speech)
        name, n_frames = wave.source or "the speech", wave.n_frames(fps)
        for repair in wave.repairs:
            log.warning("%s: %s", name, repair)
        if n_frames < 1:
            short = f"{wave.duration:.3f} s is shorter than half a frame at {fps:g} fps"
            raise ModelError(f"{name}: {short}")
        return conditioner(wave, n_frames, vad)
    if seconds is None:
        wanted = "seconds" if conditioner is None else "speech, or seconds for idle motion"
        raise ModelError(f"nothing to generate from: give {wanted}")
    if isinstance(seconds, str) or not 0.5 / fps <= seconds <= _LONGEST_SECONDS:
        ends = f"{1 / fps:g} s (a frame) to {_LONGEST_SECONDS:g} s (a day)"
        raise ModelError(f"seconds={seconds!r}: give {ends}")
    n_frames = int(np.floor(seconds * fps + 0.5))
    nothing = np.zeros((n_frames, 0), np.float32)
    return nothing if conditioner is None else conditioner.silence(n_frames)


def style_track(names: Sequence[str], wanted: str, n_frames: int, fps: float) -> np.ndarray:
    """Return (T, K) float32 weights of the styles over time; each row adds up to 1.

    A style is one-hot over the style names of a corpus. It may change over time, with blends.

    Args:
        names: the K styles.
        wanted: one of them, or spans of seconds: `old@0-10,angry@10-20`. Outside all spans the
            nearest one applies; overlapping spans have equal weights.
        n_frames: T.
        fps: frames per second.

    Raises:
        ModelError: an unknown style, or a span that cannot be read.
    """
    track = np.zeros((n_frames, len(names)), np.float32)
    if "@" not in wanted:
        track[:, style_number(names, wanted)] = 1.0
        return track
    time = np.arange(n_frames) / fps
    apart, numbers = [], []
    for text in map(str.strip, wanted.split(",")):
        match = _SPAN.fullmatch(text)
        if match is None or float(match["end"]) <= float(match["start"]):
            raise ModelError(f"style {text!r}: spans look like old@0-10,angry@10-20")
        start, end = float(match["start"]), float(match["end"])
        numbers.append(style_number(names, match["name"]))
        apart.append(np.maximum(np.maximum(start - time, time - end + 0.5 / fps), 0.0))
    holds = np.stack(apart) <= np.min(apart, axis=0) + 1e-6
    for number, now in zip(numbers, holds, strict=True):
        track[:, number] += now
    track /= track.sum(axis=1, keepdims=True)
    # A running mean of this length turns every border into a linear ramp.
    reach = math.floor(BLEND_SECONDS * fps / 2)
    around = np.pad(track, ((reach, reach), (0, 0)), mode="reflect")
    return np.lib.stride_tricks.sliding_window_view(around, 2 * reach + 1, axis=0).mean(axis=-1)


def style_number(names: Sequence[str], name: str) -> int:
    """Return the index of a style.

    Raises:
        ModelError: an unknown style.
    """
    if name not in names:
        raise ModelError(f"style {name!r}: unknown; the model has {', '.join(names) or 'none'}")
    return list(names).index(name)
