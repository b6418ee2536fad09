"""Clicks and chords: a track of a steady tempo whose beats are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

RATE = 22050
"""Samples per second."""
BEATS_PER_BAR = 4
_KEYS = (0, 5, 7, 9)  # semitones of the four chords over the key
_TRIADS = ((0, 4, 7), (0, 4, 7), (0, 4, 7), (0, 3, 7))


@dataclass(frozen=True, eq=False)
class Track:
    """Sound, and when its beats are.

    Attributes:
        samples: (N,) in [-1, 1] at `RATE`.
        beats: (B,) seconds of all beats in it; the first is the first of a bar.
        tempo: beats per minute.
        has_offbeat: whether lighter clicks fall halfway between the beats.
    """

    samples: np.ndarray
    beats: np.ndarray
    tempo: float
    has_offbeat: bool


def play(seconds: float, tempo: float, has_offbeat: bool, rng: np.random.Generator) -> Track:
    """A track: a click on each beat, the louder on the first of a bar, and a chord for each bar."""
    beat = 60 / tempo
    beats = np.arange(rng.uniform(0.05, 0.05 + beat), seconds, beat)
    samples = 0.002 * rng.standard_normal(round(seconds * RATE))
    key = 110.0 * 2 ** (rng.integers(0, 12) / 12)
    for number, time in enumerate(beats):
        place = number % BEATS_PER_BAR
        _add(samples, time, _click(0.55 if place == 0 else 0.35, 0.03, rng))
        if has_offbeat:
            _add(samples, time + beat / 2, _click(0.12, 0.012, rng))
        if place == 0:
            chord = rng.integers(0, len(_KEYS))
            pitches = key * 2 ** ((_KEYS[chord] + np.array(_TRIADS[chord])) / 12)
            _add(samples, time, _chord(pitches, BEATS_PER_BAR * beat))
    return Track(0.8 * samples / np.abs(samples).max(), beats, tempo, has_offbeat)


def _add(samples: np.ndarray, time: float, sound: np.ndarray) -> None:
    start = round(time * RATE)
    part = samples[start : start + len(sound)]
    part += sound[: len(part)]


def _click(level: float, decay: float, rng: np.random.Generator) -> np.ndarray:
    """A burst of noise that dies away within `decay` seconds, and a low thud below it."""
    time = np.arange(round(0.25 * RATE)) / RATE
    noise = lfilter([1.0, -0.9], [1.0], rng.standard_normal(len(time))) * np.exp(-time / decay)
    thud = np.sin(2 * np.pi * 70 * time) * np.exp(-time / (3 * decay))
    return level * (0.5 * noise + thud)


def _chord(pitches: np.ndarray, seconds: float) -> np.ndarray:
    """Soft tones with three overtones each, struck and dying away."""
    time = np.arange(round(seconds * RATE)) / RATE
    tones = sum(
        np.sin(2 * np.pi * n * pitch * time) / n**2 for pitch in pitches for n in range(1, 5)
    )
    return 0.06 * tones * np.minimum(time / 0.02, 1.0) * np.exp(-time / (0.5 * seconds))
