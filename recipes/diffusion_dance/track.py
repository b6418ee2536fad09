"""Synthetic music: a track of clicks and chords with known beats and a drifting tempo.

With a constant tempo, a dance would fit its track just as well one beat later, and circular shifts
of the beats could not show whether a model uses the sound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

RATE = 22050
"""Samples per second."""
TEMPOS = (80.0, 150.0)
"""Beats per minute of the slowest and the fastest track."""
BEATS_PER_BAR = 4
DRIFT = 0.12
"""Largest relative deviation of the tempo over the track."""
_KEYS = (0, 5, 7, 9)  # semitones of the four chords over the key
_TRIADS = ((0, 4, 7), (0, 4, 7), (0, 4, 7), (0, 3, 7))


@dataclass(frozen=True, eq=False)
class Track:
    """A sound with its beats.

    Attributes:
        samples: (N,) in [-1, 1] at `RATE`.
        beats: (B,) times of all beats in seconds; the first one begins a bar.
        tempo: mean beats per minute.
        has_offbeat: whether there are softer clicks halfway between the beats.
    """

    samples: np.ndarray
    beats: np.ndarray
    tempo: float
    has_offbeat: bool


def play(seconds: float, tempo: float, has_offbeat: bool, rng: np.random.Generator) -> Track:
    """Make a track: a click on each beat, louder on the first of a bar, and a chord per bar."""
    fine = np.arange(0.0, seconds + 10.0, 0.01)
    drift = DRIFT * np.sin(2 * np.pi * (fine / rng.uniform(12.0, 25.0) + rng.random()))
    counted = np.cumsum(tempo / 60 * (1 + drift)) * 0.01 - rng.random() - 0.1
    halves = np.interp(np.arange(0.0, counted[-1], 0.5), counted, fine)
    beats, between = halves[::2], halves[1::2]
    samples = 0.002 * rng.standard_normal(round(seconds * RATE))
    key = 110.0 * 2 ** (rng.integers(0, 12) / 12)
    for number, time in enumerate(beats[beats < seconds]):
        bar = number % BEATS_PER_BAR == 0
        _add(samples, time, _click(0.55 if bar else 0.35, 0.03, rng))
        if bar:
            chord = rng.integers(0, len(_KEYS))
            pitches = key * 2 ** ((_KEYS[chord] + np.array(_TRIADS[chord])) / 12)
            _add(samples, time, _chord(pitches, beats[number + BEATS_PER_BAR] - time))
    if has_offbeat:
        for time in between[between < seconds]:
            _add(samples, time, _click(0.12, 0.012, rng))
    beats = beats[beats < seconds]
    mean = 60 / np.diff(beats).mean()
    return Track(0.8 * samples / np.abs(samples).max(), beats, float(mean), has_offbeat)


def _add(samples: np.ndarray, time: float, sound: np.ndarray) -> None:
    start = round(time * RATE)
    part = samples[start : start + len(sound)]
    part += sound[: len(part)]


def _click(level: float, decay: float, rng: np.random.Generator) -> np.ndarray:
    """Return a burst of noise and a low thud, which decay within about `decay` seconds."""
    time = np.arange(round(0.25 * RATE)) / RATE
    noise = lfilter([1.0, -0.9], [1.0], rng.standard_normal(len(time))) * np.exp(-time / decay)
    thud = np.sin(2 * np.pi * 70 * time) * np.exp(-time / (3 * decay))
    return level * (0.5 * noise + thud)


def _chord(pitches: np.ndarray, seconds: float) -> np.ndarray:
    """Return decaying tones with three overtones each."""
    time = np.arange(round(seconds * RATE)) / RATE
    tones = sum(
        np.sin(2 * np.pi * n * pitch * time) / n**2 for pitch in pitches for n in range(1, 5)
    )
    return 0.06 * tones * np.minimum(time / 0.02, 1.0) * np.exp(-time / (0.5 * seconds))
