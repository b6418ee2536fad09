"""Words with times: their lists (TextGrid, CTM, SRT, VTT, JSON, tsv), and features made of them.

The features are when words are spoken, the pauses between them, and their rate.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from audio_features.archive import read_bytes
from audio_features.errors import FeatureError
from audio_features.track import FeatureTrack
from audio_features.wave import Wave

SUFFIXES = (".TextGrid", ".ctm", ".words.json", ".srt", ".vtt", ".tsv")
"""Suffixes of the word lists that `words_beside` finds, in order of preference."""

_MAX_BYTES = 4 << 20  # more than a day of speech
_LONGEST = 7 * 24 * 3600.0
_TOKEN = re.compile(r'"(?:[^"]|"")*"|(?<!\S)(?:-?\d[\d.eE+-]*|<exists>)(?!\S)')
_CUE = re.compile(r"\s*([\d:.,]+)\s+-->\s+([\d:.,]+)")
_SILENCES = {"", "sil", "sp", "spn", "<eps>", "<sil>", "<unk>"}  # of aligners; nothing is said


@dataclass(frozen=True, order=True)
class Word:
    """A spoken word: seconds from the beginning of the recording, and its text.

    Examples:
        >>> af.Word(start=0.5, end=0.75, text="hello").text
        'hello'
    """

    start: float
    end: float
    text: str


def load_words(path: str | os.PathLike[str]) -> tuple[Word, ...]:
    """Read the words of a recording, in order of time.

    - TextGrid: the interval tier named "words" or "word", else the first interval tier;
    - CTM: lines of file, channel, start, duration, word;
    - SRT and VTT: the words of a caption share its time, in proportion to their letters;
    - JSON: a list of {"word", "start", "end"}, alone, under "words", "word_segments", or in
      "segments" (Whisper's output) or "metadata:transcript" (Seamless Interaction), where the
      words of a segment share its time if they have none;
    - tsv: lines of start, end, word, separated by tabs; # begins a mark of laughter.

    Empty intervals and an aligner's marks of silence are left out.

    Raises FeatureError if the file is missing, too large, or not such a list; with its line.

    Examples:
        >>> _ = (folder / "talk.ctm").write_text("talk 1 0.5 0.25 hello")
        >>> af.load_words(folder / "talk.ctm")
        (Word(start=0.5, end=0.75, text='hello'),)
    """
    path, words = Path(path), []
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise FeatureError(f"{path}: not a word list: give one of {', '.join(SUFFIXES)}")
    data = read_bytes(path, _MAX_BYTES, FeatureError)
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        for where, start, end, text in reader(data.decode(encoding)):
            word = Word(_seconds(where, start), _seconds(where, end), str(text).strip())
            if word.end < word.start:
                raise ValueError(f"{where}: ends at {word.end} s, before {word.start} s")
            words += [word] if word.text.lower() not in _SILENCES else []
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise FeatureError(f"{path}: not a list of words with times: {error}") from error
    return tuple(sorted(words))


def words_beside(path: str | os.PathLike[str]) -> Path | None:
    """Return the word list beside a recording, STEM with one of `SUFFIXES`, or None."""
    spellings = (s for suffix in SUFFIXES for s in (suffix, suffix.lower(), suffix.upper()))
    files = map(Path(path).with_suffix, spellings)
    return next((file for file in files if file.is_file()), None)


def _seconds(where: str, value: Any) -> float:
    try:
        seconds = float(value)
    except (TypeError, ValueError, OverflowError):
        seconds = math.nan
    if not 0 <= seconds <= _LONGEST:
        raise ValueError(f"{where}: time is {str(value)[:40]!r}: expected seconds from 0")
    return seconds


Entries = Iterator[tuple[str, Any, Any, Any]]
"""Place in the file, start, end, text."""


def _textgrid(text: str) -> Entries:
    tokens = [token.strip('"') if token[0] == '"' else token for token in _TOKEN.findall(text)]
    if tokens[:2] != ["ooTextFile", "TextGrid"]:
        raise ValueError("not a TextGrid in Praat's text format: save it as text")
    take, tiers = iter(tokens[5:]).__next__, []  # after the start, the end and <exists>
    try:
        for _ in range(int(take())):
            kind, name, _, _ = take(), take(), take(), take()
            size = 3 if kind == "IntervalTier" else 2
            rows = [[take() for _ in range(size)] for _ in range(int(take()))]
            tiers += [(name.strip().lower() in ("words", "word"), rows)] if size == 3 else []
    except StopIteration as error:
        raise ValueError("it ends in the middle of a tier") from error
    if not tiers:
        raise ValueError("no interval tier in it: words have a start and an end")
    for number, (start, end, mark) in enumerate(max(tiers, key=itemgetter(0))[1], start=1):
        yield f"interval {number}", start, end, mark.replace('""', '"')


def _rows(text: str, separator: str | None, columns: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the place and the cells of each line that has all columns."""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.startswith(";;"):
            cells = line.split(separator)
            if len(cells) <= columns.count(" "):
                raise ValueError(f"line {number}: expected {columns}")
            yield f"line {number}", cells


def _ctm(text: str) -> Entries:
    for where, cells in _rows(text, None, "file, channel, start, duration, word"):
        start = _seconds(where, cells[2])
        yield where, start, start + _seconds(where, cells[3]), cells[4]


def _tsv(text: str) -> Entries:
    for where, cells in _rows(text, "\t", "start, end, word"):
        if not cells[2].strip().startswith("#"):  # laughter, in GENEA's transcripts
            yield where, cells[0], cells[1], cells[2]


def _captions(text: str) -> Entries:
    lines = text.splitlines()
    cues = {number: cue for number, line in enumerate(lines, start=1) if (cue := _CUE.match(line))}
    if not cues and text.strip() not in ("", "WEBVTT"):
        raise ValueError("no caption in it: expected lines such as 00:00:01,000 --> …")
    for number, cue in cues.items():
        where = f"line {number}"
        start, end = (_clock(where, time) for time in cue.groups())
        said = []
        for following in range(number, len(lines)):
            if not lines[following].strip() or following + 1 in cues:
                break
            said += re.sub(r"<[^<>]*>|\{[^{}]*\}", " ", lines[following]).split()
        for word in _shared(said, start, end):
            yield where, *word


def _clock(where: str, text: str) -> float:
    """Return the seconds of [hours:]minutes:seconds, with a comma or a point."""
    seconds = 0.0
    for part in text.replace(",", ".").split(":"):
        seconds = 60 * seconds + _seconds(where, part)
    return seconds


def _json(text: str) -> Entries:
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not JSON: {error}") from error
    if isinstance(values, dict):
        segments = values.get("segments") or values.get("metadata:transcript") or []
        inside = [word for segment in segments for word in segment.get("words") or _spread(segment)]
        values = values.get("words") or values.get("word_segments") or inside
    for number, word in enumerate(values, start=1):
        said = word["word"] if "word" in word else word["text"]
        if "start" in word:  # WhisperX leaves the times of numerals out
            yield f"word {number}", word["start"], word["end"], said


def _spread(segment: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the words of a segment without times of its own."""
    said = str(segment.get("text") or segment.get("transcript") or "").split()
    times = _shared(said, float(segment["start"]), float(segment["end"]))
    return [{"word": word, "start": start, "end": end} for start, end, word in times]


def _shared(said: list[str], start: float, end: float) -> Iterator[tuple[float, float, str]]:
    """Yield (start, end, word) with the time shared in proportion to letters."""
    letters, at = sum(map(len, said)), start
    for word in said:
        stop = at + (end - start) * len(word) / letters
        yield at, stop, word
        at = stop


_READERS: dict[str, Callable[[str], Entries]] = {
    ".textgrid": _textgrid,
    ".ctm": _ctm,
    ".srt": _captions,
    ".vtt": _captions,
    ".json": _json,
    ".tsv": _tsv,
}


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

    Examples:
        A word from 0.5 to 0.75 s is not there at 0.4 s, and there at 0.6 s:

        >>> _ = (folder / "talk.ctm").write_text("talk 1 0.5 0.25 hello")
        >>> wave = af.Wave(np.zeros(16000), 16000, words=folder / "talk.ctm")
        >>> af.Words().extract(wave).at([0.4, 0.6]).values[:, 0]
        array([0., 1.], dtype=float32)
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
        from scipy.ndimage import gaussian_filter1d

        n_frames = wave.n_frames(RATE)
        values = np.zeros((n_frames, self.dim), np.float32)
        spoken, onsets, gaps, rate = values.T
        pauses, done = [], 0.0
        for word in words_of(wave):
            spoken[frames_of(word, RATE)] = 1.0
            first = int(np.floor(RATE * word.start + 0.5))
            if first >= 0:
                onsets[first : first + 1] = 1.0
            pauses.append((done, word.start))
            done = max(done, word.end)
        for start, end in [*pauses, (done, n_frames / RATE)]:
            if end > start:
                gaps[frames_of(Word(start, end, ""), RATE)] = np.log1p(end - start)
        gaps *= 1.0 - spoken
        rate[:] = gaussian_filter1d(onsets, _RATE_SPREAD * RATE, mode="constant") * RATE
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
        lists = ", ".join(f"STEM{suffix}" for suffix in SUFFIXES)
        raise FeatureError(f"{wave.source or 'the sound'}: no word list beside it: {lists}")
    words = () if file is None else load_words(Path(file))
    return [Word(word.start - wave.offset, word.end - wave.offset, word.text) for word in words]


def frames_of(word: Word, rate: int) -> slice:
    """Return the frames during which a word is spoken, at least one; none before the first sample.

    Frame k stands for the time from (k - 1/2)/rate s to (k + 1/2)/rate s.
    """
    first, last = (int(np.floor(rate * time + 0.5)) for time in (word.start, word.end))
    return slice(max(first, 0), max(last, first + 1, 0))
