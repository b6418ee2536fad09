"""Words as features: when they are spoken, the pauses between them, and their rate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from audio_features.errors import FeatureError
from audio_features.track import FeatureTrack
from audio_features.wave import Wave
from audio_features.words import SUFFIXES, Word, load_words, words_beside

RATE = 100
"""Frames per second; frame k is at k/100 s."""

_RATE_SPREAD = 0.5  # seconds, standard deviation


class Words:
    """Times of words from a word list beside the recording: STEM.TextGrid, .ctm, .words.json, ….

    Columns: `word` is 1 while a word is spoken; `word_onset` is 1 in the frame in which one
    begins; `word_gap` is ln(1 + seconds) of the pause around the frame, 0 within words;
    `word_rate` is the number of words per second, smoothed by a Gaussian of 0.5 s.

    The list is `wave.words` or, without it, the one beside `wave.source`; `wave.offset` is the
    time of the first sample in it. Silence needs none.
    """

    names = ("word", "word_onset", "word_gap", "word_rate")
    dim = len(names)
    centred = (False,) * dim
    spec: dict[str, Any] = {"kind": "words"}
    worth_caching = False  # the sound does not determine the words

    def extract(self, wave: Wave) -> FeatureTrack:
        """Extract the features of a recording's words: values (T, 4).

        Raises FeatureError if there is no word list, or it cannot be read.
        """
        n_frames = max(1, wave.n_frames(RATE))
        values = _values(words_of(wave), n_frames)
        return FeatureTrack(values, np.arange(n_frames) / RATE, self.spec, self.names)

    def __repr__(self) -> str:
        return "Words()"


def takes_words(extractor: Any) -> bool:
    """Return whether an extractor, or one of a stack, reads the words of a recording."""
    parts = getattr(extractor, "parts", (extractor,))
    return any(part.spec["kind"] == "words" for part in parts)


def words_of(wave: Wave) -> list[Word]:
    """Return the words of a recording, in seconds from the first sample of the wave.

    Raises FeatureError if there is no word list beside a sound, or it cannot be read.
    """
    file = wave.words
    if file is None and wave.source is not None:
        file = words_beside(wave.source)
    if file is None and not wave.is_silent:
        raise FeatureError(
            f"{wave.source or 'the sound'}: no word list beside it: words need "
            f"{', '.join(f'STEM{suffix}' for suffix in SUFFIXES)}"
        )
    words = () if file is None else load_words(Path(file))
    return [Word(word.start - wave.offset, word.end - wave.offset, word.text) for word in words]


def frames_of(word: Word, rate: int) -> slice:
    """Return the frames during which a word is spoken, at least one; none before the first sample.

    Frame k stands for the time from (k - 1/2)/rate s to (k + 1/2)/rate s.
    """
    first, last = (int(np.floor(rate * time + 0.5)) for time in (word.start, word.end))
    return slice(max(first, 0), max(last, first + 1, 0))


def _values(words: list[Word], n_frames: int) -> np.ndarray:
    from scipy.ndimage import gaussian_filter1d

    values = np.zeros((n_frames, Words.dim), np.float32)
    spoken, onsets = values[:, 0], values[:, 1]
    pauses, done = [], 0.0
    for word in words:
        spoken[frames_of(word, RATE)] = 1.0
        first = int(np.floor(RATE * word.start + 0.5))
        if 0 <= first < n_frames:
            onsets[first] = 1.0
        pauses.append((done, word.start))
        done = max(done, word.end)
    pauses.append((done, n_frames / RATE))
    for start, end in pauses:
        if end > start:
            inside = slice(max(0, int(np.floor(RATE * start + 0.5))), max(0, int(RATE * end + 1)))
            values[inside, 2] = np.log1p(end - start)
    values[:, 2] *= 1.0 - spoken
    values[:, 3] = gaussian_filter1d(onsets, _RATE_SPREAD * RATE, mode="constant") * RATE
    return values
