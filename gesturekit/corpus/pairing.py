"""Pairing of sound and motion files: by relative path, by unique stem, then by similar names."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count, product
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
class MediaFile:
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

    pairs: list[tuple[MediaFile, MediaFile]] = field(default_factory=list)
    speech: list[MediaFile] = field(default_factory=list)
    motion: list[MediaFile] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)


def scan(folder: str | os.PathLike[str]) -> tuple[list[MediaFile], list[Problem]]:
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
    media: list[MediaFile] = []
    problems: list[Problem] = []

    def unreadable(error: OSError) -> None:
        text = f"cannot open folder: {error.strerror}"
        problems.append(Problem("error", Path(error.filename), text))

    for here, folders, files in visible_folders(folder, unreadable):
        for path in (*filter(_is_speech, files), *motions_here(here, folders, files)):
            named = path if path is here else path.with_suffix("")
            key = folder.name if path == folder else named.relative_to(folder).as_posix()
            if key.isprintable():
                media.append(MediaFile(key, path, folder))
            else:
                # Also names that are not UTF-8: Python holds their bytes as lone surrogates.
                text = "the file name is not printable text; rename it"
                problems.append(Problem("error", Path(ascii(str(path))), text))
    copies, lines = one_of_two_formats(file.path for file in media if not file.is_speech)
    problems += [Problem("note", None, line) for line in lines]
    return sorted(file for file in media if file.path not in copies), problems


def unread(folder: str | os.PathLike[str]) -> list[Path]:
    """Return the files below a folder that look like sound or motion and are not read, sorted."""
    below = visible_folders(Path(folder), lambda error: None)  # which `scan` reports
    return sorted(path for _, _, files in below for path in files if unreadable_media(path))


def pair(scans: Sequence[Iterable[MediaFile]]) -> Pairing:
    """Pair the files of one or more folders (one scan per folder).

    Files are paired by relative path without extension within a folder, then across folders
    (`wav/a/x.wav` with `bvh/a/x.bvh` for the folders `wav` and `bvh`), then by stem, and finally by
    names that differ in case, separators or a last word like "audio", with a warning. A name of
    more than one speech or motion file is a problem that lists them all; none of them is paired.
    """
    result = Pairing()
    left: list[MediaFile] = []
    for files in scans:
        left += _match(list(files), lambda file: file.key, result)
    left = _match(left, lambda file: file.key, result)
    left = _match(left, lambda file: file.stem, result)
    n_exact = len(result.pairs)
    for name_of in (_loose_key, lambda file: _loose_key(file).rpartition("/")[2]):
        left = _match(left, name_of, result, ambiguous_is_error=False)
    if similar := [f"{a.path.name} with {b.path.name}" for a, b in result.pairs[n_exact:]]:
        text = f"{counted(len(similar), 'pair')} of similar names, not the same: "
        result.problems.append(Problem("warning", None, text + listed(sorted(similar), 4)))
    result.pairs.sort()
    result.speech = sorted(file for file in left if file.is_speech)
    result.motion = sorted(file for file in left if not file.is_speech)
    few = len(result.speech) * len(result.motion) <= _MOST_COMPARED
    if few and (near := list(_near_names(result))):
        text = f"not paired, but of near names: {listed(near, 4)}; rename one of each"
        result.problems.append(Problem("warning", None, text))
    return result


def recording_ids(files: Sequence[MediaFile]) -> list[str]:
    """Return a unique id for each file: its key, prefixed by the folder's name if keys repeat."""
    counts, ids = Counter(file.key for file in files), dict[str, None]()
    for file in files:
        name = file.key
        if counts[name] > 1:
            name = f"{file.folder.resolve().name or 'root'}/{name}"
        numbered = (f"{name}_{n}" for n in count(2))
        ids[name if name not in ids else next(n for n in numbered if n not in ids)] = None
    return list(ids)


def _near_names(result: Pairing) -> Iterator[str]:
    """Yield unpaired sound and motion of which one name has all words of the other, and more."""
    words = {f: set(_loose(f.stem).split()) for f in [*result.speech, *result.motion]}
    for sound, motion in product(result.speech, result.motion):
        if words[sound] <= words[motion] or words[motion] <= words[sound]:
            yield f"{sound.path.name} and {motion.path.name}"


def _loose_key(file: MediaFile) -> str:
    """Return the key with loose names: "s1/take 1" of "s1/Take_1_audio"."""
    return "/".join(map(_loose, file.key.split("/")))


def _loose(name: str) -> str:
    """Return a name without case and separators, and without a last word of `_KINDS`."""
    words = re.findall(r"\w+", unicodedata.normalize("NFC", name).casefold().replace("_", " "))
    return " ".join(words[:-1] if len(words) > 1 and words[-1] in _KINDS else words) or name


def _match(
    files: list[MediaFile],
    name_of: Callable[[MediaFile], str],
    result: Pairing,
    ambiguous_is_error: bool = True,
) -> list[MediaFile]:
    """Move pairs and, if they are errors, ambiguous names into `result`; return the other files."""
    groups: dict[str, list[MediaFile]] = defaultdict(list)
    for file in files:
        groups[name_of(file)].append(file)
    left: list[MediaFile] = []
    for name, group in groups.items():
        speech = [file for file in group if file.is_speech]
        motion = [file for file in group if not file.is_speech]
        if len(speech) == len(motion) == 1:
            result.pairs.append((speech[0], motion[0]))
        elif not (speech and motion and ambiguous_is_error):
            left += group
        else:
            fitting = f"{len(speech)} speech and {len(motion)} motion files fit it"
            names = ", ".join(str(file.path) for file in sorted(group))
            text = f"{name!r} is ambiguous, left out: {fitting}; keep one of each: {names}"
            result.problems.append(Problem("error", None, text))
    return left
