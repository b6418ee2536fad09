"""Mouth shapes of English speech: its phones, visemes, coarticulation and lip closures.

Phones are found by PocketSphinx (BSD licence) and its model of US English.

Targets follow the viseme groups of MPEG-4 (ISO/IEC 14496-2, table C-1) and the height and rounding
of vowels in the chart of the IPA. They are blended by each phone's dominance over the lips (Cohen
and Massaro, "Modeling coarticulation in synthetic visual speech", 1993), so that phones made by the
tongue alone leave the lips to their neighbours. After Edwards et al. ("JALI", SIGGRAPH 2016), lips
close at every p, b and m, the lower lip meets the teeth at f and v, sibilants narrow the jaw, and
loud vowels open it further.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable
from contextlib import suppress
from itertools import pairwise
from string import ascii_lowercase
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from audio_features import Wave
from audio_features.acoustic import SAMPLE_RATE
from gesturekit.errors import MotionError
from gesturekit.motion.resampling import smoothstep
from gesturekit.wording import listed

log = logging.getLogger(__name__)

RATE = 100
"""Values of curves per second."""
MOUTH = ("jawOpen", "mouthClose", "mouthFunnel", "mouthPucker", "mouthRollLower", "mouthRollUpper")
MOUTH_SIDES = ("mouthPress", "mouthStretch", "mouthLowerDown", "mouthUpperUp")
SHAPES = (*MOUTH, *MOUTH_SIDES)
"""Shapes of the mouth in the order of their columns; the last four have a left and a right."""


Phone = tuple[str, float, float]
"""A phone of ARPAbet, such as AA, P or SIL, and the seconds between which it is spoken."""

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
        openness: (T,) 0 to 1, of the sound; where it is 0 the mouth is closed.
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


_FRAME = 0.01
_CENTRE = 0.008
"""Seconds after the start of a frame at which a phone that begins with it is taken to begin."""
_SHORTEST, _LONGEST = 10, 20
"""Seconds of sound that are searched at a time."""
_ALIGNED = 120
"""Seconds of the longest sound to which a transcript is aligned; memory grows with the square."""
_NOISE = 20.0
"""Standard deviation of added noise, in steps of 16-bit sound."""
_COVERED = 0.8
"""Share of the opening of the mouth by the sound that must lie within the words of a transcript."""
_FASTEST = 60
"""Letters a second that nobody exceeds."""
_SOUNDS = "AE B K D EH F G HH IH JH K L M N AA P K R S T AH V W K Y Z"
_LETTERS = dict(zip(ascii_lowercase, _SOUNDS.split(), strict=True))
"""Sounds of letters, for words that are not in the dictionary."""


def phones_of(speech: Wave, openness: np.ndarray, transcript: str | None) -> list[Phone]:
    """Return the phones of English speech by time, and pauses as SIL.

    Args:
        speech: 16 kHz, at the standard level.
        openness: (T,) of the sound, 100 a second, from which places to cut are chosen.
        transcript: words that are spoken; aligned to the sound, if it can be.

    Raises:
        MotionError: PocketSphinx is not installed.
    """
    try:
        import pocketsphinx
    except ImportError as error:
        how = "pip install 'gesturekit[face]', or take method energy"
        raise MotionError(f"phones need pocketsphinx, which is not installed: {how}") from error
    # With noise, because PocketSphinx loses its way in digital silence.
    pcm = speech.samples * 32767.0
    pcm += _NOISE * np.random.default_rng(0).standard_normal(len(pcm), np.float32)
    pcm = pcm.clip(-32768, 32767).astype(np.int16)
    if transcript:
        # A search for the best path in the lattice of an aligned text fails for some sounds.
        decoder = pocketsphinx.Decoder(lm=None, bestpath=False, loglevel="FATAL")
        if phones := _aligned(decoder, speech, pcm, openness, transcript):
            return phones
    lm = pocketsphinx.get_model_path("en-us/en-us-phone.lm.bin")
    settings = {"beam": 1e-20, "pbeam": 1e-20, "lw": 2.0}  # of PocketSphinx's documentation
    decoder = pocketsphinx.Decoder(allphone=lm, lm=None, dict=None, loglevel="FATAL", **settings)
    # Pieces are cut where it is quietest for 0.2 s.
    cuts, quiet = [0.0], np.convolve(openness, np.ones(20), mode="same")
    while speech.duration - cuts[-1] > _LONGEST:
        first = round((cuts[-1] + _SHORTEST) / _FRAME)
        window = quiet[first : round((cuts[-1] + _LONGEST) / _FRAME)]
        cuts.append((first + int(window.argmin())) * _FRAME)
    phones = []
    for start, stop in pairwise([*cuts, speech.duration]):
        _decode(decoder, pcm[round(start * SAMPLE_RATE) : round(stop * SAMPLE_RATE)])
        parts = decoder.seg() or ()
        phones += [_phone(part.word, part.start_frame, part.end_frame + 1, start) for part in parts]
    return phones


def _decode(decoder: Any, pcm: np.ndarray) -> None:
    decoder.start_utt()
    decoder.process_raw(pcm.tobytes(), full_utt=True)
    decoder.end_utt()


def _phone(name: str, first: int, last: int, offset: float = 0.0) -> Phone:
    return name, offset + first * _FRAME + _CENTRE, offset + last * _FRAME + _CENTRE


def _aligned(
    decoder: Any, speech: Wave, pcm: np.ndarray, openness: np.ndarray, transcript: str
) -> list[Phone]:
    """Return the phones of a transcript; none, with a warning, if it cannot be aligned."""
    text = transcript.lower().replace("\N{RIGHT SINGLE QUOTATION MARK}", "'")
    words, seconds = re.findall(r"[a-z]+(?:'[a-z]+)*", text), speech.duration
    name, reason = speech.source or "the speech", "does not fit the sound"
    if not words:
        reason = "has no English words"
    elif seconds > _ALIGNED:
        reason = f"is for {seconds:.0f} s of sound, and at most {_ALIGNED} s can be aligned"
    elif (letters := sum(map(len, words))) > 100 + _FASTEST * seconds:
        reason = f"has {letters} letters for {seconds:.1f} s of sound"
    else:
        unknown = [word for word in dict.fromkeys(words) if decoder.lookup_word(word) is None]
        for word in unknown:
            sounds = [_LETTERS[letter] for letter in word.replace("'", "")]
            decoder.add_word(word, " ".join(sounds), True)
        if unknown:
            text = "%s: not in the dictionary, read letter by letter: %s"
            log.warning(text, name, listed(unknown))
        with suppress(RuntimeError):  # either of the two passes may fail
            decoder.set_align_text(" ".join(words))
            _decode(decoder, pcm)
            decoder.set_alignment()
            _decode(decoder, pcm)
            found = [phone for word in decoder.get_alignment() or () for phone in word]
            phones = [_phone(each.name, each.start, each.start + each.duration) for each in found]
            inside = np.zeros(len(openness), bool)
            for phone, start, end in phones:
                inside[round(start / _FRAME) : round(end / _FRAME)] |= phone != "SIL"
            if openness[inside].sum() >= _COVERED * openness.sum():
                return phones
            reason = "leaves much of the speech without words"
    how = "phones are found without it; face energy takes any language"
    log.warning("%s: the transcript %s; %s", name, reason, how)
    return []
