"""Inputs of a batch of sounds: files, folders, globs, lists and items of a manifest, as tasks.

A list is a file with one input a line:

| file | a line |
|---|---|
| `NAME.txt`, `NAME.lst`, `NAME.list` | path of a sound |
| `NAME.scp` (Kaldi's wav.scp) | id and path of a sound; commands (`sox ... \\|`) are never run |
| `NAME.jsonl` | object with `audio`, and optionally the fields of `FIELDS` |

Paths are relative to the list's folder or, if there is no such file, to the working folder. Results
are named by the id; without one, by the path as it is written in the list, or by the stem of a path
that is absolute or has `..`.

A task has in `more` the settings of its input alone: `seed`, `style`, `speaker` and `transcript`;
`start` and `seconds`, the interval of the sound, or the length without sound; `channel`. For an
item of a manifest it has only the `item`.
"""

from __future__ import annotations

import glob
import json
import logging
import math
import os
from collections.abc import Iterator, Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any

import soundfile

import audio_features as af
from audio_features.archive import read_bytes
from audio_features.wave import soundfile_name
from audio_features.words import load_words, words_beside
from gesturekit.corpus.manifest import Item, check_id
from gesturekit.errors import ConfigError, CorpusError
from gesturekit.formats.sources import (
    OTHER_SPEECH_SUFFIXES,
    SPEECH_SUFFIXES,
    VIDEO_SUFFIXES,
    unreadable_media,
    visible_folders,
)
from gesturekit.jobs.records import STATE
from gesturekit.jobs.result import Task
from gesturekit.wording import listed

LIST_SUFFIXES = (".txt", ".lst", ".list", ".scp", ".jsonl")
FIELDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("audio", "id", "style", "speaker", "transcript"), (str,)),
    **dict.fromkeys(("seed", "channel"), (int,)),
    **dict.fromkeys(("start", "seconds"), (int, float)),
}
"""Fields of a line of NAME.jsonl with their types; `seconds` and `start` are the interval of the
sound, and `seconds` alone is the length of a motion without sound."""
_MAX_LINE = 1 << 16
_MAX_TEXT = 1 << 20  # bytes of a transcript; hours of speech
_MAX_SECONDS = 4 * 3600  # the longest sound that is read

SoundSource = str | os.PathLike[str] | Item
"""A sound file, a folder of them, a glob, a list, or an item of a manifest."""

log = logging.getLogger(__name__)


def task_wave(task: Task, channel: int | None) -> af.Wave | None:
    """Read the sound of a task, cut to its interval; None without a sound.

    Raises:
        AudioError: the file cannot be read.
    """
    if task.path is None:
        return None
    if "item" in task.more:
        return task.more["item"].load_wave()
    start, seconds = task.more.get("start", 0.0), task.more.get("seconds")
    channel = task.more.get("channel", channel)
    return af.Wave.load(task.path, start=start, duration=seconds, channel=channel)


def task_words(task: Task) -> Path | None:
    """Return the word list of a task's item, or beside its sound."""
    if "item" in task.more and (given := task.more["item"].conditions.get("words")) is not None:
        return Path(given)
    return None if task.path is None else words_beside(task.path)


def task_transcript(task: Task) -> str | None:
    """Return the text that is spoken in a task's interval of its sound, if it is known.

    It is its item's own, that of the words within the interval (`task_words`), or that of NAME.txt
    beside a sound that is used whole.

    Raises:
        AudioFeaturesError: the words or the text cannot be read.
    """
    item, more = task.more.get("item"), task.more
    if task.path is None or (item is not None and item.text is not None):
        return item and item.text
    start = more.get("start", 0.0) if item is None else item.audio_start
    seconds = more.get("seconds", math.inf) if item is None else item.duration
    if (words := task_words(task)) is not None:
        inside = (w for w in load_words(words) if w.end > start and w.start < start + seconds)
        return " ".join(word.text for word in inside)
    beside = task.path.with_suffix(".txt")
    if item is not None or (start, seconds) != (0.0, math.inf) or not beside.is_file():
        return None
    return (
        read_bytes(beside, _MAX_TEXT, af.FeatureError).decode("utf-8-sig", "replace").strip()
        or None
    )


def find_tasks(sources: SoundSource | Sequence[SoundSource], out: Path) -> list[Task]:
    """List what to render.

    A folder stands for all sounds below it, which keep their relative path. Sounds of formats that
    cannot be decoded are tasks that fail, unless a readable sound of the same name lies beside
    them; videos are warned about. Hidden files and `out` itself are skipped.

    Args:
        sources: sound files, folders, globs such as "speech/**/*.wav", lists (see
            above), and items of a manifest, which are named by their ids;
            one of them, or several.
        out: folder for the results.

    Raises:
        ConfigError: a folder or glob without sound, an invalid list, or two sources that would
            write the same file.
    """
    if isinstance(sources, str | os.PathLike | Item):
        sources = [sources]
    tasks: dict[tuple[str, str], Task] = {}
    for source in sources:
        for task in _tasks_of(source, out):
            # A file that is named twice is rendered once.
            is_file = "item" not in task.more and task.error is None
            same = os.path.realpath(task.path) if task.path and is_file else task.source
            tasks.setdefault((same, task.id), task)
    _refuse_clashes(list(tasks.values()), out)
    return list(tasks.values())


def length_of(task: Task) -> float | None:
    """Return the seconds of a task's sound by its header, or of a motion without sound.

    None for a file that cannot be read.
    """
    if "item" in task.more:
        return task.more["item"].duration
    seconds = task.more.get("seconds")
    if task.path is None:
        return seconds
    if not task.path.is_file():  # reading a pipe may never end
        return None
    try:
        length = soundfile.info(soundfile_name(task.path)).duration
    except (RuntimeError, OSError, ValueError):  # its turn gives the reason
        return None
    if length > _MAX_SECONDS:
        return None  # a damaged header
    return max(0.0, min(length - task.more.get("start", 0.0), seconds or _MAX_SECONDS))


def _tasks_of(source: SoundSource, out: Path) -> Iterator[Task]:
    if isinstance(source, Item):
        yield Task(source.id, source.audio, more={"item": source}, source=source.id)
    elif Path(source).is_dir():
        yield from _below(Path(source), out)
    elif glob.has_magic(os.fspath(source)) and not os.path.lexists(source):
        yield from _matches_of_glob(str(source))
    elif Path(source).suffix.lower() in LIST_SUFFIXES:
        yield from read_list(Path(source))
    else:
        yield Task(Path(source).stem, Path(source))


def _below(folder: Path, out: Path) -> Iterator[Task]:
    trouble: list[OSError] = []
    videos: dict[str, list[str]] = {}
    is_empty = True
    results = os.path.realpath(out)
    for here, folders, files in visible_folders(folder, trouble.append):
        if os.path.realpath(here) == results != os.path.realpath(folder):
            folders.clear()
            continue
        readable = {path.stem for path in files if path.suffix.lower() in SPEECH_SUFFIXES}
        for path in files:
            suffix = path.suffix.lower()
            if suffix in VIDEO_SUFFIXES:
                videos.setdefault(unreadable_media(path) or "", []).append(str(path))
            elif suffix in SPEECH_SUFFIXES or (
                suffix in OTHER_SPEECH_SUFFIXES and path.stem not in readable
            ):
                is_empty = False
                name = path.relative_to(folder).with_suffix("").as_posix()
                yield Task(name, path)
    for error in trouble:
        where = str(error.filename or folder)
        yield Task("", source=where, error=f"{where}: {error.strerror}")
    for reason, names in videos.items():
        log.warning("%s: left out: %s", listed(names, 3), reason)
    if is_empty and not trouble:
        raise ConfigError(f"{folder}: the folder holds no audio files that can be read")


def _refuse_clashes(tasks: Sequence[Task], out: Path) -> None:
    seen: dict[str, Task] = {}
    clashes: list[Task] = []
    for task in tasks:
        if task.id.split("/")[0] == STATE:
            raise ConfigError(f"{task.source}: {STATE} in {out} is the folder of state; rename it")
        if task.error is None and seen.setdefault(task.id, task) is not task:
            clashes.append(task)
    if clashes:
        more = f" (and {len(clashes) - 1} more)" if len(clashes) > 1 else ""
        both = f"{seen[clashes[0].id].source} and {clashes[0].source}"
        where = f"would both be written as {out / clashes[0].id}{more}"
        raise ConfigError(f"{both} {where}; give a glob such as '*.wav', or ids in a .jsonl list")


def _matches_of_glob(pattern: str) -> Iterator[Task]:
    """Yield each sound that a pattern matches, named by its path below the pattern's fixed folder.

    Raises:
        ConfigError: it matches no sound.
    """
    base = Path(*takewhile(lambda part: not glob.has_magic(part), Path(pattern).parts[:-1]))
    paths = (Path(path) for path in sorted(glob.glob(pattern, recursive=True)))  # noqa: PTH207
    sounds = [path for path in paths if path.suffix.lower() in SPEECH_SUFFIXES and path.is_file()]
    if not sounds:
        raise ConfigError(f"{pattern}: no audio file matches this pattern")
    for path in sounds:
        yield Task(path.relative_to(base).with_suffix("").as_posix(), path)


def read_list(path: Path) -> Iterator[Task]:
    """Yield the tasks of a list.

    Raises:
        ConfigError: it cannot be read, is empty, or has an invalid line, which is named.
    """
    kind, is_empty = path.suffix.lower(), True
    for number, line in _lines(path):
        where = f"{path}:{number}"
        audio: str | None = line
        name: str | None = None
        options: dict[str, Any] = {}
        if kind == ".jsonl":
            audio, name, options = _json_line(line, where)
        elif kind == ".scp":
            audio, name = _scp_line(line, where)
        elif line.startswith("#") and not os.path.exists(_placed(line, path.parent)):  # noqa: PTH110
            continue  # a comment
        try:
            name = name if name is not None else _name_of(audio or "")
            check_id(name)
        except CorpusError as error:
            raise ConfigError(f"{where}: {error}") from None
        yield Task(name, None if audio is None else _placed(audio, path.parent), more=options)
        is_empty = False
    if is_empty:
        raise ConfigError(f"{path}: the list is empty")


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        if not path.is_file():
            raise ConfigError(f"{path}: no such list")
        with path.open("rb") as file:
            number = 0
            while line := file.readline(_MAX_LINE + 1):
                number += 1
                if len(line) > _MAX_LINE or b"\0" in line:
                    raise ConfigError(f"{path}:{number}: this is not a list of files")
                text = line.decode("utf-8-sig" if number == 1 else "utf-8", "surrogateescape")
                if text.strip():
                    yield number, text.strip()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None


def _scp_line(line: str, where: str) -> tuple[str, str]:
    name, _, audio = line.partition(" ") if " " in line else line.partition("\t")
    audio = audio.strip()
    if audio.endswith("|") or audio.startswith("|"):
        raise ConfigError(f"{where}: {audio!r} is a command, which is never run; name its wav")
    if not audio:
        raise ConfigError(f"{where}: {line!r}; expected an id and a path")
    return audio, name


def _json_line(line: str, where: str) -> tuple[str | None, str | None, dict[str, Any]]:
    try:
        values: Any = json.loads(line)
    except (ValueError, RecursionError):
        values = None
    if problem := next(_problems(values, line), None):
        raise ConfigError(f"{where}: {problem}")
    return values.pop("audio", None), values.pop("id", None), values


def _problems(values: Any, line: str) -> Iterator[str]:
    """Yield what is wrong with the content of a line of NAME.jsonl."""
    if not isinstance(values, dict):
        yield f"not a JSON object: {line[:80]}"
        return
    if "schema" in values:
        yield "a manifest of `prepare`; give it with --corpus"
    for name, value in values.items():
        if name not in FIELDS:
            yield f"unknown field {name!r}; known: {', '.join(FIELDS)}"
            return
        is_valid = isinstance(value, FIELDS[name]) and not isinstance(value, bool)
        if is_valid and str not in FIELDS[name]:
            most = _MAX_SECONDS if float in FIELDS[name] else value
            is_valid = 0 <= value <= most and bool(value or name in ("seed", "start"))
        if not is_valid:
            yield f"{name} is {json.dumps(value)[:80]}"
    if values.get("audio") is None and not (values.get("id") and "seconds" in values):
        yield "give audio, or id and seconds for a motion without sound"


def _name_of(audio: str) -> str:
    path = PurePosixPath(Path(audio).as_posix())
    is_below = not path.is_absolute() and ".." not in path.parts
    return path.with_suffix("").as_posix() if is_below and path.name else path.stem


def _placed(audio: str, folder: Path) -> Path:
    beside = folder / audio
    is_elsewhere = not os.path.exists(beside) and os.path.exists(audio)  # noqa: PTH110 (any text)
    return Path(audio) if is_elsewhere else beside
