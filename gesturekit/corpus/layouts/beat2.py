"""BEAT2 (Liu et al. 2024): SMPL-X motion, speech, words and semantic scores of 25 speakers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from gesturekit.corpus.checks import Problem
from gesturekit.corpus.layouts.listing import Listing, existing, root_with, rows
from gesturekit.corpus.recording import Recording
from gesturekit.errors import CorpusError

_INDEX = "train_test_split.csv"
_SPLITS = {"train": "train", "val": "valid", "test": "test"}
_ID = re.compile(r"\d+_(?P<speaker>[^_/\\]+)_\d+_(?P<start>\d+)_\d+")
# Emotions by the number of the first sentence; the first 64 are neutral.
_EMOTIONS = (
    (65, 72, "happiness"),
    (73, 80, "anger"),
    (81, 86, "sadness"),
    (87, 94, "contempt"),
    (95, 102, "surprise"),
    (103, 110, "fear"),
    (111, 118, "disgust"),
)


def read_beat2(folder: Path) -> Listing:
    """Read a language's folder of BEAT2, such as beat_english_v2.0.0.

    The split of train_test_split.csv counts; its type `additional` is used by no split and left
    out. Style is the emotion, speaker the name in the id. Sound is often half a second longer than
    motion and is trimmed. Sounds of the test split need no motion to be rendered.

    Raises:
        CorpusError: train_test_split.csv is missing or invalid.
    """
    root = root_with(folder, [_INDEX], "BEAT2")
    listing = Listing(fps=30.0)
    types = _types(root / _INDEX, listing)
    absent: dict[str, list[str]] = {"npz file": [], "wav file": [], "TextGrid": [], "sem file": []}
    for name, split in types.items():
        match = _ID.fullmatch(name)
        if match is None or split not in _SPLITS:
            continue
        motion, audio = root / "smplxflame_30" / f"{name}.npz", root / "wave16k" / f"{name}.wav"
        sides = {
            "words": root / "textgrid" / f"{name}.TextGrid",
            "semantics": root / "sem" / f"{name}.txt",
        }
        for what, file in zip(absent, (motion, audio, *sides.values()), strict=True):
            if not file.is_file():
                absent[what].append(file.name)
        if audio.is_file() and (motion.is_file() or split == "test"):
            listing.recordings.append(
                Recording(
                    name,
                    audio=audio,
                    motion=motion if motion.is_file() else None,
                    speaker=match["speaker"],
                    style=_emotion(int(match["start"])),
                    split=_SPLITS[split],
                    conditions=existing(sides),
                )
            )
    for what, names in absent.items():
        severity = "error" if what in ("npz file", "wav file") else "note"
        listing.missing(what, names, root / _INDEX, severity)
    additional = [name for name, split in types.items() if split == "additional"]
    listing.note("of type additional, in no split and left out", additional, root / _INDEX)
    listing.left_over = [file for file in _files(root) if file.stem not in types]
    return listing


def _types(index: Path, listing: Listing) -> dict[str, str]:
    types: dict[str, str] = {}
    for where, row in rows(index, ("id", "type")):
        if row["type"] not in (*_SPLITS, "additional"):
            raise CorpusError(
                f"{where}: type is {row['type']!r}; expected train, val, test or additional"
            )
        if row["id"] in types:
            raise CorpusError(f"{where}: {row['id']!r} is listed twice; download the file again")
        if _ID.fullmatch(row["id"]) is None:
            text = f"{where}: id {row['id'][:60]!r} is no SPEAKER_NAME_TYPE_START_END; left out"
            listing.problems.append(Problem("error", index, text))
        types[row["id"]] = row["type"]
    return types


def _emotion(sentence: int) -> str:
    return next((name for low, high, name in _EMOTIONS if low <= sentence <= high), "neutral")


def _files(root: Path) -> Iterator[Path]:
    yield from sorted((root / "smplxflame_30").glob("*.npz"))
    yield from sorted((root / "wave16k").glob("*.wav"))
