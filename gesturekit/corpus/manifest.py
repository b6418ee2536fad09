"""The manifest: recordings of a corpus and their splits, as a JSONL file.

The first line is the header ``{"schema": 1}``; every further line is one item with exactly
the fields of `Item`. Paths in the file are relative to the manifest and may point outside its
folder (``../``): the recordings are usually elsewhere and are only read.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Any

import numpy as np

from audio_features.atomic import write_text
from audio_features.errors import check_values
from gesturekit.errors import CorpusError

if TYPE_CHECKING:
    from audio_features import Wave
    from gesturekit.formats.tables import Event
    from gesturekit.motion import Motion
    from gesturekit.motion.root_path import RootPath

SCHEMA = 1
SPLITS = ("train", "valid", "test")
CONDITIONS = ("events", "path")
"""Conditions of a model in addition to speech and style; each is a table beside a recording."""
READING: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("unit", "up", "forward"), str),
    **dict.fromkeys(("fps", "height"), (int, float)),
    "person": int,
    "parts": Mapping,
    "body_model": (str, os.PathLike),
}
"""Options for reading an item's motion file, by name, with their types."""

_MISSING_SECONDS = 0.1
"""Sound that may be missing at the end of an item: decoders differ in what they trim."""
_LONGEST_NAME = 230  # bytes; file systems take 255, of which suffixes are a part
# A line holds a handful of names and numbers; a file with longer lines is not a manifest.
_MAX_LINE_BYTES = 1 << 20


def file_fingerprint(path: Path) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a file's content.

    That of a folder, an EasyMocap sequence, is made from those of its files.
    """
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        return hashlib.sha256("".join(map(file_fingerprint, files)).encode()).hexdigest()[:16]
    state = path.stat()
    # A file that is written again has another time of change, whatever its other times are set to.
    return _fingerprint(path, state.st_size, state.st_mtime_ns, state.st_ctime_ns)


@lru_cache(maxsize=2**16)
def _fingerprint(path: Path, *state: int) -> str:
    """Return the fingerprint of a file in this state."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


@dataclass(frozen=True, kw_only=True)
class Item:
    """An interval of one recording: speech with motion, speech alone, or motion alone.

    Attributes:
        id: unique name in the manifest; looks like a relative path without extension.
        take: recording session. Items of one take are not independent: splits, intervals and tests
            go by takes. By default the motion file, or the sound file of unpaired speech.
        audio: the sound file, absolute; None for motion alone.
        motion: the motion file or EasyMocap folder, absolute; None for unpaired speech.
        audio_start: start of the item in the sound file, seconds.
        channel: channel of the sound file to use, counted from 1; None for their mean.
        motion_start: start of the item in the motion file, seconds.
        duration: length of the item, seconds.
        speaker: name of the person, or None.
        style: style label, or None.
        split: "train", "valid" or "test".
        text: transcript, or None.
        mirror: True to mirror the motion, left for right.
        conditions: further files of the whole recording, {name: absolute path}: `events`, a table
            of timed events (`formats.tables`), and `path`, the path of the root
            (`formats.tables`; by default that of the motion). `words` is a word list
            (`audio_features.load_words`), `semantics` BEAT's table of gestures with their semantic
            scores; `partner_audio`, `partner_motion` and `partner_words` are the interlocutor's.
        reading: options for reading the motion file that replace detection: `unit`, the axes `up`
            and `forward`, the true `fps`, the `height` in metres to scale the body to, the
            `person` of an EasyMocap folder, and the body `parts` assigned by hand that the height
            depends on.
        digests: fingerprints of the files `audio` and `motion` when the corpus was prepared, see
            `file_fingerprint`; empty where they are not known.
        audible: intervals (start, end) of the sound file, seconds, in which the recorded person
            speaks; the rest is muted. Empty where all of the sound is used.

    Raises:
        CorpusError: a field has an invalid value.
    """

    id: str
    take: str = ""
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
    conditions: Mapping[str, Path] = field(default_factory=dict, hash=False)
    channel: int | None = None
    reading: Mapping[str, Any] = field(default_factory=dict, hash=False)
    digests: Mapping[str, str] = field(default_factory=dict, hash=False)
    audible: Sequence[tuple[float, float]] = field(default=(), hash=False)

    def __str__(self) -> str:
        return self.id

    def __post_init__(self) -> None:
        check_id(self.id)
        if not self.take:
            object.__setattr__(self, "take", self.file_take)
        files, seconds = self.audio or self.motion, "seconds, 0 or more"
        checks: list[tuple[str, Any, bool, str]] = [
            ("audio or motion", files, files is not None, "one of them"),
            ("audio_start", self.audio_start, 0 <= self.audio_start < math.inf, seconds),
            ("motion_start", self.motion_start, 0 <= self.motion_start < math.inf, seconds),
            ("duration", self.duration, 0 < self.duration < math.inf, "seconds above 0"),
            ("channel", self.channel, self.channel is None or self.channel >= 1, "1 or more"),
            ("split", self.split, self.split in SPLITS, f"one of {', '.join(SPLITS)}"),
        ]
        for name, value in self.reading.items():
            fits = isinstance(value, READING.get(name, ())) and not isinstance(value, bool)
            known = f"an option ({', '.join(READING)}) of its type"
            checks.append((f"reading.{name}", value, fits, known))
        for interval in self.audible:
            fits = len(interval) == 2 and 0 <= interval[0] <= interval[1] < math.inf
            checks.append(("audible", interval, fits, "START, END"))
        check_values(CorpusError, f"item {self.id!r}: ", checks)

    @property
    def begins(self) -> float:
        """Start of the item in its side files, seconds: in the motion file if there is one."""
        return self.audio_start if self.motion is None else self.motion_start

    @property
    def file_take(self) -> str:
        """The take of an item that names none: its motion or sound file without extension."""
        return (self.motion or self.audio or Path(self.id)).with_suffix("").as_posix()

    @property
    def changed_files(self) -> list[Path]:
        """Files whose content is not that of `digests`, and is there."""
        files = {"audio": self.audio, "motion": self.motion}
        return [
            file
            for name, digest in self.digests.items()
            if (file := files.get(name)) and file.exists() and file_fingerprint(file) != digest
        ]

    @property
    def is_paired(self) -> bool:
        """True where the item has both speech and motion."""
        return self.audio is not None and self.motion is not None

    def load_wave(self) -> Wave:
        """Read the item's interval of its sound file, muted outside `audible`.

        Raises:
            CorpusError: the item is motion alone, or reaches past the end of its file.
            audio_features.AudioError: the file cannot be read.
        """
        if self.audio is None:
            raise CorpusError(f"item {self.id!r} has no audio: it is motion alone")
        from audio_features import Wave

        wave = Wave.load(
            self.audio, start=self.audio_start, duration=self.duration, channel=self.channel
        )
        if wave.duration < self.duration - _MISSING_SECONDS:
            wanted = f"is {self.duration:.2f} s of {self.audio} from {self.audio_start:.2f} s"
            there = f"only {wave.duration:.2f} s are there; prepare the corpus again"
            raise CorpusError(f"item {self.id!r} {wanted}, but {there}")
        if "words" in self.conditions:
            wave = replace(wave, words=self.conditions["words"])
        return muted(wave, self.audible) if self.audible else wave

    def load_motion(self, parts: Mapping[str, str] | None = None) -> Motion:
        """Read the item's interval of its motion file; mirror it if the item says so.

        The interval begins at the frame nearest to `motion_start` and has floor(duration·fps + ½)
        frames; one frame fewer is accepted at the very end of a file.

        Args:
            parts: body parts assigned by hand, see `Skeleton.parts`; mirroring may need them.

        Raises:
            CorpusError: the item is speech alone, or reaches past the end of its file.
            FormatError: the file cannot be read.
            MotionError: `parts` names a missing joint, or left and right cannot be identified.
        """
        if self.motion is None:
            raise CorpusError(f"item {self.id!r} has no motion: it is speech alone")
        from gesturekit.formats.sources import load

        named = {**self.reading.get("parts", {}), **(parts or {})}
        motion = load(self.motion, self.reading, named)
        start = math.floor(self.motion_start * motion.fps + 0.5)
        stop = start + math.floor(self.duration * motion.fps + 0.5)
        if stop > motion.n_frames + 1 or start >= min(stop, motion.n_frames):
            there = f"{motion.n_frames} frames at {motion.fps:g} fps; prepare the corpus again"
            wanted = f"is frames {start} to {stop} of {self.motion}"
            raise CorpusError(f"item {self.id!r} {wanted}, which has {there}")
        if start > 0 or stop < motion.n_frames:
            motion = motion[start:stop]
        return motion.mirror() if self.mirror else motion

    def load_events(self) -> tuple[Event, ...]:
        """Read the events within the item, in seconds from its start; none without a file.

        Raises:
            FormatError: the file cannot be read.
        """
        if "events" not in self.conditions:
            return ()
        from gesturekit.formats.tables import Event, load_events

        events = []
        for event in load_events(self.conditions["events"]):
            start, stop = (time - self.begins for time in (event.time, event.time + event.duration))
            if stop >= 0 and start < self.duration:
                # An event that began before the item continues in it.
                events.append(Event(max(start, 0.0), event.name, stop - max(start, 0.0)))
        return tuple(events)

    def load_path(self, fps: float, n_frames: int, scale: float = 1.0) -> RootPath | None:
        """Read the item's interval of its root path; mirror it if the item says so.

        Args:
            fps: frames per second of the result.
            n_frames: frames of the result; after its end a path stays in place.
            scale: `body_scale` of the body that follows it.

        Returns:
            the path, or None for an item without one.

        Raises:
            FormatError: the file cannot be read.
        """
        if "path" not in self.conditions:
            return None
        from gesturekit.formats.tables import load_root_path

        path = load_root_path(self.conditions["path"], scale)
        path = path.resample(fps, n_frames, start=self.begins)
        return path.mirror() if self.mirror else path

    def controls(self, model: Any) -> dict[str, Any]:
        """Return the arguments of a `gesturekit.Model`'s `generate`, beside sound and length.

        They are those of the item's style, speaker, path and events that the model has as inputs.

        Raises:
            GestureKitError: a file of the item cannot be read.
        """
        controls: dict[str, Any] = {}
        if self.style in model.styles:
            controls["style"] = self.style
        if self.speaker in model.speakers:
            controls["speaker"] = self.speaker
        if model.inputs.path and (self.motion or "path" in self.conditions):
            n_frames = max(1, int(self.duration * model.fps + 0.5))
            controls["path"] = self.load_path(model.fps, n_frames) or self.load_motion()
        if events := [event for event in self.load_events() if event.name in model.inputs.events]:
            lasting = [f":{event.duration:g}" if event.duration else "" for event in events]
            each = [f"{e.name}@{e.time:g}{lasts}" for e, lasts in zip(events, lasting, strict=True)]
            controls["events"] = ",".join(each)
        return controls


def muted(wave: Wave, audible: Iterable[tuple[float, float]]) -> Wave:
    """Return the sound with silence outside of the intervals, seconds of its file."""
    samples = np.zeros_like(wave.samples)
    for interval in audible:
        first, last = (max(round((time - wave.offset) * wave.sample_rate), 0) for time in interval)
        samples[first:last] = wave.samples[first:last]
    return replace(wave, samples=samples)


def check_id(name: str) -> None:
    """Check that an id can be a relative path, as output files are named by it."""
    is_text = isinstance(name, str) and name.isprintable()
    if not is_text or any(
        word in ("", ".", "..") or len(word.encode()) > _LONGEST_NAME for word in name.split("/")
    ):
        names = f"names of up to {_LONGEST_NAME} bytes joined by '/', without '..'"
        raise CorpusError(f"id {name!r} cannot be used: an id is a name, or {names}")


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
        records, begins = _records(path), f'{{"schema": {SCHEMA}}}'
        number, header = next(records, (1, {}))
        if header != {"schema": SCHEMA}:
            other = f"schema {header.get('schema')} is another, and needs another gesturekit"
            raise CorpusError(f"{path}:{number}: expected {begins}; {other if header else 'empty'}")
        folder, items = absolute(path).parent, []
        for number, record in records:
            try:
                items.append(_item_from_record(record, folder))
            except CorpusError as error:
                raise CorpusError(f"{path}:{number}: {error}") from None
        return cls(items, str(path))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the manifest atomically; equal items give equal bytes."""
        folder = absolute(Path(path)).parent
        records = [{"schema": SCHEMA}, *(_record_from_item(item, folder) for item in self.items)]
        text = "".join(json.dumps(record, ensure_ascii=False) + "\n" for record in records)
        write_text(path, text)


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
            try:
                if len(line) > _MAX_LINE_BYTES:
                    raise ValueError(f"longer than {_MAX_LINE_BYTES} bytes")
                record = json.loads(line.decode(), parse_constant=_refuse) if line.strip() else {}
                if not isinstance(record, dict):
                    raise ValueError(f"{type(record).__name__}, not an object")
            except (ValueError, RecursionError) as error:
                hint = "; gesturekit prepare writes manifests" if number == 1 else ""
                reason = f"not a line of JSON: {error}{hint}"
                raise CorpusError(f"{path}:{number}: {reason}") from error
            if record or line.strip():
                yield number, record


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not a valid JSON number")


_FIELDS = tuple(f.name for f in fields(Item))
# Left out of the lines of recordings that do not need them.
_OPTIONAL = ("take", "channel", "reading", "digests", "audible")
_SECONDS = ("audio_start", "motion_start", "duration")
_TYPES: dict[str, tuple[tuple[type, ...], str]] = {
    **dict.fromkeys(("id", "take", "split"), ((str,), "a string")),
    **dict.fromkeys(("audio", "motion"), ((str, type(None)), "a path or null")),
    **dict.fromkeys(_SECONDS, ((int, float), "a number of seconds")),
    **dict.fromkeys(("speaker", "style", "text"), ((str, type(None)), "a string or null")),
    "mirror": ((bool,), "true or false"),
    "conditions": ((dict,), "an object {name: path}"),
    "channel": ((int, type(None)), "a whole number or null"),
    "reading": ((dict,), "an object {unit, up, forward, fps, height, person, body_model}"),
    "digests": ((dict,), "an object {audio, motion}"),
    "audible": ((list,), "a list of [start, end] in seconds"),
}
_LARGEST = 2**63  # of whole numbers


def _item_from_record(record: dict[str, Any], folder: Path) -> Item:
    if unknown := sorted(set(record) - set(_FIELDS)):
        raise CorpusError(f"unknown field {unknown[0]!r}; known: {', '.join(_FIELDS)}")
    if missing := [repr(n) for n in _FIELDS if n not in record and n not in _OPTIONAL]:
        raise CorpusError(f"missing field {', '.join(missing)}")

    def fits(value: Any, types: tuple[type, ...]) -> bool:
        # bool is an int to Python, not to JSON, whose whole numbers have any length.
        is_small = not isinstance(value, int) or abs(value) < _LARGEST
        return isinstance(value, types) and is_small and isinstance(value, bool) <= (bool in types)

    given = [(name, value, *_TYPES[name]) for name, value in record.items()]
    checks = [(n, value, fits(value, types), wanted) for n, value, types, wanted in given]
    pairs = record.get("audible")
    for pair in pairs if isinstance(pairs, list) else ():
        is_pair = isinstance(pair, list) and all(fits(end, (int, float)) for end in pair)
        checks.append(("audible", pair, is_pair, _TYPES["audible"][1]))
    check_values(CorpusError, "", checks)

    def resolved(name: str, text: Any) -> Path:
        kinds, wanted = (PurePosixPath, PureWindowsPath), "a path relative to the manifest"
        is_path = isinstance(text, str) and bool(text) and "\0" not in text
        is_path = is_path and not any(kind(text).is_absolute() for kind in kinds)
        check_values(CorpusError, "", [(name, text, is_path, wanted)])
        return absolute(folder / text)

    values = record | {name: float(record[name]) for name in _SECONDS}
    files = {name: record[name] for name in ("audio", "motion") if record[name] is not None}
    values |= {name: resolved(name, text) for name, text in files.items()}
    sides = record["conditions"].items()
    values["conditions"] = {name: resolved(f"conditions[{name!r}]", text) for name, text in sides}
    if "body_model" in (reading := record.get("reading", {})):
        model = resolved("reading.body_model", reading["body_model"])
        values["reading"] = reading | {"body_model": model}
    values["audible"] = tuple(tuple(map(float, pair)) for pair in record.get("audible", ()))
    return Item(**values)


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
