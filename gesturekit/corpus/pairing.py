"""Pairing of sound and motion files: by relative path, by unique stem, then by similar names."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gesturekit.corpus.checks import Problem
from gesturekit.errors import CorpusError
from gesturekit.formats.sources import (
    SPEECH_SUFFIXES,
    motions_here,
    one_of_two_formats,
    unreadable_media,
    visible_folders,
)
from gesturekit.wording import counted, listed

# Words at the end of a name that only say what kind of file it is: "take1_audio", "take1_mocap".
_KINDS = (
    *("audio", "sound", "speech", "voice", "mic", "wav"),
    *("motion", "mocap", "skeleton", "body", "anim", "animation", "bvh"),
)


_MOST_COMPARED = 1_000_000  # pairs of unpaired files whose names are compared


@dataclass(frozen=True, order=True)
class Found:
    """A file found in a folder. `key` is its path within the folder without extension."""

    key: str
    path: Path
    folder: Path

    @property
    def stem(self) -> str:
        """The last part of the key."""
        return self.key.rpartition("/")[2]

    @property
    def is_speech(self) -> bool:
        """True for a sound file, False for a motion file."""
        return _is_speech(self.path)


def _is_speech(path: Path) -> bool:
    return path.suffix.lower() in SPEECH_SUFFIXES


@dataclass
class Pairing:
    """Pairs of sound and motion, unpaired files, and ambiguous names as problems."""

    pairs: list[tuple[Found, Found]] = field(default_factory=list)
    speech: list[Found] = field(default_factory=list)
    motion: list[Found] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)


def scan(folder: str | os.PathLike[str]) -> tuple[list[Found], list[Problem]]:
    """Find all speech (`SPEECH_SUFFIXES`) and motion (bvh, npz) files below a folder, sorted.

    A folder that is an EasyMocap sequence counts as one motion file. Hidden files and folders, and
    npz files of features and body models are skipped. If a motion exists as STEM.bvh and STEM.npz,
    one of them is found. Links to folders are followed once.

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

    for here, folders, files in visible_folders(folder, unreadable):
        for path in (*filter(_is_speech, files), *motions_here(here, folders, files)):
            named = path if path is here else path.with_suffix("")
            key = folder.name if path == folder else named.relative_to(folder).as_posix()
            if not key.isprintable():
                # Also names that are not UTF-8: Python holds their bytes as lone surrogates.
                problems.append(
                    Problem(
                        "error",
                        Path(ascii(str(path))),
                        "the file name is not printable text; rename it",
                    )
                )
            else:
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
    (`wav/a/x.wav` with `bvh/a/x.bvh` for the folders `wav` and `bvh`), then by stem, and finally by
    names that differ in case, separators or a last word like "audio", with a warning. A name of
    more than one speech or motion file is a problem that lists them all; none of them is paired.
    """
    result = Pairing()
    left: list[Found] = []
    for files in scans:
        left += _match(list(files), lambda found: found.key, result)
    left = _match(left, lambda found: found.key, result)
    left = _match(left, lambda found: found.stem, result)
    n_exact = len(result.pairs)
    for name_of in (_loose_key, lambda found: _loose_key(found).rpartition("/")[2]):
        left = _match(left, name_of, result, ambiguous_is_error=False)
    if similar := [f"{a.path.name} with {b.path.name}" for a, b in result.pairs[n_exact:]]:
        text = f"{counted(len(similar), 'pair')} of similar names, not the same: "
        result.problems.append(Problem("warning", None, text + listed(sorted(similar), 4)))
    result.pairs.sort()
    result.speech = sorted(found for found in left if found.is_speech)
    result.motion = sorted(found for found in left if not found.is_speech)
    if len(result.speech) * len(result.motion) <= _MOST_COMPARED and (
        near := list(_near_names(result))
    ):
        text = f"not paired, but of near names: {listed(near, 4)}; rename one of each"
        result.problems.append(Problem("warning", None, text))
    return result


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


def _near_names(result: Pairing) -> Iterator[str]:
    """Yield unpaired sound and motion of which one name has all words of the other, and more."""
    moves = [(motion, set(_loose(motion.stem).split())) for motion in result.motion]
    for sound in result.speech:
        words = set(_loose(sound.stem).split())
        for motion, others in moves:
            if words <= others or others <= words:
                yield f"{sound.path.name} and {motion.path.name}"


def _loose_key(found: Found) -> str:
    """Return the key with loose names: "s1/take 1" of "s1/Take_1_audio"."""
    return "/".join(map(_loose, found.key.split("/")))


def _loose(name: str) -> str:
    """Return a name without case and separators, and without a last word of `_KINDS`."""
    words = re.findall(r"\w+", unicodedata.normalize("NFC", name).casefold().replace("_", " "))
    return " ".join(words[:-1] if len(words) > 1 and words[-1] in _KINDS else words) or name


def _match(
    files: list[Found],
    name_of: Callable[[Found], str],
    result: Pairing,
    ambiguous_is_error: bool = True,
) -> list[Found]:
    """Move pairs and, if they are errors, ambiguous names into `result`; return the other files."""
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
        elif not ambiguous_is_error:
            left += group
        else:
            files_found = ", ".join(str(found.path) for found in sorted(group))
            result.problems.append(
                Problem(
                    "error",
                    None,
                    f"{name!r} is ambiguous, left out: {len(speech)} speech and {len(motion)} "
                    f"motion files fit it; keep one of each: {files_found}",
                )
            )
    return left
