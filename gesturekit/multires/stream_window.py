"""Inputs and levels of the frames around the current one, while the person speaks.

Speech features are normalised by what has been said so far, the state of movement is drawn on and
on, and the levels of the network are prepared once for a whole stream.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from audio_features.acoustic.analysis import FRAME_RATE
from audio_features.acoustic.streaming import REACH, SpectrumStream
from audio_features.track import FeatureTrack
from gesturekit.corpus.speech import SpeechConditioner, parts_of
from gesturekit.multires.backend import choose_backend
from gesturekit.multires.networks import SLOPE, Film
from gesturekit.multires.pyramid import LevelConditions, halo, mixed_carriers
from gesturekit.multires.resampling import resample
from gesturekit.multires.retrieval import Resumable
from gesturekit.state.channels import averaged
from gesturekit.state.live import AVERAGED_SECONDS, FeatureWindow
from gesturekit.state.process import Group, StateProcess

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel

_SMOOTHED_SECONDS = 3.0
"""Sound before a window of features, for the extractors that smooth over seconds."""
_CENTRE_SECONDS = 60.0
"""Seconds of speech after which it counts 1/e in the centre of a voice."""


class SpeechStream(Resumable):
    """Speech features on motion frames, normalised by what has been said so far.

    Row k belongs to motion frame k. It is complete as soon as its frame has ended and the sound
    that its last pitch depends on has arrived.

    Args:
        conditioner: of the model; its extractors work on streams (`check_streams`).
        sample_rate: of the sound, Hz.
        rows: W, of the window of features.
        every: yield features with one row in so many.

    Attributes:
        n_rows: complete rows so far.
    """

    kept = ("n_rows", "_total", "_count", "_averages")

    def __init__(
        self, conditioner: SpeechConditioner, sample_rate: int, rows: int, every: int = 1
    ) -> None:
        self._conditioner, self._rows, self._fps = conditioner, rows, conditioner.fps
        self._every = every
        self._seconds = _SMOOTHED_SECONDS + rows / conditioner.fps
        self._sound = SpectrumStream(sample_rate, self._seconds)
        self._silence = conditioner.silence(1)
        self.n_rows = 0
        self._total, self._count = np.zeros(conditioner.extractor.dim), 0.0
        self._averages = np.repeat(self._silence.astype(float), len(AVERAGED_SECONDS), axis=0)

    @property
    def reach(self) -> float:
        """Seconds of sound after a motion frame until its row is complete, at most."""
        return 0.5 / self._fps + REACH + self._sound.delay

    def rows_ahead(self, look_ahead: float) -> int:
        """Return the rows after a motion frame that are complete `look_ahead` seconds after it."""
        return math.floor((look_ahead - self.reach) * self._fps + 1e-6)

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs."""
        return super().state() | {"sound": self._sound.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from the `state` of a stream with the same arguments."""
        super().restore(state)
        self._sound.restore(state["sound"])

    def push(self, samples: np.ndarray) -> Iterator[FeatureWindow]:
        """Take samples (N,) float32; yield what is known with each row that they complete.

        Rows before the stream are silent.
        """
        for _ in self._sound.push(samples, self._needed):
            while self._sound.n_frames >= self._needed():
                self.n_rows += 1
                if self.n_rows % self._every == 0:
                    yield self._window()

    def _needed(self) -> int:
        """Return the number of frames of sound that complete the next row."""
        return math.ceil((self.n_rows + 0.5) / self._fps * FRAME_RATE)

    def _window(self) -> FeatureWindow:
        spectrum, active = self._sound.window(self._seconds)
        parts = parts_of(self._conditioner.extractor)
        columns = [extractor.from_spectrum(spectrum).values for extractor in parts]
        count = min(self._rows, self.n_rows)
        # Times count from the first row of the window.
        times = spectrum.times - (self.n_rows - count) / self._fps
        track = FeatureTrack(np.concatenate(columns, axis=1), times, {})
        values = track.to_rate(self._fps, count, self._conditioner.align).values
        now = (count - 1) / self._fps
        if active[np.abs(times - now).argmin()]:
            kept = math.exp(-self._every / (_CENTRE_SECONDS * self._fps))
            self._total = kept * self._total + self._every * values[-1]
            self._count = kept * self._count + self._every
        centre = self._conditioner.clip_centre(self._total, self._count)
        rows = self._conditioner.scaled(values, centre)
        for average, seconds in zip(self._averages, AVERAGED_SECONDS, strict=True):
            new = rows[-self._every :].mean(axis=0)
            average += (new - average) * min(1.0, self._every / (seconds * self._fps))
        before = np.repeat(self._silence, self._rows - count, axis=0)
        return FeatureWindow(np.concatenate([before, rows]), self._averages.copy())


@dataclass(frozen=True, eq=False)
class Forecast:
    """Predicted movement.

    Attributes:
        seconds: (H,) from now, ascending from 0.
        fast: (H,) fast movement at these times, log m/s.
        shares: (H,) how much is known of what the whole sound tells.
        slow: slow movement, in standard deviations.
    """

    seconds: np.ndarray
    fast: np.ndarray
    shares: np.ndarray
    slow: float


class LiveState(Resumable):
    """Drawn state of movement of a window around the current frame.

    What was drawn for a frame when it was the current one stays. The frames to come have the same
    noise at each step, as it depends on time alone, and what is known of the speech so far.

    Args:
        process: from which it is drawn.
        around: frames of the window before the current one, and from it on.
        seeds: of the noise and of the carriers.
        group: speaker and style whose movement to draw.
        liveliness: factor on the hand speed that is drawn.
    """

    kept = ("_frame", "_noise", "_values", "_clocks")

    def __init__(
        self,
        process: StateProcess,
        around: int,
        seeds: tuple[int, int],
        group: Group = (None, None),
        liveliness: float = 1.0,
    ) -> None:
        self._process, self._around = process, around
        self._noise_seed, self._carriers_seed = seeds
        self._group, self._liveliness = group, liveliness
        self._frame = -1
        self._noise = np.empty((len(process.mean), 0))
        self._values = np.empty((len(process.mean), 2 * around))
        self._clocks = np.zeros((len(process.channels.of_hands), 2 * around))

    def advance(self, speech: np.ndarray, forecast: Forecast | None) -> np.ndarray:
        """Go on by a motion frame and return the condition (C + H + 4 H, T) of the window.

        Args:
            speech: (T, S) features of the window, as far as they are known.
            forecast: of movement; None without prediction.
        """
        self._frame += 1
        process, around, begun = self._process, self._around, self._frame > 0
        last = self._frame + around
        missing = 2 * around - self._noise.shape[1] + begun
        new = process.noise(self._noise_seed, np.arange(last - missing, last))
        self._noise = np.concatenate([self._noise[:, begun:], new], axis=1)
        # Before the first frame all is drawn as if nothing had been said.
        kept = around if begun else 0
        self._values = np.roll(self._values, -1, axis=1)
        self._values[:, kept:] = self._drawn(speech, forecast)[:, kept:]
        clocks = np.roll(self._clocks, -1, axis=1)
        steps = process.clocks(self._values)[:, kept:]
        clocks[:, kept:] = np.cumsum(steps, axis=1) + (clocks[:, [kept - 1]] if begun else 0.0)
        self._clocks = clocks
        return process.condition(self._carriers_seed, self._values, clocks)

    @property
    def coming(self) -> np.ndarray:
        """(C, T / 2) the channels of the current frame, and of those to come."""
        return self._values[:, self._around :]

    def _drawn(self, speech: np.ndarray, forecast: Forecast | None) -> np.ndarray:
        """Return the channels (C, T) of the window; arguments as for `advance`."""
        predicted, known = None, np.zeros(2 * self._around)
        if forecast is not None:
            seconds = np.maximum(np.arange(-self._around, self._around) / self._process.fps, 0.0)
            shares = forecast.shares
            known = np.interp(seconds, forecast.seconds, shares, right=0.0)
            fast = np.interp(seconds, forecast.seconds, forecast.fast / np.maximum(shares, 1e-6))
            predicted = fast, np.full(len(known), forecast.slow)
        return self._process.values(
            self._noise,
            self._process.voices(speech.T),
            predicted,
            group=self._group,
            liveliness=self._liveliness,
            known=known,
        )


class WindowLevels:
    """All levels of a model with a state of movement, for part of a window.

    The result is that of `pyramid.sample`, but for rounding. It takes a third of the
    time: frames on which the part does not depend are not computed, resampling is a product with a
    matrix, and all gains and shifts of a level are one product.

    Args:
        model: with speech input and a state of movement.
        lengths: T_i, frames of each level in the window.
        styles: (1, K, T_i) for each level, or empty.
        part: frames of the finest level that are wanted.
    """

    def __init__(
        self, model: MultiresModel, lengths: Sequence[int], styles: Sequence[Tensor], part: range
    ) -> None:
        self._backend = choose_backend("auto", *model.network.levels)
        self._columns, self._n_carriers = model.conditions.columns, model.conditions.n_carriers
        self._sigma = model.noise.sigma.mean(dim=0)[0]
        self._is_residual = model.network_config.residual
        self._levels = list[_Level]()
        for i in reversed(range(len(lengths))):
            level = _Level(model, i, lengths, styles, part)
            self._levels.insert(0, level)
            part = level.coarser

    def __call__(self, speech: np.ndarray, state: np.ndarray) -> Tensor:
        """Return the normalised motion vectors (D, len(part)).

        Args:
            speech: (T, S) features of the window.
            state: (C + H + 4 H, T) of the window, see `StateProcess.condition`.
        """
        features = torch.from_numpy(speech[:, self._columns].T.astype(np.float32))
        stated = torch.from_numpy(state)
        channels, carriers = stated.split([len(stated) - self._n_carriers, self._n_carriers])
        motion: Tensor | None = None
        with torch.inference_mode(), self._backend.threads():
            for level in self._levels:
                clocked = carriers @ level.plain
                given = torch.cat([features @ level.features, channels @ level.means, clocked])
                if motion is None:
                    noise = self._sigma * mixed_carriers(clocked[None])[0]
                    x = noise.expand(level.layers[-1].shape[0], -1)
                    motion = self._added(level, x, given)
                else:
                    up = motion @ level.up
                    motion = self._added(level, up, given)
                    motion = motion + up if self._is_residual else motion
                motion = motion[:, level.kept]
        assert motion is not None
        return motion

    def _added(self, level: _Level, x: Tensor, given: Tensor) -> Tensor:
        """Return the detail (D, T) that a level adds to x (D, T), from its condition."""
        y = level.embedding @ given + level.offset
        y = F.leaky_relu(y, SLOPE) if level.rectified else y
        x = torch.cat([x, y]) if level.concatenates else x
        films = torch.addmm(level.shifts, level.gains, y)
        for i, layer in enumerate(level.layers):
            if len(films):
                gain, shift, films = films.split([len(x), len(x), len(films) - 2 * len(x)])
                x = torch.addcmul(shift, x, gain)
            slope = 1.0 if i == len(level.layers) - 1 else SLOPE
            x = self._backend.convolve([layer], x[None], slope, slope)[0]
        return x


class _Level:
    """One level, for the frames that the next one depends on.

    Attributes:
        layers: convolutions.
        kept: frames that are not only context.
        coarser: frames of the coarser level that are needed.
        up: (T of the coarser level, T) upsampling; empty at the first level.
        features: (T of the features, T) their resampling.
        means: (T of the features, T) averages, for the channels of the state of movement.
        plain: (T of the features, T) interpolation, for its carriers.
        embedding: (E, S + C + H + 4 H) weights of the speech features and of the state.
        offset: (E, T) the rest of the embedding: its bias, and a style.
        rectified: False for a linear embedding.
        concatenates: True if the embedding is a part of the input.
        gains: (2 C of the modulated layers, E) weights of gains and shifts.
        shifts: (2 C of the modulated layers, 1) their biases.
    """

    @torch.no_grad()
    def __init__(
        self,
        model: MultiresModel,
        number: int,
        lengths: Sequence[int],
        styles: Sequence[Tensor],
        part: range,
    ) -> None:
        level, n_frames = model.network.levels[number], lengths[number]
        begin, end = max(0, part.start - halo(level)), min(n_frames, part.stop + halo(level))
        self.layers, self.rectified = level.layers, level.rectify_embedding
        self.concatenates = level.concatenates
        self.kept = slice(part.start - begin, part.stop - begin)
        self.coarser, self.up = range(begin, end), torch.empty(0)
        if number:
            weights = resample(torch.eye(lengths[number - 1]), n_frames, begin, end)
            used = np.flatnonzero(weights.any(dim=1).numpy())
            self.coarser = range(int(used[0]), int(used[-1]) + 1)
            self.up = weights[self.coarser.start : self.coarser.stop]
        identity = np.eye(lengths[-1], dtype=np.float32)
        self.features, self.plain = (
            LevelConditions([identity] * len(lengths), lengths, residual)(number, begin, end)[0]
            for residual in (model.conditions.residual, False)
        )
        self.means = torch.from_numpy(averaged(identity, n_frames, begin, end))
        assert level.embed is not None and level.embed.bias is not None
        style = styles[number][0, :, begin:end] if styles else torch.empty(0, end - begin)
        weight, n_features = level.embed.weight[..., 0], len(model.conditions.columns)
        n_state = weight.shape[1] - n_features - len(style)
        of_speech, of_style, of_state = weight.split([n_features, len(style), n_state], dim=1)
        self.embedding = torch.cat([of_speech, of_state], dim=1)
        self.offset = level.embed.bias[:, None] + of_style @ style
        rows = [rows for film in level.films for rows in _padded(film)]
        self.gains = torch.cat([gains for gains, _ in rows] or [torch.empty(0, len(self.offset))])
        self.shifts = torch.cat([shifts for _, shifts in rows] or [torch.empty(0)])[:, None]


def _padded(film: Film) -> list[tuple[Tensor, Tensor]]:
    """Return weights (C, E) and biases (C,) of gain and shift; 1 and 0 where a channel has none."""
    return [
        (
            F.pad(weight[..., 0], (0, 0, 1, 0))[film.index],
            F.pad(bias, (1, 0))[film.index] + usual,
        )
        for (weight, bias), usual in (
            (film.gain.parameters(), 1.0),
            (film.shift.parameters(), 0.0),
        )
    ]
