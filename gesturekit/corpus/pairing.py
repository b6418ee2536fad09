"""Pairing of sound and motion files: by relative path, then by unique stem or similar stem."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gesturekit.corpus.problem import Problem
from gesturekit.errors import CorpusError
from gesturekit.formats.sources import (
    MOTION_SUFFIXES,
    SPEECH_SUFFIXES,
    is_motion,
    one_of_two_formats,
    unreadable_media,
    visible_folders,
)


@dataclass(frozen=True, order=True)
class Found:
    """A file found in a folder. `key` is its path within the folder without extension."""

    key: str
    path: Path
    folder: Path

    @property
    def stem(self) -> str:
        """The last part of the key."""
        return self.key.rsplit("/", 1)[-1]

    @property
    def is_speech(self) -> bool:
        """True for a sound file, False for a motion file."""
        return self.path.suffix.lower() in SPEECH_SUFFIXES


@dataclass
class Pairing:
    """Pairs of sound and motion, unpaired files, and ambiguous names as problems."""

    pairs: list[tuple[Found, Found]] = field(default_factory=list)
    speech: list[Found] = field(default_factory=list)
    motion: list[Found] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)


def scan(folder: str | os.PathLike[str]) -> tuple[list[Found], list[Problem]]:
    """Find all speech (`SPEECH_SUFFIXES`) and motion (bvh, npz) files below a folder, sorted.

    Hidden files and folders, and npz files of features and body models are skipped. If a motion
    exists as STEM.bvh and STEM.npz, one of them is found. Links to folders are followed once.

    Raises:
        CorpusError: there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        what = "is a file, not a folder" if folder.exists() else "no such folder"
        raise CorpusError(f"{folder}: {what}; give folders of recordings")
    found: list[Found] = []
    problems: list[Problem] = []

    def unreadable(error: OSError) -> None:
        problems.append(
            Problem("error", Path(error.filename), f"cannot open folder: {error.strerror}")
        )

    for _, _, files in visible_folders(folder, unreadable):
        for path in files:
            suffix = path.suffix.lower()
            is_speech = suffix in SPEECH_SUFFIXES
            if not (is_speech or suffix in MOTION_SUFFIXES):
                continue
            key = path.relative_to(folder).with_suffix("").as_posix()
            if not key.isprintable():
                # Also names that are not UTF-8: Python holds their bytes as lone surrogates.
                problems.append(
                    Problem(
                        "error",
                        Path(ascii(str(path))),
                        "the file name is not printable text; rename it",
                    )
                )
            elif is_speech or is_motion(path):
                found.append(Found(key, path, folder))
    copies, lines = one_of_two_formats(file.path for file in found if not file.is_speech)
    problems += [Problem("note", None, line) for line in lines]
    return sorted(file for file in found if file.path not in copies), problems


def unread(folder: str | os.PathLike[str]) -> list[Path]:
    """Return the files below a folder that look like sound or motion and are not read, sorted."""
    below = visible_folders(Path(folder), lambda error: None)  # which `scan` reports
    return sorted(path for _, _, files in below for path in files if unreadable_media(path))


def pair(scans: Sequence[Iterable[Found]]) -> Pairing:
    """Pair the files of one or more folders (one scan per folder).

    Files are paired by relative path without extension within a folder, then across folders
    (`wav/a/x.wav` with `bvh/a/x.bvh` for the folders `wav` and `bvh`), then by stem, then by a stem
    that differs in case and separators only, with a note. A name of more than one speech or motion
    file is a problem that lists them all; none of them is paired.
    """
    result = Pairing()
    left: list[Found] = []
    for files in scans:
        left += _match(list(files), lambda found: found.key, result)
    left = _match(left, lambda found: found.key, result)
    left = _match(left, lambda found: found.stem, result)
    n_exact = len(result.pairs)
    left = _match(left, lambda found: _plain(found.stem), result)
    result.problems += [
        Problem("note", speech.path, f"paired with {motion.path}, whose name is similar")
        for speech, motion in result.pairs[n_exact:]
    ]
    result.pairs.sort()
    result.speech = sorted(found for found in left if found.is_speech)
    result.motion = sorted(found for found in left if not found.is_speech)
    return result


def _plain(stem: str) -> str:
    """Return a stem without case, with one kind of separator and of accented letters."""
    letters = unicodedata.normalize("NFKC", stem).casefold()
    return re.sub(r"[\s_.-]+", " ", letters).strip()


def recording_ids(found: Sequence[Found]) -> list[str]:
    """Return a unique id for each file: its key, prefixed by the folder's name if keys repeat."""
    ids = [item.key for item in found]
    repeated = {key for key, n in Counter(ids).items() if n > 1}
    ids = [
        f"{item.folder.resolve().name or 'root'}/{item.key}" if item.key in repeated else item.key
        for item in found
    ]
    used: set[str] = set()
    for i, name in enumerate(ids):
        n = 1
        while ids[i] in used:
            n += 1
            ids[i] = f"{name}_{n}"
        used.add(ids[i])
    return ids


def _match(files: list[Found], name_of: Callable[[Found], str], result: Pairing) -> list[Found]:
    """Move pairs and ambiguities of equal names into `result`; return the other files."""
    groups: dict[str, list[Found]] = defaultdict(list)
    for found in files:
        groups[name_of(found)].append(found)
    left: list[Found] = []
    for name, group in groups.items():
        speech = [found for found in group if found.is_speech]
        motion = [found for found in group if not found.is_speech]
        if not speech or not motion:
            left += group
        elif len(speech) == len(motion) == 1:
            result.pairs.append((speech[0], motion[0]))
        else:
            listed = ", ".join(str(found.path) for found in sorted(group))
            result.problems.append(
                Problem(
                    "error",
                    None,
                    f"{name!r} is ambiguous, left out: {len(speech)} speech and {len(motion)} "
                    f"motion files fit it; keep one of each: {listed}",
                )
            )
    return left
