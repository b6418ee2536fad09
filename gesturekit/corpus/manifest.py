"""The manifest: which sound goes with which motion, as a JSONL file.

The first line is the header ``{"schema": 1}``; every further line is one item with exactly
the fields of `Item`. Paths in the file are relative to the manifest and may lead out of its
folder (``../``): recordings usually lie elsewhere, and they are only ever read.
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Any

from gesturekit.atomic import atomic_write
from gesturekit.errors import CorpusError

if TYPE_CHECKING:
    from audio_features import Wave
    from gesturekit.formats.tables.events import Event
    from gesturekit.motion import Motion
    from gesturekit.motion.root_path import RootPath

SCHEMA = 1
SPLITS = ("train", "valid", "test")
CONDITIONS = ("events", "path")
"""What conditions a model can be told, beside what it hears and its style."""
READING: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("unit", "up", "forward"), str),
    **dict.fromkeys(("fps", "height"), (int, float)),
    "parts": Mapping,
}
"""Options for reading an item's motion file, by name, with their types."""

# A line holds a handful of names and numbers; far more than that is not a manifest.
_MAX_LINE_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Item:
    """A stretch of one recording: speech with motion, speech alone, or motion alone.

    Attributes:
        id: unique name in the manifest; looks like a relative path without extension.
        audio: the sound file, absolute; None for motion alone.
        motion: the motion file (BVH or npz), absolute; None for unpaired speech.
        audio_start: where the item begins in the sound file, seconds.
        channel: which channel of the sound file is heard, counted from 1; None for their mean.
        motion_start: where the item begins in the motion file, seconds.
        duration: length of the item, seconds.
        speaker: who speaks or moves, or None where not named.
        style: the label of the item, or None where not labelled.
        split: "train", "valid" or "test".
        text: what is said, or None.
        mirror: True where the motion is to be used mirrored, left for right.
        conditions: further files that go with the whole recording, {name: absolute path}:
            `events`, a table of what happens (`formats.tables.events`), and `path`, where
            the root goes (`formats.tables.root_path`; else it goes where the motion does).
        reading: how the motion file is read where that was not left to detection: `unit`, `up`,
            `forward` of its axes, its true `fps`, the `height` in metres to which its body is
            scaled, and the `parts` named by hand that its height depends on.

    Raises:
        CorpusError: a field holds something it cannot hold.
    """

    id: str
    audio: Path | None
    motion: Path | None
    audio_start: float = 0.0
    motion_start: float = 0.0
    duration: float
    speaker: str | None = None
    style: str | None = None
    split: str = "train"
    text: str | None = None
    mirror: bool = False
    conditions: Mapping[str, Path] = field(default_factory=dict)
    channel: int | None = None
    reading: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_id(self.id)
        if self.audio is None and self.motion is None:
            raise CorpusError(f"item {self.id!r} has neither audio nor motion")
        for name in ("audio_start", "motion_start", "duration"):
            seconds = getattr(self, name)
            if not math.isfinite(seconds) or seconds < 0 or (name == "duration" and seconds == 0):
                raise CorpusError(f"item {self.id!r}: {name} is {seconds}, not a length in seconds")
        if self.channel is not None and self.channel < 1:
            raise CorpusError(f"item {self.id!r}: channel is {self.channel}; they count from 1")
        for name, value in self.reading.items():
            if name not in READING:
                raise CorpusError(
                    f"item {self.id!r}: reading has {name!r}; it holds {', '.join(READING)}"
                )
            if not isinstance(value, READING[name]) or isinstance(value, bool):
                raise CorpusError(f"item {self.id!r}: reading.{name} is {value!r}")
        if self.split not in SPLITS:
            raise CorpusError(
                f"item {self.id!r}: split is {self.split!r}; it must be one of {', '.join(SPLITS)}"
            )

    @property
    def is_paired(self) -> bool:
        """True where the item has both speech and motion."""
        return self.audio is not None and self.motion is not None

    def load_wave(self) -> Wave:
        """The item's stretch of its sound file.

        Raises:
            CorpusError: the item is motion alone.
            audio_features.AudioError: the file cannot be read.
        """
        if self.audio is None:
            raise CorpusError(f"item {self.id!r} has no audio: it is motion alone")
        from audio_features import Wave

        return Wave.load(
            self.audio, start=self.audio_start, duration=self.duration, channel=self.channel
        )

    def load_motion(self, parts: Mapping[str, str] | None = None) -> Motion:
        """The item's stretch of its motion file, mirrored where the item says so.

        `parts` are named by hand, see `Skeleton.parts`: they may tell left from right.

        Begins at the frame nearest to `motion_start` and holds floor(duration·fps + ½)
        frames; one frame fewer is accepted at the very end of a file.

        Raises:
            CorpusError: the item is speech alone, or reaches past the end of its file.
            FormatError: the file cannot be read.
            MotionError: `parts` names a joint that is not there, or left and right cannot be told.
        """
        if self.motion is None:
            raise CorpusError(f"item {self.id!r} has no motion: it is speech alone")
        from gesturekit.formats.conversion import load

        named = {**self.reading.get("parts", {}), **(parts or {})}
        motion = load(self.motion, self.reading, named)
        start = math.floor(self.motion_start * motion.fps + 0.5)
        stop = start + math.floor(self.duration * motion.fps + 0.5)
        if stop > motion.n_frames + 1 or start >= min(stop, motion.n_frames):
            raise CorpusError(
                f"item {self.id!r} is frames {start} to {stop} of {self.motion}, which has "
                f"{motion.n_frames} frames at {motion.fps:g} fps; prepare the corpus again"
            )
        if start > 0 or stop < motion.n_frames:
            motion = motion.slice(start, min(stop, motion.n_frames))
        return motion.mirror() if self.mirror else motion

    def load_events(self) -> tuple[Event, ...]:
        """What happens within the item, in seconds from its beginning; nothing where no file tells.

        Raises:
            FormatError: the file cannot be read.
        """
        if "events" not in self.conditions:
            return ()
        from gesturekit.formats.tables.events import Event, load_events

        begins = self.audio_start if self.motion is None else self.motion_start
        heard = []
        for event in load_events(self.conditions["events"]):
            start, stop = event.time - begins, event.time + event.duration - begins
            if stop >= 0 and start < self.duration:
                # What began before the item goes on within it.
                heard.append(Event(max(start, 0.0), event.name, stop - max(start, 0.0)))
        return tuple(heard)

    def load_path(self, fps: float, n_frames: int, scale: float = 1.0) -> RootPath | None:
        """The item's stretch of its path, mirrored where the item says so; None without a file.

        Args:
            fps: frames per second of the result.
            n_frames: how many; past its end a path stands still.
            scale: `body_scale` of who follows it.

        Raises:
            FormatError: the file cannot be read.
        """
        if "path" not in self.conditions:
            return None
        from gesturekit.formats.tables.root_path import load_root_path

        begins = self.audio_start if self.motion is None else self.motion_start
        path = load_root_path(self.conditions["path"], scale)
        path = path.resample(fps, n_frames, start=begins)
        return path.mirror() if self.mirror else path


class Manifest:
    """The items of a corpus, in the order of their ids.

    Raises:
        CorpusError: two items have one id.
    """

    def __init__(self, items: Iterable[Item]) -> None:
        self.items: tuple[Item, ...] = tuple(sorted(items, key=lambda item: item.id))
        repeated = [name for name, n in Counter(item.id for item in self.items).items() if n > 1]
        if repeated:
            raise CorpusError(f"ids must be unique; more than one item is called {repeated[0]!r}")

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[Item]:
        return iter(self.items)

    def in_split(self, split: str, where: str = "the manifest") -> tuple[Item, ...]:
        """Items of one split, of which there is at least one.

        Args:
            split: train, valid or test.
            where: name of the manifest in messages.

        Raises:
            CorpusError: no item is in that split.
        """
        items = self._of(split)
        if not items:
            counts = Counter(item.split for item in self.items)
            found = ", ".join(f"{n} in {name}" for name, n in sorted(counts.items()))
            raise CorpusError(
                f"{where}: no item is in split {split} ({found or 'it is empty'}); "
                "choose another split"
            )
        return items

    def paired(self, split: str | None = None) -> tuple[Item, ...]:
        """Items with both speech and motion, of one split or of all."""
        return tuple(item for item in self._of(split) if item.is_paired)

    def unpaired(self, split: str | None = None) -> tuple[Item, ...]:
        """Items of speech alone, of one split or of all."""
        return tuple(item for item in self._of(split) if item.motion is None)

    def motion_alone(self, split: str | None = None) -> tuple[Item, ...]:
        """Items of motion alone, of one split or of all."""
        return tuple(item for item in self._of(split) if item.audio is None)

    def _of(self, split: str | None) -> tuple[Item, ...]:
        if split is None:
            return self.items
        if split not in SPLITS:
            raise CorpusError(f"no split is called {split!r}; it is one of {', '.join(SPLITS)}")
        return tuple(item for item in self.items if item.split == split)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Manifest:
        """Read a manifest.

        Raises:
            CorpusError: the file is missing, of a newer schema, or a line of it does not hold
                exactly one item; the message names file and line.
        """
        path = Path(path)
        items: list[Item] = []
        line_of: dict[str, int] = {}
        header_seen = False
        for number, record in _records(path):
            where = f"{path}:{number}"
            if not header_seen:
                _check_header(record, where)
                header_seen = True
                continue
            item = _item_from_record(record, folder=absolute(path).parent, where=where)
            if item.id in line_of:
                raise CorpusError(
                    f"{where}: id {item.id!r} was already used on line {line_of[item.id]}; "
                    "ids must be unique"
                )
            line_of[item.id] = number
            items.append(item)
        if not header_seen:
            raise CorpusError(f'{path}: empty; a manifest begins with {{"schema": {SCHEMA}}}')
        return cls(items)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the manifest atomically; equal items give equal bytes."""
        folder = absolute(Path(path)).parent
        records = [{"schema": SCHEMA}, *(_record_from_item(item, folder) for item in self.items)]
        text = "".join(json.dumps(record, ensure_ascii=False) + "\n" for record in records)
        with atomic_write(path) as temporary:
            temporary.write_bytes(text.encode())


def absolute(path: Path) -> Path:
    """The absolute path without ``..``; a link inside a corpus stays a link, so it can move."""
    return Path(os.path.abspath(path))  # noqa: PTH100 (resolve() would follow links)


def _check_id(name: str) -> None:
    """Ids name output files, so they must be fit to be a relative path."""
    parts = name.split("/") if isinstance(name, str) else []
    if not parts or any(part in ("", ".", "..") for part in parts) or not name.isprintable():
        raise CorpusError(
            f"id {name!r} cannot be used: an id is a name, or names joined by '/', "
            "without '..' and control characters"
        )


def _records(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """The JSON objects of the file with their line numbers; blank lines are passed over."""
    try:
        file = path.open("rb")
    except OSError as error:
        reason = error.strerror
        if path.is_dir():
            reason = f"it is a folder; run gesturekit prepare {path} --out corpus.jsonl"
        raise CorpusError(f"{path}: cannot open the manifest: {reason}") from error
    with file:
        number = 0
        while line := file.readline(_MAX_LINE_BYTES + 1):
            number += 1
            if len(line) > _MAX_LINE_BYTES:
                raise CorpusError(
                    f"{path}:{number}: line longer than {_MAX_LINE_BYTES} bytes; not a manifest"
                )
            if line.strip():
                yield number, _parsed(line, f"{path}:{number}")


def _parsed(line: bytes, where: str) -> dict[str, Any]:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        repeated = [key for key, n in Counter(key for key, _ in pairs).items() if n > 1]
        if repeated:
            raise ValueError(f"field {repeated[0]!r} is given twice")
        return dict(pairs)

    def refuse(constant: str) -> float:
        raise ValueError(f"{constant} is not a number of JSON")

    try:
        record = json.loads(line.decode(), object_pairs_hook=unique, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise CorpusError(f"{where}: not a line of JSON: {error}") from error
    if not isinstance(record, dict):
        raise CorpusError(f"{where}: expected a JSON object, got {type(record).__name__}")
    return record


def _check_header(record: dict[str, Any], where: str) -> None:
    schema = record.get("schema")
    if type(schema) is not int or schema < 1:
        raise CorpusError(
            f'{where}: a manifest begins with {{"schema": {SCHEMA}}}, got {json.dumps(record)[:80]}'
        )
    if schema > SCHEMA:
        raise CorpusError(
            f"{where}: manifest schema {schema} is newer than this gesturekit reads "
            f"(schema {SCHEMA}); update gesturekit"
        )
    if set(record) != {"schema"}:
        raise CorpusError(
            f'{where}: the header holds "schema" alone, got also '
            f"{', '.join(sorted(set(record) - {'schema'}))}"
        )


_FIELDS = tuple(f.name for f in fields(Item))
# Left out of lines that do not need them: manifests from before there was a choice stay valid.
_OPTIONAL = ("channel", "reading")
_TYPES: dict[str, tuple[tuple[type, ...], str]] = {
    "id": ((str,), "a string"),
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
    "reading": ((dict,), "an object {unit, up, forward, fps, height}"),
}


def _item_from_record(record: dict[str, Any], *, folder: Path, where: str) -> Item:
    unknown = sorted(set(record) - set(_FIELDS))
    missing = [name for name in _FIELDS if name not in record and name not in _OPTIONAL]
    if unknown:
        raise CorpusError(
            f"{where}: unknown field {unknown[0]!r}; an item has {', '.join(_FIELDS)}"
        )
    if missing:
        raise CorpusError(f"{where}: missing field {', '.join(map(repr, missing))}")
    for name, value in record.items():
        types, wanted = _TYPES[name]
        # bool is an int to Python, not to JSON.
        if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
            raise CorpusError(f"{where}: {name} must be {wanted}, got {json.dumps(value)[:80]}")

    def resolved(name: str, text: Any) -> Path:
        if not isinstance(text, str) or not text or "\0" in text:
            raise CorpusError(f"{where}: {name} must be a path, got {json.dumps(text)[:80]}")
        if PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute():
            raise CorpusError(
                f"{where}: {name} is the absolute path {text!r}; a manifest holds paths relative "
                "to itself, so that a corpus can move"
            )
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
    try:
        return Item(**values)
    except CorpusError as error:
        raise CorpusError(f"{where}: {error}") from None


def _record_from_item(item: Item, folder: Path) -> dict[str, Any]:
    def relative(path: Path) -> str:
        return Path(os.path.relpath(absolute(path), folder)).as_posix()

    record = {name: getattr(item, name) for name in _FIELDS}
    record = {name: v for name, v in record.items() if v or name not in _OPTIONAL}
    for name in ("audio", "motion"):
        record[name] = None if record[name] is None else relative(record[name])
    record["conditions"] = {
        name: relative(item.conditions[name]) for name in sorted(item.conditions)
    }
    return record
