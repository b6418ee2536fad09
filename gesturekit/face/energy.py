"""Mouth from loudness, voicing and the colour of the voice, in any language; also live.

The rule follows Llorach et al. ("Web-based live speech-driven lip-sync", VS-Games 2016), who take
jaw, rounding and spread of the lips from a few bands of the spectrum. Loudness counts from the
speaker's own floor up to the level of his or her speech, so that neither the gain of a microphone
nor steady noise opens the mouth.
"""

from __future__ import annotations

import math

import numpy as np

from audio_features import Wave
from audio_features.acoustic.streaming import REACH, SpectrumStream
from gesturekit.face.channels import NAMES, SHAPES, channels
from gesturekit.face.eyes import RATE, Eyes

_BLOCK = 4
"""Frames of 10 ms that are computed at a time."""
_SMOOTH = np.hanning(15)[1:-1] / np.hanning(15).sum()
_AHEAD = len(_SMOOTH) // 2
_REMEMBERED = 1000
"""Frames, 10 s, whose quietest tenth is the floor."""
_MARGIN, _LOWEST, _HIGHEST = 6.0, -25.0, -6.0
"""dB above the floor at which the mouth begins to open; between these, relative to speech."""
_FULL = 3.0
"""dB, relative to speech, at which it is open."""


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
        self.sample_rate, self.fps = sample_rate, fps
        self._sound = SpectrumStream(sample_rate, _BLOCK / RATE + 0.1)
        self.delay = self._sound.delay + REACH + (_BLOCK + _AHEAD + 1) / RATE
        self._eyes_of = Eyes(seed, item)
        self._energy = np.empty(0)
        self._raw = np.zeros((_AHEAD, len(SHAPES)))  # from frame _first - _AHEAD
        self._eyes = np.empty((0, 3))  # from frame _first
        self._first = self._n_frames = 0

    def step(self, samples: np.ndarray) -> np.ndarray:
        """Return the values (n, E) of the frames that the next samples (N,) make final.

        Raises:
            AudioError: samples that are not finite.
        """
        values = [np.empty((0, len(NAMES)))]
        before = self._sound.n_frames
        for _ in self._sound.push(np.asarray(samples, np.float32), lambda: before + _BLOCK):
            self._analyse(self._sound.n_frames - before)
            values.append(self._final())
            before = self._sound.n_frames
        return np.concatenate(values)

    def _analyse(self, count: int) -> None:
        """Append the shapes of `count` new frames of 10 ms."""
        spectrum, _ = self._sound.window(count / RATE)
        melody = spectrum.melody
        self._energy = np.concatenate([self._energy, melody.energy])[-_REMEMBERED:]
        floor = float(np.quantile(self._energy, 0.1)) + _MARGIN
        least = min(max(floor, _LOWEST), _HIGHEST)
        loud = ((melody.energy - least) / (_FULL - least)).clip(0.0, 1.0)
        speaking = loud > 0
        voiced = ((melody.voicing - 0.3) / 0.4).clip(0.0, 1.0)
        self._raw = np.concatenate([self._raw, shapes(loud, voiced, spectrum.power)])
        self._eyes = np.concatenate([self._eyes, self._eyes_of.step(speaking)])

    def _final(self) -> np.ndarray:
        """Return the values of the frames whose surroundings are there."""
        columns = [np.convolve(column, _SMOOTH, mode="valid") for column in self._raw.T]
        mouth = np.stack(columns, axis=1)
        known = self._first + len(mouth)  # hundredths that are final
        stop = max(math.ceil((known - 1) * self.fps / RATE), self._n_frames)
        at = np.arange(self._n_frames, stop) * (RATE / self.fps) - self._first
        low = np.minimum(at.astype(int), max(len(mouth) - 2, 0))
        way = (at - low)[:, None]
        curves = [part[low] + way * (part[low + 1] - part[low]) for part in (mouth, self._eyes)]
        self._n_frames = stop
        keep = max(min(int(stop * RATE / self.fps), known - 1) - self._first, 0)
        self._raw, self._eyes = self._raw[keep:], self._eyes[keep:]
        self._first += keep
        return channels(*curves)


def shapes(loud: np.ndarray, voiced: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Return the shapes of the mouth (T, S) of frames of sound.

    Args:
        loud: (T,) 0 at the floor, 1 at the level of speech.
        voiced: (T,) 0 to 1.
        power: (T, 257) short-time power.
    """
    mouth = np.zeros((len(loud), len(SHAPES)))
    open_ = loud * (0.2 + 0.8 * voiced)
    mouth[:, SHAPES.index("jawOpen")] = 0.6 * open_
    return mouth


def energy_values(speech: Wave, fps: float, n_frames: int, seed: int, item: str) -> np.ndarray:
    """Return the values (n_frames, E) of a whole sound, at once."""
    wave = speech.resample(16_000).at_level()
    face = EnergyFace(wave.sample_rate, fps, seed, item)
    values = [face.step(wave.samples)]
    missing = n_frames / fps - wave.duration + face.delay + 0.1
    silence = np.zeros(16_000, np.float32)
    values += [face.step(silence) for _ in range(math.ceil(max(missing, 0.0)))]
    return np.concatenate(values)[:n_frames]
