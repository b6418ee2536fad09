"""Mouth shapes from phones: visemes, coarticulation and lip closures.

Targets follow the viseme groups of MPEG-4 (ISO/IEC 14496-2, table C-1) and the height and rounding
of vowels in the chart of the IPA. They are blended by each phone's dominance over the lips (Cohen
and Massaro, "Modeling coarticulation in synthetic visual speech", 1993), so that phones made by the
tongue alone leave the lips to their neighbours. After Edwards et al. ("JALI", SIGGRAPH 2016), lips
close at every p, b and m, the lower lip meets the teeth at f and v, sibilants narrow the jaw, and
loud vowels open it further.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from gesturekit.face.eyes import RATE
from gesturekit.motion.resampling import smoothstep

MOUTH = ("jawOpen", "mouthClose", "mouthFunnel", "mouthPucker", "mouthRollLower", "mouthRollUpper")
_MOUTH_SIDES = ("mouthPress", "mouthStretch", "mouthLowerDown", "mouthUpperUp")
SHAPES = (*MOUTH, *_MOUTH_SIDES)
"""Shapes of the mouth in the order of their columns; the last four have a left and a right."""
_EYES = ("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp")
_SIDED = [name + side for name in (*_MOUTH_SIDES, *_EYES) for side in ("Left", "Right")]
NAMES = (*MOUTH, *_SIDED)
"""Names of the columns of `channels`."""
_FULL_LOOK = 30.0
"""Degrees of gaze at which ARKit's eyeLook shapes are 1."""


def channels(mouth: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    """Return the values (T, E) of the channels NAMES.

    Args:
        mouth: (T, S) values of SHAPES.
        eyes: (T, 3) lids, gaze to the person's left and up in degrees, from `Eyes`.
    """
    middle = len(MOUTH)
    lids, left, up = eyes[:, 0], eyes[:, 1] / _FULL_LOOK, eyes[:, 2] / _FULL_LOOK
    pairs = [np.repeat(mouth[:, middle:], 2, axis=1), lids, lids, -up, -up]
    pairs += [-left, left, left, -left, up, up]  # the left eye looks in to the right
    return np.column_stack([mouth[:, :middle], *pairs]).clip(0.0, 1.0)


class Phone(NamedTuple):
    """A phone of ARPAbet, such as AA, P or SIL, and when it is spoken, seconds."""

    name: str
    start: float
    end: float


_LIPS = ("mouthFunnel", "mouthPucker", "mouthStretch", "mouthLowerDown", "mouthUpperUp")
# Phones: targets of jawOpen and of _LIPS, then dominance over the lips, all in hundredths.
_TABLE = """
    AA         65  0  0  0 30 10 80
    AE         55  0  0 20 35 15 80
    AH         40  0  0  0 20  5 50
    AO         50 40  0  0 10  5 100
    EH         45  0  0 15 25 10 80
    ER         25 25 15  0 10  5 80
    IH         28  0  0 20 20  5 60
    IY         18  0  0 35 20 10 80
    UH         28 25 25  0  5  0 90
    UW         18 20 60  0  0  0 100
    W          12 10 65  0  0  0 100
    R          18 25 15  0 10  5 50
    Y          18  0  0 20 15  5 30
    L          22  0  0  0 15  0 15
    T_D_N      14  0  0  0 15  0 10
    K_G_NG     25  0  0  0 10  0 10
    S_Z         6  0  0 20 25 10 40
    SH_ZH_CH_JH 8 50 15  0 20 15 90
    TH_DH      14  0  0  0 20  5 30
    F_V        10  0  0  0  0 10 60
    P_B_M       8  0  0  0  0  0 50
    HH         30  0  0  0 10  0 5
"""
_ROWS = [line.split() for line in _TABLE.strip().splitlines()]
_VISEMES = {phone: np.array(row[1:], float) / 100 for row in _ROWS for phone in row[0].split("_")}
_DIPHTHONGS = {"AY": "AA IH", "AW": "AA UH", "OY": "AO IH", "EY": "EH IH", "OW": "AO UH"}
_JAW_WIDTH, _LIP_WIDTH = 4.0, 6.0
"""Standard deviation of the window that blends phones, hundredths of a second."""
_ANY_PHONE = 0.33
"""Added to all targets of the jaw: half of its opening follows the sound, half the phone."""
_CLOSING = 0.05
"""Seconds in which lips close and open."""
_SPOKEN = 0.15
"""Seconds around sound in which lips move; phones elsewhere were found in noise."""


def mouth_of_phones(phones: Iterable[Phone], openness: np.ndarray, hold: float) -> np.ndarray:
    """Return mouth shapes (T, S) of phones, 100 a second.

    Args:
        phones: by time; other names than ARPAbet's count as silence.
        openness: (T,) 0 to 1, of the sound (`mouth_of_sound`); where it is 0 the mouth is closed.
        hold: seconds that a closure lasts at least; more than the time between two frames of the
            face, or some closures would not be seen.
    """
    n = len(openness)
    jaw, lips, dominance = np.zeros(n), np.zeros((n, len(_LIPS))), np.full((n, 1), 0.5)
    closed, teeth = np.zeros(n), np.zeros(n)
    for name, start, end in phones:
        parts = _DIPHTHONGS.get(name, name).split()
        edges = np.rint(np.linspace(start, end, len(parts) + 1) * RATE).astype(int)
        for part, first, last in zip(parts, edges, edges[1:]):
            if part in _VISEMES:
                row, span = _VISEMES[part], slice(first, max(last, first + 1))
                jaw[span] = (row[0] + _ANY_PHONE) / 1.5
                lips[span], dominance[span] = row[1:-1], row[-1]
        if name in ("P", "B", "M"):
            _close(closed, start, max(end - 0.01, start + hold))
        if name in ("F", "V"):
            _close(teeth, start, max(end, start + hold))
    jaw = gaussian_filter1d(jaw * openness, _JAW_WIDTH) * (1 - 0.6 * closed) * (1 - 0.5 * teeth)
    total = gaussian_filter1d(lips * dominance, _LIP_WIDTH, axis=0)
    lips = total / gaussian_filter1d(dominance, _LIP_WIDTH, axis=0)
    mouth = {"jawOpen": jaw, "mouthClose": jaw * np.maximum(closed, 0.6 * teeth)}
    mouth |= dict(zip(_LIPS, lips.T * (1 - closed), strict=True))
    mouth["mouthLowerDown"] *= 1 - teeth
    mouth |= {"mouthPress": 0.3 * closed, "mouthRollUpper": 0.1 * closed}
    mouth["mouthRollLower"] = 0.1 * closed + 0.5 * teeth
    spoken = maximum_filter1d((openness > 0).astype(float), 2 * round(_SPOKEN * RATE) + 1)
    spoken = gaussian_filter1d(spoken, _JAW_WIDTH)
    return np.stack([mouth[name] * spoken for name in SHAPES], axis=1)


def _close(closed: np.ndarray, start: float, end: float) -> None:
    """Raise a curve (T,) of closure to 1 from start to end, with ramps outside of these."""
    first = max(math.floor((start - _CLOSING) * RATE), 0)
    times = np.arange(first, min(math.ceil((end + _CLOSING) * RATE) + 1, len(closed))) / RATE
    away = np.maximum(np.maximum(start - times, times - end), 0.0) / _CLOSING
    near = closed[first : first + len(times)]
    np.maximum(near, 1 - smoothstep(away.clip(0.0, 1.0)), out=near)
