"""Blinks and small eye movements, drawn one hundredth of a second after the other.

Blinks: gaps are log-normal, 17 a minute (people at rest in Bentivoglio et al. 1997), and a blink
that is due soon is moved to the beginning of a pause, where people blink more often. Lids close in
half the time in which they open (VanderWerf et al. 2003). Gaze: fixations around the middle, joined
by saccades that take 25 ms and 2.2 ms a degree (Lee, Badler and Badler, "Eyes Alive", 2002).
"""

from __future__ import annotations

import hashlib
import math

import numpy as np

from gesturekit.motion.resampling import smoothstep

RATE = 100
"""Values per second."""
_GAP, _SPREAD = 3.6, 0.5
"""Mean seconds between blinks, and standard deviation of their logarithm."""
_PAUSE, _SOON = 0.25, 1.5
"""Seconds of silence that make a pause; a blink due within the second number moves to it."""
_CLOSING, _CLOSED, _OPENING = 0.08, 0.03, 0.17
_FIXATION, _SHORTEST = 1.4, 0.25
"""Mean and least seconds of a fixation."""
_REACH = (3.0, 1.5)
"""Standard deviation of fixations to the side and up, degrees."""


def rng_of(seed: int, *keys: str) -> np.random.Generator:
    """Return a generator that depends on the seed and the keys alone."""
    text = "\x1f".join((str(seed), *keys)).encode("utf-8", "surrogatepass")
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text).digest()[:16], "little"))


class Eyes:
    """Blinks and gaze for one stretch of time after the other.

    Args:
        seed: of what is drawn.
        item: name of the utterance; other names blink at other times.
    """

    def __init__(self, seed: int, item: str = "") -> None:
        self._blinks, self._looks = (rng_of(seed, item, what) for what in ("blinks", "gaze"))
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
                self._look()
            values[i, 0] = _lids(self._blinking)
            way = smoothstep(min(self._moving / self._duration, 1.0))
            values[i, 1:] = self._from + way * (self._to - self._from)
        return values

    def _gap(self) -> float:
        gap = self._blinks.lognormal(math.log(_GAP) - _SPREAD**2 / 2, _SPREAD)
        return max(gap, _CLOSING + _CLOSED + _OPENING)

    def _fixation(self) -> float:
        return _SHORTEST + self._looks.exponential(_FIXATION - _SHORTEST)

    def _look(self) -> None:
        """Begin a saccade to the next fixation."""
        self._from = self._to
        self._to = self._looks.standard_normal(2).clip(-2.5, 2.5) * _REACH
        self._duration = 0.025 + 0.0022 * float(np.linalg.norm(self._to - self._from))
        self._moving, self._until_look = 0.0, self._fixation()


def _lids(seconds: float) -> float:
    """Return how far lids are closed, seconds after a blink began."""
    closed = min(seconds / _CLOSING, 1.0)
    opened = min(max((seconds - _CLOSING - _CLOSED) / _OPENING, 0.0), 1.0)
    return float(smoothstep(closed) - smoothstep(opened))
