"""Mouth from phones: visemes, coarticulation and lip closures.

Targets follow the viseme groups of MPEG-4 (ISO/IEC 14496-2, table C-1) and the height and rounding
of vowels in the IPA chart. They are blended by dominance (Cohen and Massaro, "Modeling
coarticulation in synthetic visual speech", 1993): a phone counts while it lasts, and fades to both
sides. After Edwards et al. ("JALI", SIGGRAPH 2016), lips close at every p, b and m, the lower lip
meets the teeth at f and v, sibilants narrow the jaw, rounding begins early, and phones made by the
tongue alone leave the lips to their neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from gesturekit.face.channels import SHAPES
from gesturekit.face.eyes import RATE
from gesturekit.motion.resampling import smoothstep


class Phone(NamedTuple):
    """A phone of ARPAbet, such as AA, P or SIL, and when it is spoken, seconds."""

    name: str
    start: float
    end: float


_BLENDED = ("jawOpen", "mouthFunnel", "mouthPucker", "mouthStretch", "mouthLowerDown")
_BLENDED += ("mouthUpperUp",)
# Phones: targets of _BLENDED in hundredths, then dominance over the jaw and over the lips.
_TABLE = """
    AA         65  0  0  0 30 10 100 80
    AE         55  0  0 20 35 15 100 80
    AH         40  0  0  0 20  5 100 50
    AO         50 40  0  0 10  5 100 100
    EH         45  0  0 15 25 10 100 80
    ER         25 25 15  0 10  5 80 80
    IH         28  0  0 20 20  5 80 60
    IY         18  0  0 35 20 10 80 80
    UH         28 25 25  0  5  0 80 90
    UW         18 20 60  0  0  0 80 100
    W          12 10 65  0  0  0 60 100
    R          18 25 15  0 10  5 40 50
    Y          18  0  0 20 15  5 40 30
    L          22  0  0  0 15  0 40 15
    T_D_N      14  0  0  0 15  0 50 10
    K_G_NG     25  0  0  0 10  0 25 10
    S_Z         6  0  0 20 25 10 90 40
    SH_ZH_CH_JH 8 50 15  0 20 15 90 90
    TH_DH      14  0  0  0 20  5 60 30
    F_V        10  0  0  0  0 10 60 60
    P_B_M       8  0  0  0  0  0 60 50
    HH         30  0  0  0 10  0 10 5
    SIL         0  0  0  0  0  0 100 100
"""
_ROWS = [line.split() for line in _TABLE.strip().splitlines()]
VISEMES = {phone: np.array(row[1:], float) / 100 for row in _ROWS for phone in row[0].split("_")}
_DIPHTHONGS = {"AY": "AA IH", "AW": "AA UH", "OY": "AO IH", "EY": "EH IH", "OW": "AO UH"}
_FADE, _EARLY = 0.06, 0.1
"""Seconds in which a phone's dominance falls to 1/e; for rounded lips, before the phone."""
_CLOSING = 0.05
"""Seconds in which lips close and open."""


def mouth_of(phones: Iterable[Phone], n: int, hold: float) -> np.ndarray:
    """Return the shapes of the mouth (n, S), 100 a second.

    Args:
        phones: by time; other names than ARPAbet's count as silence.
        n: number of frames.
        hold: seconds that a closure lasts at least; more than the time between two frames of the
            face, or some closures would not be seen.
    """
    times = np.arange(n) / RATE
    total, weights = np.zeros((n, len(_BLENDED))), np.full((n, len(_BLENDED)), 1e-3)
    lips, teeth = np.zeros(n), np.zeros(n)
    for name, start, end in phones:
        parts = _DIPHTHONGS.get(name, name).split()
        edges = np.linspace(start, end, len(parts) + 1)
        for part, begin, stop in zip(parts, edges, edges[1:]):
            _blend(total, weights, times, Phone(part, begin, stop))
        if name in ("P", "B", "M"):
            _close(lips, times, start, max(end - 0.01, start + hold))
        if name in ("F", "V"):
            _close(teeth, times, start, max(end, start + hold))
    curves = dict(zip(_BLENDED, (total / weights).T, strict=True))
    jaw = curves["jawOpen"] * (1 - 0.6 * lips) * (1 - 0.5 * teeth)
    mouth = dict.fromkeys(SHAPES, np.zeros(n)) | curves | {"jawOpen": jaw}
    mouth["mouthClose"] = jaw * np.maximum(lips, 0.6 * teeth)
    mouth["mouthPress"] = 0.3 * lips
    mouth["mouthRollUpper"], mouth["mouthRollLower"] = 0.1 * lips, 0.1 * lips + 0.5 * teeth
    for name in ("mouthLowerDown", "mouthUpperUp", "mouthFunnel"):
        mouth[name] = curves[name] * (1 - lips)
    mouth["mouthLowerDown"] *= 1 - teeth
    return np.stack([mouth[name] for name in SHAPES], axis=1)


def _blend(total: np.ndarray, weights: np.ndarray, times: np.ndarray, phone: Phone) -> None:
    """Add a phone's targets by its dominance, and the dominance."""
    row = VISEMES.get(phone.name, VISEMES["SIL"])
    targets, jaw, lips = row[:-2], row[-2], row[-1]
    reach = 5 * _EARLY
    near = slice(*np.searchsorted(times, [phone.start - reach, phone.end + reach]))
    before = np.maximum(phone.start - times[near], 0.0)[:, None]
    after = np.maximum(times[near] - phone.end, 0.0)[:, None]
    rounded = targets[1:3].max() > 0.2
    early = np.where(np.arange(len(targets)) == 0, _FADE, _EARLY if rounded else _FADE)
    strength = np.where(np.arange(len(targets)) == 0, jaw, lips)
    dominance = strength * np.exp(-before / early - after / _FADE)
    total[near] += dominance * targets
    weights[near] += dominance


def _close(closed: np.ndarray, times: np.ndarray, start: float, end: float) -> None:
    """Raise a curve (T,) of closure to 1 from start to end, with ramps outside of these."""
    near = slice(*np.searchsorted(times, [start - _CLOSING, end + _CLOSING]))
    away = np.maximum(np.maximum(start - times[near], times[near] - end), 0.0)
    np.maximum(closed[near], 1 - smoothstep((away / _CLOSING).clip(0, 1)), out=closed[near])
