"""Normalised speech features of sound that arrives block by block."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from audio_features.acoustic.analysis import FRAME_RATE
from audio_features.acoustic.streaming import REACH, SpectrumStream
from audio_features.track import FeatureTrack
from gesturekit.corpus.speech import SpeechConditioner, parts_of
from gesturekit.state.ahead import AVERAGED_SECONDS, FeatureWindow

_SMOOTHED_SECONDS = 3.0
"""Sound before a window of features, for the extractors that smooth over seconds."""
_CENTRE_SECONDS = 60.0
"""Seconds of speech after which it counts 1/e in the centre of a voice."""


class SpeechStream:
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
        return {"sound": self._sound.state(), **{name: getattr(self, name) for name in _STATE}}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from the `state` of a stream with the same arguments."""
        self._sound.restore(state["sound"])
        for name in _STATE:
            setattr(self, name, state[name])

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
        columns = [part.from_spectrum(spectrum) for part in parts_of(self._conditioner.extractor)]
        count = min(self._rows, self.n_rows)
        # Times count from the first row of the window.
        times = spectrum.times - (self.n_rows - count) / self._fps
        track = FeatureTrack(np.concatenate([part.values for part in columns], axis=1), times, {})
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


_STATE = ("n_rows", "_total", "_count", "_averages")
