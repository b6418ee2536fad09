"""Mouth from bands of the spectrum, in any language; also live.

As in Llorach et al. ("Web-based live speech-driven lip-sync", VS-Games 2016), the amplitude in 700
to 3000 Hz opens the mouth, sound of lower frequency alone rounds the lips, and hissing shows the
teeth. Amplitude counts from the sound's own floor to the speaker's own level, so that neither the
gain of a microphone nor steady noise opens the mouth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from audio_features.acoustic.analysis import N_FFT, SAMPLE_RATE
from audio_features.acoustic.streaming import REACH, SpectrumStream
from gesturekit.face.channels import NAMES, SHAPES, channels
from gesturekit.face.eyes import RATE, Eyes

_BLOCK = 6
"""Frames of 10 ms that are computed at a time."""
_LOW, _OPEN, _HISS = ((80, 500), (700, 3000), (4000, 8000))
_REMEMBERED = 1000
"""Frames, 10 s, whose quietest tenth is the floor, and whose loudest twentieth is the level."""
_ABOVE, _LEAST = 4.0, 0.2
"""Times the floor at which the mouth begins to open; lowest level, relative to active speech."""
_COMPRESSION = 0.35
"""Exponent of power; 0.5 is amplitude."""
_SMOOTH = np.hanning(21)[1:-1] / np.hanning(21).sum()
_AHEAD = len(_SMOOTH) // 2


class Openness:
    """How far the mouth is open in sound that arrives block by block, 100 values a second.

    Raises as `EnergyFace`.
    """

    def __init__(self, sample_rate: int) -> None:
        self._sound = SpectrumStream(sample_rate, _BLOCK / RATE + 0.1)
        self.delay = self._sound.delay + REACH + _BLOCK / RATE
        self._powers = np.empty(0)

    def step(self, samples: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield openness (n,) from 0 to 1 and shapes of the mouth (n, S) of the next frames."""
        done = self._sound.n_frames
        target = [done + _BLOCK]
        for _ in self._sound.push(np.asarray(samples, np.float32), lambda: target[0]):
            spectrum, _ = self._sound.window((self._sound.n_frames - done) / RATE)
            done = self._sound.n_frames
            target[0] = done + _BLOCK
            low, power, hiss = (_band(spectrum.power, *band) for band in (_LOW, _OPEN, _HISS))
            self._powers = np.concatenate([self._powers, power])[-_REMEMBERED:]
            floor, level = np.quantile(self._powers, [0.1, 0.95])
            floor, level = _ABOVE * floor, max(level, _LEAST, 2 * _ABOVE * floor)
            opened = ((power - floor) / (level - floor)).clip(0.0, 1.0) ** _COMPRESSION
            voiced = ((spectrum.melody.voicing - 0.3) / 0.4).clip(0.0, 1.0)
            yield opened * (0.7 + 0.3 * voiced), _shapes(opened, voiced, low, hiss)


def _band(power: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the power (T,) from low to high Hz."""
    first, last = (round(hertz * N_FFT / SAMPLE_RATE) for hertz in (low, high))
    return power[:, first:last].sum(axis=1).astype(float)


def _shapes(
    opened: np.ndarray, voiced: np.ndarray, low: np.ndarray, hiss: np.ndarray
) -> np.ndarray:
    """Return the shapes of the mouth (T, S) from openness, voicing and the power of two bands."""
    rounded = voiced * (low > 0.1) * (opened > 0) * (1 - opened)
    teeth = (hiss / (hiss + low + 0.01)) * np.sqrt(opened)
    values = {"jawOpen": 0.6 * opened * (0.7 + 0.3 * voiced), "mouthPucker": 0.4 * rounded}
    values |= {"mouthFunnel": 0.2 * rounded, "mouthStretch": 0.2 * teeth}
    values |= {"mouthLowerDown": 0.25 * opened + 0.2 * teeth, "mouthUpperUp": 0.1 * opened}
    return np.stack([values.get(name, np.zeros(len(opened))) for name in SHAPES], axis=1)


class EnergyFace:
    """A face from sound that arrives block by block; the same for blocks of any size.

    Args:
        sample_rate: of the sound, Hz.
        fps: frames per second; frame k is at k / fps s.
        seed: of blinks and gaze.
        item: name of the utterance; other names blink at other times.

    Attributes:
        names: of the columns of values, ARKit's.
        delay: seconds of sound after a frame's time until it is final, at most.

    Raises:
        AudioError: a sample rate out of range.
        FeatureError: a sample rate without a common period with 16 kHz, such as 15999 Hz.
    """

    names = NAMES

    def __init__(self, sample_rate: int, fps: float, seed: int = 0, item: str = "") -> None:
        self.fps = fps
        self._openness, self._drawn = Openness(sample_rate), Eyes(seed, item)
        self.delay = self._openness.delay + (_AHEAD + 1) / RATE
        self._shapes = np.zeros((_AHEAD, len(SHAPES)))  # from hundredth _first - _AHEAD
        self._eyes = np.empty((0, 3))  # from hundredth _first
        self._first = self._n_frames = 0

    def step(self, samples: np.ndarray) -> np.ndarray:
        """Return the values (n, E) of the frames that the next samples (N,) make final."""
        values = [np.empty((0, len(NAMES)))]
        for opened, shapes in self._openness.step(samples):
            self._shapes = np.concatenate([self._shapes, shapes])
            self._eyes = np.concatenate([self._eyes, self._drawn.step(opened > 0)])
            values.append(self._final())
        return np.concatenate(values)

    def _final(self) -> np.ndarray:
        """Return the values of the frames whose surroundings are there, and forget those."""
        known = len(self._shapes) - 2 * _AHEAD
        if known < 2:
            return np.empty((0, len(NAMES)))
        mouth = sum(weight * self._shapes[i : known + i] for i, weight in enumerate(_SMOOTH))
        stop = max(math.ceil((self._first + known - 1) * self.fps / RATE), self._n_frames)
        at = np.arange(self._n_frames, stop) * (RATE / self.fps) - self._first
        values = channels(sampled(mouth, at), sampled(self._eyes, at))
        gone = max(min(int(stop * RATE / self.fps) - self._first, known - 1), 0)
        self._shapes, self._eyes = self._shapes[gone:], self._eyes[gone:]
        self._first, self._n_frames = self._first + gone, stop
        return values


def sampled(curves: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return curves (T, C) at the places `at` (N,), interpolated: (N, C)."""
    columns = [np.interp(at, np.arange(len(curves)), column) for column in curves.T]
    return np.stack(columns, axis=1) if len(at) else np.empty((0, curves.shape[1]))
