"""The manifest: recordings of a corpus and their splits, as a JSONL file.

The first line is the header ``{"schema": 1}``; every further line is one item with exactly
the fields of `Item`. Paths in the file are relative to the manifest and may point outside its
folder (``../``): the recordings are usually elsewhere and are only read.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import fields
from itertools import pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from audio_features.atomic import atomic_write
from gesturekit.corpus.item import SPLITS, Item
from gesturekit.errors import CorpusError

SCHEMA = 1
# A line holds a handful of names and numbers; a file with longer lines is not a manifest.
_MAX_LINE_BYTES = 1 << 20


class Manifest:
    """The items of a corpus, in the order of their ids.

    Raises:
        CorpusError: two items have one id.
    """

    def __init__(self, items: Iterable[Item], where: str = "manifest") -> None:
        self.items: tuple[Item, ...] = tuple(sorted(items, key=lambda item: item.id))
        for item, after in pairwise(self.items):
            if item.id == after.id:
                raise CorpusError(f"{where}: more than one item is called {item.id!r}")

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[Item]:
        return iter(self.items)

    def in_split(self, split: str, where: str = "the manifest") -> tuple[Item, ...]:
        """Return the items of one split, at least one.

        Args:
            split: train, valid or test.
            where: name of the manifest, for errors.

        Raises:
            CorpusError: no item is in that split.
        """
        items = self._select(split)
        if not items:
            counts = Counter(item.split for item in self.items)
            there = ", ".join(f"{n} in {name}" for name, n in sorted(counts.items()))
            raise CorpusError(f"{where}: no item is in split {split} ({there or 'it is empty'})")
        return items

    def paired(self, split: str | None = None) -> tuple[Item, ...]:
        """Return the items with speech and motion, of one split or of all."""
        return tuple(item for item in self._select(split) if item.is_paired)

    def unpaired(self, split: str | None = None) -> tuple[Item, ...]:
        """Return the items of speech alone, of one split or of all."""
        return tuple(item for item in self._select(split) if item.motion is None)

    def motion_alone(self, split: str | None = None) -> tuple[Item, ...]:
        """Return the items of motion alone, of one split or of all."""
        return tuple(item for item in self._select(split) if item.audio is None)

    def _select(self, split: str | None) -> tuple[Item, ...]:
        if split is None:
            return self.items
        if split not in SPLITS:
            raise CorpusError(f"no split is called {split!r}; it is one of {', '.join(SPLITS)}")
        return tuple(item for item in self.items if item.split == split)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Manifest:
        """Read a manifest.

        Raises:
            CorpusError: the file is missing or has a newer schema, or a line is not exactly one
                item; the message gives file and line.
        """
        path = Path(path)
        records = _records(path)
        number, header = next(records, (0, None))
        if header is None:
            raise CorpusError(f'{path}: empty; a manifest begins with {{"schema": {SCHEMA}}}')
        if header != {"schema": SCHEMA}:
            other = f"schema {header.get('schema')} is another, and needs another gesturekit"
            raise CorpusError(f'{path}:{number}: expected {{"schema": {SCHEMA}}}; {other}')
        folder = absolute(path).parent
        return cls(
            (_item_from_record(record, folder, f"{path}:{number}") for number, record in records),
            str(path),
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the manifest atomically; equal items give equal bytes."""
        folder = absolute(Path(path)).parent
        records = [{"schema": SCHEMA}, *(_record_from_item(item, folder) for item in self.items)]
        text = "".join(json.dumps(record, ensure_ascii=False) + "\n" for record in records)
        with atomic_write(path) as temporary:
            temporary.write_bytes(text.encode())


def absolute(path: Path) -> Path:
    """Return the absolute path without ``..``; keep links, so that a corpus can be moved."""
    return Path(os.path.abspath(path))  # noqa: PTH100 (resolve() would follow links)


def _records(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield (line number, JSON object) of each line; skip blank lines."""
    try:
        if path.is_dir():
            raise OSError(0, f"it is a folder; run gesturekit prepare {path} --out corpus.jsonl")
        if path.exists() and not path.is_file():
            raise OSError(0, "not a regular file")
        file = path.open("rb")
    except OSError as error:
        raise CorpusError(f"{path}: cannot open the manifest: {error.strerror}") from error
    with file:
        lines = iter(lambda: file.readline(_MAX_LINE_BYTES + 1), b"")
        for number, line in enumerate(lines, start=1):
            if len(line) > _MAX_LINE_BYTES:
                raise CorpusError(f"{path}:{number}: a line over {_MAX_LINE_BYTES} bytes")
            if line.strip():
                yield number, _parsed(line, f"{path}:{number}")


def _parsed(line: bytes, where: str) -> dict[str, Any]:
    def refuse(constant: str) -> float:
        raise ValueError(f"{constant} is not a valid JSON number")

    try:
        record = json.loads(line.decode(), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        hint = "; gesturekit prepare writes manifests" if where.endswith(":1") else ""
        raise CorpusError(f"{where}: not a line of JSON: {error}{hint}") from error
    if not isinstance(record, dict):
        raise CorpusError(f"{where}: expected a JSON object, got {type(record).__name__}")
    return record


_FIELDS = tuple(f.name for f in fields(Item))
# Left out of the lines of recordings that do not need them.
_OPTIONAL = ("take", "channel", "reading", "digests", "audible")
_TYPES: dict[str, tuple[tuple[type, ...], str]] = {
    "id": ((str,), "a string"),
    "take": ((str,), "a string"),
    "audio": ((str, type(None)), "a path or null"),
    "motion": ((str, type(None)), "a path or null"),
    "audio_start": ((int, float), "a number of seconds"),
    "motion_start": ((int, float), "a number of seconds"),
    "duration": ((int, float), "a number of seconds"),
    "speaker": ((str, type(None)), "a string or null"),
    "style": ((str, type(None)), "a string or null"),
    "split": ((str,), "a string"),
    "text": ((str, type(None)), "a string or null"),
    "mirror": ((bool,), "true or false"),
    "conditions": ((dict,), "an object {name: path}"),
    "channel": ((int, type(None)), "a whole number or null"),
    "reading": ((dict,), "an object {unit, up, forward, fps, height, person, body_model}"),
    "digests": ((dict,), "an object {audio, motion}"),
    "audible": ((list, tuple), "a list of [start, end] in seconds"),
}


def _item_from_record(record: dict[str, Any], folder: Path, where: str) -> Item:
    if unknown := sorted(set(record) - set(_FIELDS)):
        raise CorpusError(f"{where}: unknown field {unknown[0]!r}; known: {', '.join(_FIELDS)}")
    if missing := [repr(n) for n in _FIELDS if n not in record and n not in _OPTIONAL]:
        raise CorpusError(f"{where}: missing field {', '.join(missing)}")
    for name, value in record.items():
        types, wanted = _TYPES[name]
        # bool is an int to Python, not to JSON.
        if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
            raise CorpusError(f"{where}: {name} must be {wanted}, got {json.dumps(value)[:80]}")

    def resolved(name: str, text: Any) -> Path:
        if not isinstance(text, str) or not text or "\0" in text:
            raise CorpusError(f"{where}: {name} must be a path, got {json.dumps(text)[:80]}")
        if PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute():
            raise CorpusError(f"{where}: {name} is the absolute path {text!r}; give a relative one")
        return absolute(folder / text)

    values = dict(record)
    for name in ("audio", "motion"):
        if record[name] is not None:
            values[name] = resolved(name, record[name])
    for name in ("audio_start", "motion_start", "duration"):
        try:
            values[name] = float(record[name])
        except OverflowError:
            raise CorpusError(f"{where}: {name} is too large for a number of seconds") from None
    values["conditions"] = {
        name: resolved(f"conditions[{name!r}]", text) for name, text in record["conditions"].items()
    }
    values["reading"] = dict(record.get("reading", {}))
    if "body_model" in values["reading"]:
        values["reading"]["body_model"] = resolved(
            "reading.body_model", values["reading"]["body_model"]
        )
    try:
        values["audible"] = tuple((float(a), float(b)) for a, b in record.get("audible", ()))
    except (TypeError, ValueError, OverflowError):
        raise CorpusError(f"{where}: audible must be a list of [start, end] in seconds") from None
    try:
        return Item(**values)
    except CorpusError as error:
        raise CorpusError(f"{where}: {error}") from None


def _record_from_item(item: Item, folder: Path) -> dict[str, Any]:
    def relative(path: Path) -> str:
        return Path(os.path.relpath(absolute(path), folder)).as_posix()

    record = {name: getattr(item, name) for name in _FIELDS}
    record["take"] = "" if item.take == item.file_take else item.take
    record = {name: v for name, v in record.items() if v or name not in _OPTIONAL}
    for name in ("audio", "motion"):
        record[name] = record[name] and relative(record[name])
    record["conditions"] = {name: relative(file) for name, file in sorted(item.conditions.items())}
    if "body_model" in item.reading:
        model = relative(Path(item.reading["body_model"]))
        record["reading"] = {**item.reading, "body_model": model}
    return record
