"""English phones of speech, found by PocketSphinx (BSD licence) and its model of US English."""

from __future__ import annotations

import logging
import re
from string import ascii_lowercase
from typing import Any

import numpy as np

from audio_features import Wave
from gesturekit.errors import MotionError
from gesturekit.face.visemes import Phone
from gesturekit.wording import listed

log = logging.getLogger(__name__)

_RATE = 16_000
_FRAME = 0.01
_CENTRE = 0.008
"""Seconds from the beginning of a frame to where the phones of it and of the one before meet."""
_SHORTEST, _LONGEST = 10, 20
"""Seconds of sound that are searched at a time."""
_ALIGNED = 600
"""Seconds of the longest sound to which a transcript is aligned; memory grows with it."""
_FASTEST = 10
"""Words a second that nobody exceeds."""
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
    pcm = (speech.samples * 32767.0).clip(-32768, 32767).astype(np.int16)
    if transcript is not None:
        phones = _aligned(pocketsphinx, pcm, transcript)
        if phones:
            return phones
    lm = pocketsphinx.get_model_path("en-us/en-us-phone.lm.bin")
    settings = {"beam": 1e-20, "pbeam": 1e-20, "lw": 2.0}  # of PocketSphinx's documentation
    decoder = pocketsphinx.Decoder(allphone=lm, lm=None, dict=None, loglevel="FATAL", **settings)
    phones = []
    for start, stop in _pieces(len(pcm) / _RATE, openness):
        _decode(decoder, pcm[round(start * _RATE) : round(stop * _RATE)])
        phones += [
            _phone(found.word, found.start_frame, found.end_frame + 1, start)
            for found in decoder.seg() or ()
        ]
    return phones


def _decode(decoder: Any, pcm: np.ndarray) -> None:
    decoder.start_utt()
    decoder.process_raw(pcm.tobytes(), full_utt=True)
    decoder.end_utt()


def _phone(name: str, first: int, last: int, offset: float = 0.0) -> Phone:
    return Phone(name, offset + first * _FRAME + _CENTRE, offset + last * _FRAME + _CENTRE)


def _pieces(seconds: float, openness: np.ndarray) -> list[tuple[float, float]]:
    """Return (start, stop) of pieces of a sound, cut where it is quietest for 0.2 s."""
    cuts = [0.0]
    quiet = np.convolve(openness, np.ones(20), mode="same")
    while seconds - cuts[-1] > _LONGEST:
        first = round((cuts[-1] + _SHORTEST) / _FRAME)
        window = quiet[first : round((cuts[-1] + _LONGEST) / _FRAME)]
        cuts.append((first + int(window.argmin())) * _FRAME)
    return list(zip(cuts, [*cuts[1:], seconds], strict=True))


def _aligned(pocketsphinx: Any, pcm: np.ndarray, transcript: str) -> list[Phone]:
    """Return the phones of a transcript; none, with a warning, if it cannot be aligned."""
    words = re.findall(
        r"[a-z][a-z']*", transcript.lower().replace("\N{RIGHT SINGLE QUOTATION MARK}", "'")
    )
    seconds = len(pcm) / _RATE
    reason = None
    if not words:
        reason = "has no English words"
    elif seconds > _ALIGNED:
        reason = f"is for {seconds:.0f} s of sound, and at most {_ALIGNED} s can be aligned"
    elif len(words) > 10 + _FASTEST * seconds:
        reason = f"has {len(words)} words for {seconds:.1f} s of sound"
    else:
        decoder = pocketsphinx.Decoder(lm=None, loglevel="FATAL")
        unknown = [word for word in dict.fromkeys(words) if decoder.lookup_word(word) is None]
        for word in unknown:
            spelled = " ".join(_LETTERS[letter] for letter in word if letter in _LETTERS)
            decoder.add_word(word, spelled, True)
        if unknown:
            names = listed(unknown)
            log.warning("Not in the dictionary, read letter by letter: %s", names)
        try:
            decoder.set_align_text(" ".join(words))
            _decode(decoder, pcm)
            decoder.set_alignment()
            _decode(decoder, pcm)
            phones = [phone for word in decoder.get_alignment() for phone in word]
            return [_phone(p.name, p.start, p.start + p.duration) for p in phones]
        except (RuntimeError, TypeError):
            reason = "does not fit the sound"
    log.warning("The transcript %s; phones are found without it", reason)
    return []
