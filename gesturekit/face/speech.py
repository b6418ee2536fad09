"""Face by rules from speech: a mouth, blinks and small eye movements, of whole sounds and streams.

Energy shapes the mouth in any language. As in Llorach et al. ("Web-based live speech-driven
lip-sync", VS-Games 2016), the amplitude in 700 to 3000 Hz opens the mouth, sound of lower frequency
alone rounds the lips, and sibilants show the teeth. Amplitude is scaled between the sound's noise
floor and the speaker's level, so that neither the gain of a microphone nor steady noise opens the
mouth.

Blinks: gaps are log-normal, 17 a minute (people at rest in Bentivoglio et al. 1997), and a blink
that is due soon is moved to the beginning of a pause, where people blink more often. Lids close in
half the time in which they open (VanderWerf et al. 2003). Gaze: fixations around the middle, joined
by saccades that take 25 ms and 2.2 ms a degree (Lee, Badler and Badler, "Eyes Alive", 2002).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence

import numpy as np

from audio_features import Wave, speech_only
from audio_features.acoustic import N_FFT, SAMPLE_RATE, power_blocks
from audio_features.acoustic.streaming import REACH, SpectrumStream
from gesturekit.errors import MotionError
from gesturekit.face.phones import MOUTH, MOUTH_SIDES, RATE, SHAPES, mouth_of_phones, phones_of
from gesturekit.motion.face import FaceTrack
from gesturekit.motion.resampling import smoothstep

METHODS = ("energy", "phones")
_EYES = ("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp")
NAMES = (*MOUTH, *(name + side for name in (*MOUTH_SIDES, *_EYES) for side in ("Left", "Right")))
"""Names of a face's channels, ARKit's."""
_FULL_LOOK = 30.0
"""Degrees of gaze at which ARKit's eyeLook shapes are 1."""

_BANDS = np.array([(80, 500), (700, 3000), (4000, 8000)])
"""Bands that round, open and hiss, Hz."""
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

_GAP, _SPREAD = 3.6, 0.5
"""Mean seconds between blinks, and standard deviation of their logarithm."""
_PAUSE, _SOON = 0.25, 1.5
"""Seconds of silence that make a pause; a blink due within the second number moves to it."""
_CLOSING, _CLOSED, _OPENING = 0.08, 0.03, 0.17
_FIXATION, _SHORTEST = 1.4, 0.25
"""Mean and least seconds of a fixation."""
_REACH = (3.0, 1.5)
"""Standard deviation of fixations to the side and up, degrees."""


def face_from_speech(
    speech: Wave,
    fps: float,
    n_frames: int,
    method: str = "energy",
    transcript: str | None = None,
    seed: int = 0,
    item: str = "",
) -> FaceTrack:
    """Make a face that speaks a sound, blinks and looks around, by rules alone.

    It has no emotion, and is no recording of anybody's face: its origin is "rules".

    Args:
        speech: the sound; its level does not matter.
        fps: frames per second; frame k is at k / fps s.
        n_frames: T.
        method: "energy" opens the mouth by the energy of the voice, in any language; "phones"
            shapes it by English phones that PocketSphinx finds.
        transcript: English words that are spoken, for "phones"; a warning says what of it is no
            help, such as words that are not in the dictionary.
        seed: of blinks and gaze.
        item: name of the utterance; other names blink at other times.

    Returns:
        T frames of ARKit's channels of mouth and eyes.

    Raises:
        MotionError: another method, or phones without PocketSphinx.
    """
    return faces_from_speech(speech, fps, n_frames, method, transcript, [Eyes(seed, item)])[0]


def faces_from_speech(
    speech: Wave,
    fps: float,
    n_frames: int,
    method: str,
    transcript: str | None,
    eyes: Sequence[Eyes],
) -> list[FaceTrack]:
    """Return a face for each of `eyes`, all with the same mouth; see `face_from_speech`."""
    if method not in METHODS:
        raise MotionError(f"method {method!r} of a face; expected {' or '.join(METHODS)}")
    speech = speech.resample(SAMPLE_RATE).at_level()
    blocks = power_blocks(speech_only(speech).samples, speech.n_frames(RATE))
    bands = np.concatenate([_bands(power) for _, power in blocks])
    openness, mouth = _mouth(bands, bands[:, 1])
    more = max(0, math.ceil(n_frames * RATE / fps) + 1 - len(openness))
    openness, at = np.pad(openness, (0, more)), np.arange(n_frames) * (RATE / fps)
    if method == "energy":
        mouth = _smoothed(np.pad(mouth, ((_AHEAD, _AHEAD + more), (0, 0))))
    else:
        phones = [] if speech.is_silent else phones_of(speech, openness, transcript)
        mouth = mouth_of_phones(phones, openness, hold=1.2 / fps)
    return [
        FaceTrack(NAMES, _channels(mouth, each.step(openness > 0), at), "rules") for each in eyes
    ]


def _bands(power: np.ndarray) -> np.ndarray:
    """Return the power (T, 3) in `_BANDS` from short-time power (T, 257)."""
    edges = np.rint(_BANDS * N_FFT / SAMPLE_RATE).astype(int)
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


def _smoothed(curves: np.ndarray) -> np.ndarray:
    """Return curves (T + 2 _AHEAD, C) smoothed over 0.2 s: (T, C)."""
    n = len(curves) - 2 * _AHEAD
    return sum(weight * curves[i : n + i] for i, weight in enumerate(_SMOOTH))


def _channels(mouth: np.ndarray, eyes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the values (N, E) of the channels NAMES at fractional rows `at` (N,).

    Args:
        mouth: (T, S) values of SHAPES.
        eyes: (T, 3) lids, gaze to the person's left and up in degrees, from `Eyes`.
        at: places between 0 and T - 1.
    """
    shapes, (lids, left, up) = (
        [np.interp(at, np.arange(len(curves)), column) for column in curves.T]
        for curves in (mouth, eyes)
    )
    left, up = left / _FULL_LOOK, up / _FULL_LOOK
    middle = len(MOUTH)
    pairs = [np.repeat(np.stack(shapes[middle:], axis=1), 2, axis=1), lids, lids, -up, -up]
    pairs += [-left, left, left, -left, up, up]  # the left eye looks in to the right
    return np.column_stack([*shapes[:middle], *pairs]).clip(0.0, 1.0)


class Eyes:
    """Blinks and gaze for one stretch of time after the other.

    Args:
        seed: of what is drawn.
        item: name of the utterance; other names blink at other times.
    """

    def __init__(self, seed: int, item: str = "") -> None:
        self._blinks, self._looks = (_rng(seed, item, what) for what in ("blinks", "gaze"))
        self._silence = math.inf  # seconds since speech
        self._until_blink, self._blinking = self._gap(), math.inf
        self._until_look, self._moving, self._duration = self._fixation(), math.inf, 1.0
        self._from = self._to = np.zeros(2)

    def step(self, speaking: np.ndarray) -> np.ndarray:
        """Return lids and gaze of the next N hundredths of a second.

        Args:
            speaking: (N,) bool.

        Returns:
            (N, 3): lids from 0 (open) to 1 (closed), gaze to the person's left and up, degrees.
        """
        values = np.empty((len(speaking), 3))
        for i, speech in enumerate(speaking.tolist()):
            self._silence = 0.0 if speech else self._silence + 1 / RATE
            pausing = self._silence - 1 / RATE < _PAUSE <= self._silence
            self._until_blink -= 1 / RATE
            self._until_look -= 1 / RATE
            self._blinking += 1 / RATE
            self._moving += 1 / RATE
            if self._until_blink <= (_SOON if pausing else 0.0):
                self._blinking = 0.0
                self._until_blink += self._gap()  # the next one is not moved as well
            if self._until_look <= 0:
                self._from = self._to
                self._to = self._looks.standard_normal(2).clip(-2.5, 2.5) * _REACH
                self._duration = 0.025 + 0.0022 * float(np.linalg.norm(self._to - self._from))
                self._moving, self._until_look = 0.0, self._fixation()
            closed = min(self._blinking / _CLOSING, 1.0)
            opened = min(max((self._blinking - _CLOSING - _CLOSED) / _OPENING, 0.0), 1.0)
            values[i, 0] = smoothstep(closed) - smoothstep(opened)
            way = smoothstep(min(self._moving / self._duration, 1.0))
            values[i, 1:] = self._from + way * (self._to - self._from)
        return values

    def _gap(self) -> float:
        gap = self._blinks.lognormal(math.log(_GAP) - _SPREAD**2 / 2, _SPREAD)
        return max(gap, _CLOSING + _CLOSED + _OPENING)

    def _fixation(self) -> float:
        return _SHORTEST + self._looks.exponential(_FIXATION - _SHORTEST)


def _rng(*keys: int | str) -> np.random.Generator:
    """Return a generator that depends on the keys alone."""
    text = "\x1f".join(map(str, keys)).encode("utf-8", "surrogatepass")
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text).digest()[:16], "little"))


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
        mouth = _smoothed(self._shapes)
        stop = max(math.ceil((self._first + len(mouth) - 1) * self.fps / RATE), self._n_frames)
        at = np.arange(self._n_frames, stop) * (RATE / self.fps) - self._first
        values = _channels(mouth, self._eyes, at)
        gone = max(min(int(stop * RATE / self.fps) - self._first, len(mouth) - 1), 0)
        self._shapes, self._eyes = self._shapes[gone:], self._eyes[gone:]
        self._first, self._n_frames = self._first + gone, stop
        return values
