"""Globs and list files as inputs.

| file | a line |
|---|---|
| `NAME.txt`, `NAME.lst`, `NAME.list` | path of a sound |
| `NAME.scp` (Kaldi's wav.scp) | id and path of a sound; commands (`sox ... \\|`) are never run |
| `NAME.jsonl` | object with `audio`, and optionally the fields of `FIELDS` |

Paths are relative to the list's folder or, if there is no such file, to the working folder. Results
are named by the id; without one, by the path as it is written in the list, or by the stem of a path
that is absolute or has `..`.
"""

from __future__ import annotations

import glob
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from gesturekit.corpus.item import check_id
from gesturekit.errors import ConfigError, CorpusError

LIST_SUFFIXES = (".txt", ".lst", ".list", ".scp", ".jsonl")
FIELDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("audio", "id", "style", "speaker"), (str,)),
    **dict.fromkeys(("seed", "channel"), (int,)),
    **dict.fromkeys(("start", "seconds"), (int, float)),
}
"""Fields of a line of NAME.jsonl with their types; `seconds` and `start` are the interval of the
sound, and `seconds` alone is the length of a motion without sound."""
_MAX_LINE = 1 << 16
_MAX_SECONDS = 4 * 3600

Entry = tuple[Path | None, str, dict[str, Any]]
"""Sound, name of the results, and options of one line."""


def is_list(source: str | os.PathLike[str]) -> bool:
    """Return whether a source is a list, by its suffix."""
    return Path(source).suffix.lower() in LIST_SUFFIXES


def is_glob(source: str | os.PathLike[str]) -> bool:
    """Return whether a source is a pattern, and not a file whose name has `*`, `?` or `[`."""
    return glob.has_magic(os.fspath(source)) and not os.path.lexists(source)


def matches_of_glob(pattern: str, suffixes: Sequence[str]) -> Iterator[tuple[Path, str]]:
    """Yield each sound that a pattern matches, with its path below the pattern's fixed folder.

    Raises:
        ConfigError: it matches no sound.
    """
    fixed = []
    for part in Path(pattern).parts[:-1]:
        if glob.has_magic(part):
            break
        fixed.append(part)
    base = Path(*fixed)
    found = (Path(path) for path in sorted(glob.glob(pattern, recursive=True)))  # noqa: PTH207
    sounds = [path for path in found if path.suffix.lower() in suffixes and path.is_file()]
    if not sounds:
        raise ConfigError(f"{pattern}: no audio file matches this pattern")
    for path in sounds:
        yield path, path.relative_to(base).with_suffix("").as_posix()


def read_list(path: Path) -> Iterator[Entry]:
    """Yield the entries of a list.

    Raises:
        ConfigError: it cannot be read, is empty, or has an invalid line, which is named.
    """
    parse = {".scp": _scp_line, ".jsonl": _json_line}.get(path.suffix.lower(), _plain_line)
    is_empty = True
    for number, line in _lines(path):
        where = f"{path}:{number}"
        if parse is _plain_line and _is_comment(line, path.parent):
            continue
        audio, name, options = parse(line, where)
        try:
            name = name if name is not None else _name_of(audio)
            check_id(name)
        except CorpusError as error:
            raise ConfigError(f"{where}: {error}") from None
        yield (None if audio is None else _placed(audio, path.parent)), name, options
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


def _is_comment(line: str, folder: Path) -> bool:
    """Return whether a line begins with # and names no file."""
    return line.startswith("#") and not os.path.exists(_placed(line, folder))  # noqa: PTH110


def _plain_line(line: str, where: str) -> tuple[str, None, dict[str, Any]]:
    return line, None, {}


def _scp_line(line: str, where: str) -> tuple[str, str, dict[str, Any]]:
    name, _, audio = line.partition(" ") if " " in line else line.partition("\t")
    audio = audio.strip()
    if audio.endswith("|") or audio.startswith("|"):
        raise ConfigError(
            f"{where}: {audio!r} is a command, and commands in a list are never run; write its "
            "output to a wav and name that"
        )
    if not audio:
        raise ConfigError(f"{where}: {line!r}; expected an id and a path")
    return audio, name, {}


def _json_line(line: str, where: str) -> tuple[str | None, str | None, dict[str, Any]]:
    try:
        values = json.loads(line)
    except (ValueError, RecursionError):
        raise ConfigError(f"{where}: not a JSON object: {line[:80]}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: not a JSON object: {line[:80]}")
    if "schema" in values:
        raise ConfigError(f"{where}: a manifest of `prepare`; give it with --corpus")
    for name, value in values.items():
        if name not in FIELDS:
            raise ConfigError(f"{where}: unknown field {name!r}; known: {', '.join(FIELDS)}")
        is_valid = isinstance(value, FIELDS[name]) and not isinstance(value, bool)
        if is_valid and float in FIELDS[name]:
            is_valid = 0 <= value <= _MAX_SECONDS
        is_positive = name in ("seconds", "channel")
        if not is_valid or (is_positive and value <= 0) or (name == "seed" and value < 0):
            raise ConfigError(f"{where}: {name} is {json.dumps(value)[:80]}")
    audio, name = values.pop("audio", None), values.pop("id", None)
    if audio is None and not (name and "seconds" in values):
        raise ConfigError(f"{where}: give audio, or id and seconds for a motion without sound")
    return audio, name, values


def _name_of(audio: str) -> str:
    path = PurePosixPath(Path(audio).as_posix())
    is_below = not path.is_absolute() and ".." not in path.parts
    return path.with_suffix("").as_posix() if is_below and path.name else path.stem


def _placed(audio: str, folder: Path) -> Path:
    beside = folder / audio
    is_elsewhere = not os.path.exists(beside) and os.path.exists(audio)  # noqa: PTH110 (any text)
    return Path(audio) if is_elsewhere else beside
