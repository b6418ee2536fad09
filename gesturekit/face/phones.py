"""English phones of speech, by PocketSphinx (BSD licence) and its model of US English."""

from __future__ import annotations

import logging
import re
from contextlib import suppress
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
    if transcript and (phones := _aligned(pocketsphinx, speech, openness, transcript)):
        return phones
    lm = pocketsphinx.get_model_path("en-us/en-us-phone.lm.bin")
    settings = {"beam": 1e-20, "pbeam": 1e-20, "lw": 2.0}  # of PocketSphinx's documentation
    decoder = pocketsphinx.Decoder(allphone=lm, lm=None, dict=None, loglevel="FATAL", **settings)
    phones, pcm = [], _pcm(speech)
    for start, stop in _pieces(speech.duration, openness):
        _decode(decoder, pcm[round(start * _RATE) : round(stop * _RATE)])
        parts = decoder.seg() or ()
        phones += [_phone(part.word, part.start_frame, part.end_frame + 1, start) for part in parts]
    return phones


def _pcm(speech: Wave) -> np.ndarray:
    """Return 16-bit samples with noise, because PocketSphinx loses its way in digital silence."""
    samples = speech.samples * 32767.0
    samples += _NOISE * np.random.default_rng(0).standard_normal(len(samples), np.float32)
    return samples.clip(-32768, 32767).astype(np.int16)


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


def _aligned(pocketsphinx: Any, speech: Wave, openness: np.ndarray, transcript: str) -> list[Phone]:
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
        # A search for the best path in the lattice of an aligned text fails for some sounds.
        decoder = pocketsphinx.Decoder(lm=None, bestpath=False, loglevel="FATAL")
        unknown = [word for word in dict.fromkeys(words) if decoder.lookup_word(word) is None]
        for word in unknown:
            sounds = [_LETTERS[letter] for letter in word.replace("'", "")]
            decoder.add_word(word, " ".join(sounds), True)
        if unknown:
            text = "%s: not in the dictionary, read letter by letter: %s"
            log.warning(text, name, listed(unknown))
        with suppress(RuntimeError):
            phones = _align(decoder, " ".join(words), _pcm(speech))
            if _covered(phones, openness) >= _COVERED:
                return phones
            reason = "leaves much of the speech without words"
    how = "phones are found without it; face energy takes any language"
    log.warning("%s: the transcript %s; %s", name, reason, how)
    return []


def _covered(phones: list[Phone], openness: np.ndarray) -> float:
    """Return the share of the opening of the mouth (T,) that lies within phones."""
    inside = np.zeros(len(openness), bool)
    for name, start, end in phones:
        if name != "SIL":
            inside[round(start / _FRAME) : round(end / _FRAME)] = True
    return float(openness[inside].sum() / max(openness.sum(), 1e-9))


def _align(decoder: Any, text: str, pcm: np.ndarray) -> list[Phone]:
    """Return the phones of a text, found in two passes; raise RuntimeError if they fail."""
    decoder.set_align_text(text)
    _decode(decoder, pcm)
    decoder.set_alignment()
    _decode(decoder, pcm)
    phones = [phone for word in decoder.get_alignment() or () for phone in word]
    return [_phone(found.name, found.start, found.start + found.duration) for found in phones]
