"""Mouth shapes from energy in frequency bands, in any language, of whole sounds and streams.

As in Llorach et al. ("Web-based live speech-driven lip-sync", VS-Games 2016), the amplitude in 700
to 3000 Hz opens the mouth, sound of lower frequency alone rounds the lips, and sibilants show the
teeth. Amplitude is scaled between the sound's noise floor and the speaker's level, so that neither
the gain of a microphone nor steady noise opens the mouth.
"""

from __future__ import annotations

import math

import numpy as np

from audio_features import Wave, speech_only
from audio_features.acoustic import N_FFT, SAMPLE_RATE, power_blocks
from audio_features.acoustic.streaming import REACH, SpectrumStream
from gesturekit.errors import MotionError
from gesturekit.face.eyes import RATE, Eyes
from gesturekit.face.visemes import NAMES, SHAPES, channels

_LOW, _OPEN, _HISS = ((80, 500), (700, 3000), (4000, 8000))
"""Bands, Hz."""
_FLOOR, _LEVEL = 0.1, 0.95
"""Quantiles of the power of the second band: its noise floor, and the speaker's level."""
_ABOVE, _LEAST = 4.0, 0.2
"""Power at which the mouth begins to open, in floors; lowest level, relative to active speech."""
_COMPRESSION = 0.35
"""Exponent of power; 0.5 is amplitude."""
_SMOOTH = np.hanning(21)[1:-1] / np.hanning(21).sum()
_AHEAD = len(_SMOOTH) // 2  # hundredths of a second that smoothing looks ahead
_STEP, _REMEMBERED = 6, 1000
"""Hundredths of a second of a stream that are analysed at a time, and kept for floor and level."""
_EXPECTED = np.geomspace(0.0005, 1.5, 200)
"""Typical powers of speech, which give a stream its first floor and level."""


def mouth_of_sound(wave: Wave) -> tuple[np.ndarray, np.ndarray]:
    """Return openness (T,) in [0, 1] and mouth shapes (T, S) of a whole sound, 100 a second.

    Args:
        wave: 16 kHz, at the standard level.
    """
    blocks = power_blocks(speech_only(wave).samples, wave.n_frames(RATE))
    powers = np.concatenate([_bands(power) for _, power in blocks])
    return _mouth(powers, powers[:, 1])


def _bands(power: np.ndarray) -> np.ndarray:
    """Return the power (T, 3) in _LOW, _OPEN and _HISS from short-time power (T, 257)."""
    edges = np.rint(np.array([_LOW, _OPEN, _HISS]) * N_FFT / SAMPLE_RATE).astype(int)
    return np.stack([power[:, first:last].sum(axis=1) for first, last in edges], axis=1)


def _mouth(bands: np.ndarray, remembered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return openness (T,) in [0, 1] and mouth shapes (T, S).

    Args:
        bands: (T, 3), from `_bands`.
        remembered: (M,) power of the second band, whose quantiles are floor and level.
    """
    low, power, hiss = bands.T
    floor, level = np.quantile(remembered, [_FLOOR, _LEVEL]) * [_ABOVE, 1.0]
    level = max(level, _LEAST, 2 * floor)
    opened = ((power - floor) / (level - floor)).clip(0.0, 1.0) ** _COMPRESSION
    rounded = (low > 0.1) * (opened > 0) * (1 - opened)
    teeth = hiss / (hiss + low + 0.01) * np.sqrt(opened)
    values = {"jawOpen": 0.6 * opened, "mouthPucker": 0.4 * rounded, "mouthFunnel": 0.2 * rounded}
    values |= {"mouthStretch": 0.2 * teeth, "mouthUpperUp": 0.1 * opened}
    values["mouthLowerDown"] = 0.25 * opened + 0.2 * teeth
    zeros = np.zeros(len(opened))
    return opened, np.stack([values.get(name, zeros) for name in SHAPES], axis=1)


def smoothed(curves: np.ndarray) -> np.ndarray:
    """Return curves (T + 2 _AHEAD, C) smoothed over 0.2 s: (T, C)."""
    n = len(curves) - 2 * _AHEAD
    return sum(weight * curves[i : n + i] for i, weight in enumerate(_SMOOTH))


def sampled(curves: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return curves (T, C) interpolated at fractional rows `at` (N,): (N, C)."""
    columns = [np.interp(at, np.arange(len(curves)), column) for column in curves.T]
    return np.stack(columns, axis=1)


def energy_mouth(shapes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the shapes (T, S) of a whole sound, smoothed, at fractional rows `at` (N,): (N, S)."""
    return sampled(smoothed(np.pad(shapes, ((_AHEAD, _AHEAD), (0, 0)))), at)


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
        self._sound, self._drawn = SpectrumStream(sample_rate, 0.2), Eyes(seed, item)
        self.delay = self._sound.delay + REACH + (_STEP + _AHEAD + 1) / RATE
        self._powers = _EXPECTED
        self._shapes = np.zeros((_AHEAD, len(SHAPES)))  # from hundredth _first - _AHEAD
        self._eyes = np.empty((0, 3))  # from hundredth _first
        self._first = self._n_frames = 0

    def step(self, samples: np.ndarray) -> np.ndarray:
        """Return the values (n, E) of the frames that the next samples (N,) make final.

        Raises:
            MotionError: samples that are not finite.
        """
        samples = np.asarray(samples, np.float32)
        if not np.isfinite(samples).all():
            raise MotionError("samples that are not finite; a face needs finite samples (N,)")
        values, done = [np.empty((0, len(NAMES)))], [self._sound.n_frames]
        for _ in self._sound.push(samples, lambda: done[-1] + _STEP):
            spectrum, _ = self._sound.window((self._sound.n_frames - done[-1]) / RATE)
            done.append(self._sound.n_frames)
            bands = _bands(spectrum.power)
            self._powers = np.concatenate([self._powers, bands[:, 1]])[-_REMEMBERED:]
            opened, shapes = _mouth(bands, self._powers)
            self._shapes = np.concatenate([self._shapes, shapes])
            self._eyes = np.concatenate([self._eyes, self._drawn.step(opened > 0)])
            if len(self._shapes) > 2 * _AHEAD + 1:
                values.append(self._final())
        return np.concatenate(values)

    def _final(self) -> np.ndarray:
        """Return the values (n, E) of frames whose smoothing window is complete; drop used rows."""
        mouth = smoothed(self._shapes)
        stop = max(math.ceil((self._first + len(mouth) - 1) * self.fps / RATE), self._n_frames)
        at = np.arange(self._n_frames, stop) * (RATE / self.fps) - self._first
        values = channels(sampled(mouth, at), sampled(self._eyes, at))
        gone = max(min(int(stop * RATE / self.fps) - self._first, len(mouth) - 1), 0)
        self._shapes, self._eyes = self._shapes[gone:], self._eyes[gone:]
        self._first, self._n_frames = self._first + gone, stop
        return values
