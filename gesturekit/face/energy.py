"""Mouth from loudness, voicing and the spectrum, in any language; also live.

As in Llorach et al. ("Web-based live speech-driven lip-sync", VS-Games 2016), jaw and lips follow a
few bands of the spectrum. Loudness counts from the speaker's own floor up to the level of his or
her speech, so that neither the gain of a microphone nor steady noise opens the mouth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from audio_features import Wave
from audio_features.acoustic.streaming import REACH, SpectrumStream
from gesturekit.face.channels import NAMES, SHAPES, channels
from gesturekit.face.eyes import RATE, Eyes

_BLOCK = 6
"""Frames of 10 ms that are computed at a time."""
_SMOOTH = np.hanning(15)[1:-1] / np.hanning(15).sum()
AHEAD = len(_SMOOTH) // 2
_REMEMBERED = 1000
"""Frames, 10 s, whose quietest tenth is the floor."""
_MARGIN, _LOWEST, _HIGHEST = 6.0, -25.0, -6.0
"""dB above the floor at which the mouth begins to open; between these, relative to speech."""
_FULL = 3.0
"""dB, relative to speech, at which it is open."""


class Loudness:
    """Loudness and shapes of the mouth of sound that arrives block by block, 100 a second.

    Raises as `EnergyFace`.
    """

    def __init__(self, sample_rate: int) -> None:
        self._sound = SpectrumStream(sample_rate, _BLOCK / RATE + 0.1)
        self.delay = self._sound.delay + REACH + _BLOCK / RATE
        self._energy = np.empty(0)

    def step(self, samples: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield loudness (n,), 0 at the floor to 1, and shapes (n, S) of the next frames."""
        sound, done = self._sound, [self._sound.n_frames]
        for _ in sound.push(np.asarray(samples, np.float32), lambda: done[-1] + _BLOCK):
            count = sound.n_frames - done[-1]
            done.append(sound.n_frames)
            spectrum, _ = sound.window(count / RATE)
            melody = spectrum.melody
            self._energy = np.concatenate([self._energy, melody.energy])[-_REMEMBERED:]
            floor = float(np.quantile(self._energy, 0.1)) + _MARGIN
            least = min(max(floor, _LOWEST), _HIGHEST)
            loud = ((melody.energy - least) / (_FULL - least)).clip(0.0, 1.0)
            voiced = ((melody.voicing - 0.3) / 0.4).clip(0.0, 1.0)
            yield loud, shapes(loud, voiced, spectrum.power)


def shapes(loud: np.ndarray, voiced: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Return the shapes of the mouth (T, S) of frames of sound.

    Args:
        loud: (T,) 0 at the floor, 1 at the level of speech.
        voiced: (T,) 0 to 1.
        power: (T, 257) short-time power.
    """
    mouth = np.zeros((len(loud), len(SHAPES)))
    mouth[:, SHAPES.index("jawOpen")] = 0.6 * loud * (0.2 + 0.8 * voiced)
    return mouth


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
        self._loudness, self._drawn = Loudness(sample_rate), Eyes(seed, item)
        self.delay = self._loudness.delay + (AHEAD + 1) / RATE
        self._shapes = np.zeros((AHEAD, len(SHAPES)))  # from hundredth _first - AHEAD
        self._eyes = np.empty((0, 3))  # from hundredth _first
        self._first = self._n_frames = 0

    def step(self, samples: np.ndarray) -> np.ndarray:
        """Return the values (n, E) of the frames that the next samples (N,) make final."""
        values = [np.empty((0, len(NAMES)))]
        for loud, mouth in self._loudness.step(samples):
            self._shapes = np.concatenate([self._shapes, mouth])
            self._eyes = np.concatenate([self._eyes, self._drawn.step(loud > 0)])
            values.append(self._final())
        return np.concatenate(values)

    def _final(self) -> np.ndarray:
        """Return the values of the frames whose surroundings are there, and forget those."""
        mouth = smoothed(self._shapes)
        known = self._first + len(mouth)
        stop = max(math.ceil((known - 1) * self.fps / RATE), self._n_frames)
        at = np.arange(self._n_frames, stop) * (RATE / self.fps) - self._first
        values = channels(sampled(mouth, at), sampled(self._eyes, at))
        gone = max(min(int(stop * RATE / self.fps), known - 1) - self._first, 0)
        self._shapes, self._eyes = self._shapes[gone:], self._eyes[gone:]
        self._first, self._n_frames = self._first + gone, stop
        return values


def smoothed(curves: np.ndarray) -> np.ndarray:
    """Return curves (T, C) smoothed, without `AHEAD` frames at each end."""
    return sum(weight * curves[i : len(curves) - 2 * AHEAD + i] for i, weight in enumerate(_SMOOTH))


def sampled(curves: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return curves (T, C) at the places `at` (N,), interpolated: (N, C)."""
    low = at.astype(int).clip(0, max(len(curves) - 2, 0))
    way = (at - low)[:, None].clip(0.0, 1.0)
    return curves[low] + way * (curves[low + 1] - curves[low]) if len(at) else curves[:0]


def energy_values(speech: Wave, fps: float, n_frames: int, seed: int, item: str) -> np.ndarray:
    """Return the values (n_frames, E) of a whole sound, at once."""
    face = EnergyFace(speech.sample_rate, fps, seed, item)
    values = [face.step(speech.samples)]
    missing = n_frames / fps - speech.duration + face.delay + 0.1
    silence = np.zeros(speech.sample_rate, np.float32)
    values += [face.step(silence) for _ in range(math.ceil(max(missing, 0.0)))]
    return np.concatenate(values)[:n_frames]
