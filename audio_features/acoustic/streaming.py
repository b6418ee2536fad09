"""Acoustic features of sound that arrives block by block.

Power, pitch and energy of a frame of 10 ms depend on 64 ms of sound, so they are computed once. The
voiced frames so far give what offline extraction takes from the whole clip: its level, its median
pitch, its stretches without voice. The extractors run, unchanged, on the last seconds of frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from audio_features.acoustic import (
    FRAME_RATE,
    HOP,
    N_FFT,
    SAMPLE_RATE,
    VOICED,
    WINDOW,
    ShortTimeSpectrum,
    audible_melody,
    centred_frames,
    short_time_power,
    to_db,
    track_pitch,
)
from audio_features.errors import FeatureError
from audio_features.wave import ACTIVE_RANGE_DB, SPEECH_LEVEL_DBFS, checked_rate

_KINDS = ("logmel", "mfcc", "prosody", "onset", "prosodic_range", "effort")
"""Extractors that work on a stream."""
REACH = 0.032
"""Seconds of sound after a frame on which its pitch depends."""
_REACH_SAMPLES = round(REACH * SAMPLE_RATE)
_CONTEXT = 4
"""Frames of sound before new frames; more than the 32 ms that these need."""
_SILENT = 10.0**-6
"""Power at or below which a frame is silent, -60 dBFS: the noise of a microphone."""
_REMEMBERED = 1500
"""Voiced frames, 15 s of them, from which level and median pitch are taken."""
_VOICELESS_SECONDS = 2.0
"""After this time without a voiced frame, sound counts as silence until the next one."""
_LONGEST_STEP = 1600
"""Samples at 16 kHz that are resampled at a time, at most."""
_FILTER = 10
"""Half the length of scipy's resampling filter, in samples of the lower rate."""


def check_streams(extractor: Any) -> None:
    """Raise FeatureError for an extractor, or a stack, that does not work on a stream of sound."""
    for part in getattr(extractor, "parts", (extractor,)):
        kind = part.spec["kind"]
        if kind not in _KINDS:
            ways = f"{', '.join(_KINDS)} work on a stream"
            raise FeatureError(f"{kind}: these features need the whole sound; {ways}")


class SpectrumStream:
    """Spectrum, pitch and energy of sound that arrives block by block.

    Results do not depend on the size of the blocks, and memory is bounded.

    Args:
        sample_rate: of the sound, Hz.
        seconds: of frames that are kept.

    Attributes:
        n_frames: frames computed so far; frame k is centred at k·0.01 s.
        delay: seconds of sound, after the end of a frame's `REACH`, until it is computed, at most.

    Raises:
        AudioError: a sample rate out of range.
        FeatureError: a sample rate without a common period with 16 kHz, such as 15999 Hz.
    """

    def __init__(self, sample_rate: int, seconds: float) -> None:
        rate = checked_rate(sample_rate, "sample_rate")
        common = math.gcd(rate, SAMPLE_RATE)
        self._up, self._down = SAMPLE_RATE // common, rate // common
        self._step = math.lcm(HOP, self._up)
        if self._step > _LONGEST_STEP:
            raise FeatureError(f"sample_rate={rate}: a stream needs a usual rate, such as 48000 Hz")
        ahead = math.ceil(_FILTER * max(1, self._down / self._up)) + 1
        self._ahead = ahead if rate != SAMPLE_RATE else 0
        self._behind = self._down * math.ceil(self._ahead / self._down)
        self.delay = self._step / SAMPLE_RATE + self._ahead / rate
        self._kept = round(seconds * FRAME_RATE)
        self.n_frames = 0
        self._waiting = np.zeros(self._behind, np.float32)
        self._sound = np.zeros(_CONTEXT * HOP, np.float32)
        self._power = np.empty((0, N_FFT // 2 + 1), np.float32)
        # Columns: mean square over 50 ms, f0, periodicity.
        self._curves = np.empty((0, 3))
        # Of the last voiced frames: mean square over 25 ms, and ln(f0).
        self._voiced = np.empty((0, 2))
        self._last_voiced = -math.inf
        self._offset = 0.0

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs: arrays and numbers."""
        return {name: getattr(self, name) for name in _STATE}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a `state` of a stream with the same arguments."""
        for name in _STATE:
            setattr(self, name, state[name])

    def push(self, samples: np.ndarray, wanted: Callable[[], int]) -> Iterator[None]:
        """Take the next samples (N,) float32, of any number.

        Yields whenever there are as many frames as are `wanted()` then, more than `n_frames`.
        """
        self._waiting = np.concatenate([self._waiting, samples])
        while True:
            frames = wanted() - self.n_frames + _CONTEXT - 1
            missing = frames * HOP + _REACH_SAMPLES - len(self._sound)
            taken = max(1, -(-missing // self._step)) * (self._step * self._down // self._up)
            needed = self._behind + taken + self._ahead
            if len(self._waiting) < needed:
                return
            self._add(self._resampled(self._waiting[:needed], taken))
            self._waiting = self._waiting[taken:]
            yield

    def _resampled(self, samples: np.ndarray, taken: int) -> np.ndarray:
        """Return the 16 kHz samples of `taken` samples, which have others on both sides."""
        if not self._ahead:
            return samples
        from scipy.signal import resample_poly

        first, n = (count * self._up // self._down for count in (self._behind, taken))
        return resample_poly(samples, self._up, self._down)[first : first + n]

    def _add(self, sound: np.ndarray) -> None:
        """Compute the frames that the next 16 kHz samples complete."""
        self._sound = np.concatenate([self._sound, sound])
        count = (len(self._sound) - _REACH_SAMPLES) // HOP - _CONTEXT + 1
        # A microphone's offset is no speech: the mean of about the last second.
        share = max(count / FRAME_RATE, count / (count + self.n_frames))
        self._offset += share * (float(self._sound.mean()) - self._offset)
        samples = self._sound - np.float32(self._offset)
        n = _CONTEXT + count
        new = slice(_CONTEXT, n)
        f0, periodicity = track_pitch(samples, n)
        loudness, level = (_mean_squares(samples, length, n)[new] for length in (800, WINDOW))
        curves = np.stack([loudness, f0[new], periodicity[new]], axis=1)
        voiced = (curves[:, 2] >= VOICED) & (level > _SILENT)
        remembered = np.stack([level[voiced], np.log(curves[voiced, 1])], axis=1)
        self._voiced = np.concatenate([self._voiced, remembered])[-_REMEMBERED:]
        power = short_time_power(samples, n)[new]
        self._power = np.concatenate([self._power, power])[-self._kept :]
        frames = self.n_frames + np.arange(count)
        last = np.maximum.accumulate(np.where(voiced, frames, self._last_voiced))
        self._last_voiced = float(last[-1])
        silent = frames - last > _VOICELESS_SECONDS * FRAME_RATE
        self._power[-count:][silent] = 0.0
        curves[silent, 0] = 0.0
        self._curves = np.concatenate([self._curves, curves])[-self._kept :]
        self.n_frames += count
        self._sound = self._sound[count * HOP :]

    def window(self, seconds: float) -> tuple[ShortTimeSpectrum, np.ndarray]:
        """Return the last frames as a spectrum, and their speech activity (T,) bool.

        Before the first voiced frame, all frames are silent.
        """
        count = min(round(seconds * FRAME_RATE), len(self._power))
        loudness, f0, periodicity = self._curves[-count:].T
        pitch = gain = 0.0
        if len(self._voiced):
            squares, log_f0 = self._voiced.T
            # As in `Wave.active`: frames 20 dB below the mean do not count.
            loud = squares[squares >= squares.mean() * 10.0 ** (-ACTIVE_RANGE_DB / 10.0)]
            level, pitch = float(loud.mean()), float(np.exp(np.median(log_f0)))
            gain = 10.0 ** (SPEECH_LEVEL_DBFS / 10.0) / level if level else 0.0
        energy = to_db(loudness * gain / 10.0 ** (SPEECH_LEVEL_DBFS / 10.0))
        melody = audible_melody(f0, periodicity, energy, pitch)
        times = (self.n_frames - count + np.arange(count)) / FRAME_RATE
        power = self._power[-count:] * np.float32(gain)
        return ShortTimeSpectrum.of_frames(times, power, melody), energy >= -ACTIVE_RANGE_DB


_STATE = (
    *("n_frames", "_waiting", "_sound", "_power", "_curves"),
    *("_voiced", "_last_voiced", "_offset"),
)


def _mean_squares(samples: np.ndarray, length: int, n_frames: int) -> np.ndarray:
    """Return the mean square (T,) of `length` samples around each frame."""
    blocks = [np.square(part).mean(axis=1) for _, part in centred_frames(samples, length, n_frames)]
    return np.concatenate(blocks).astype(float)
