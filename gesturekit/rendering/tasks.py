"""List of motions to render: for sound files, folders, globs, lists and items of a manifest."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import soundfile

import audio_features as af
from audio_features.containers.sound_file import soundfile_name
from audio_features.wave import SAMPLE_RATES
from audio_features.words import words_beside
from gesturekit.corpus.item import Item
from gesturekit.errors import ConfigError, CorpusError
from gesturekit.formats.sources import (
    OTHER_SPEECH_SUFFIXES,
    SPEECH_SUFFIXES,
    VIDEO_SUFFIXES,
    unreadable_media,
    visible_folders,
)
from gesturekit.jobs.plan import PlanItem
from gesturekit.jobs.state import STATE
from gesturekit.jobs.work import Inputs
from gesturekit.rendering.lists import is_glob, is_list, matches_of_glob, read_list

_SHOWN = 3
_MAX_SECONDS = 4 * 3600  # the longest sound that is read
_UNCOMPRESSED = ("WAV", "WAVEX", "AIFF", "AU")

Source = str | os.PathLike[str] | Item
"""A sound file, a folder of them, a glob, a list file, or an item of a manifest."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Task:
    """One motion to render, or several samples of it.

    Attributes:
        source: name of the input in messages.
        name: path of the results below the output folder, without suffix.
        audio: the sound file, or None.
        item: the manifest's item, which gives the interval of the sound, or None.
        options: settings of this input alone: `seed`, `style` and `speaker`; `start` and `seconds`,
            the interval of the sound, or the length without sound; `channel`.
        duration: seconds of sound, or of motion without sound; None if unknown.
        error: reason why it cannot be rendered, or None.
    """

    source: str
    name: str
    audio: Path | None = None
    item: Item | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    duration: float | None = None
    error: str | None = None

    def load_wave(self, channel: int | None) -> af.Wave | None:
        """Read the sound, cut to the item's interval; None without a sound.

        Raises:
            AudioError: the file cannot be read.
        """
        if self.audio is None:
            return None
        if self.item is not None:
            return self.item.load_wave()
        start, seconds = self.options.get("start", 0.0), self.options.get("seconds")
        channel = self.options.get("channel", channel)
        return af.Wave.load(self.audio, start=start, duration=seconds, channel=channel)

    def measured(self) -> Task:
        """Return the task with its duration, from the header of its sound."""
        if self.item is not None or self.audio is None:
            length = self.options.get("seconds") if self.item is None else self.item.duration
            return replace(self, duration=length)
        length = _length(self.audio)
        if length is None:
            return self
        length = max(0.0, length - self.options.get("start", 0.0))
        return replace(self, duration=min(length, self.options.get("seconds", length)))

    def to_plan(self) -> PlanItem:
        """Return the task as an item of a plan."""
        more: dict[str, Any] = {"source": self.source} if self.source != str(self.audio) else {}
        more |= {"options": dict(self.options)} if self.options else {}
        if self.item is not None:
            fields = asdict(self.item)
            fields |= {"conditions": {k: str(v) for k, v in self.item.conditions.items()}}
            fields |= {"motion": self.item.motion and str(self.item.motion)}
            fields |= {"audio": self.item.audio and str(self.item.audio)}
            more["item"] = fields
        path = None if self.audio is None else os.path.abspath(self.audio)  # noqa: PTH100
        return PlanItem(self.name, path, self.duration, more)

    @property
    def path(self) -> Path | None:
        """The sound file."""
        return self.audio

    @property
    def words(self) -> Path | None:
        """The word list of the item, or beside the sound."""
        given = None if self.item is None else self.item.conditions.get("words")
        if given is not None:
            return Path(given)
        return None if self.audio is None else words_beside(self.audio)

    @classmethod
    def from_plan(cls, planned: PlanItem) -> Task:
        """Return the task of an item of a plan.

        Raises:
            CorpusError: the item has invalid values.
        """
        try:
            return cls._from_plan(planned)
        except (LookupError, TypeError, AttributeError, ValueError) as error:
            raise CorpusError(
                f"plan: item {planned.id!r} is damaged ({error}); delete the plan for a new one"
            ) from None

    @classmethod
    def _from_plan(cls, planned: PlanItem) -> Task:
        item, audio = planned.more.get("item"), planned.path and Path(planned.path)
        if item is not None:
            paths = {name: item[name] and Path(item[name]) for name in ("audio", "motion")}
            conditions = {name: Path(path) for name, path in item["conditions"].items()}
            audible = tuple(map(tuple, item["audible"]))
            item = Item(**{**item, **paths, "conditions": conditions, "audible": audible})
        source = planned.more.get("source", str(audio))
        options = planned.more.get("options", {})
        return cls(source, planned.id, audio or None, item, options, planned.duration)


def sound_inputs(
    verb: str,
    sources: Source | Sequence[Source],
    out: Path,
    seconds: float | None = None,
    channel: int | None = None,
) -> Inputs:
    """Return the inputs of a command on sounds.

    Args:
        verb: name of the command.
        sources: see `find_tasks`; without any, the input is one motion without sound.
        out: folder for the results.
        seconds: length of that motion.
        channel: channel of each file to use, counted from 1; None for the mean of all.
    """
    if isinstance(sources, str | os.PathLike) or not isinstance(sources, Sequence):
        sources = [sources]
    named = [
        os.path.abspath(source) if isinstance(source, str | os.PathLike) else repr(source)  # noqa: PTH100
        for source in sources
    ]

    def find() -> list[Task]:
        if not sources:
            return [Task("motion", "motion", duration=seconds)]
        return [task.measured() for task in find_tasks(sources, out)]

    return Inputs([verb, named, seconds, channel], find, Task.from_plan)


def find_tasks(sources: Source | Sequence[Source], out: Path) -> list[Task]:
    """List what to render.

    A folder stands for all sounds below it, which keep their relative path. Sounds of formats that
    cannot be decoded are tasks that fail, unless a readable sound of the same name lies beside
    them; videos are warned about. Hidden files and `out` itself are skipped.

    Args:
        sources: sound files, folders, globs such as "speech/**/*.wav", lists (see
            `gesturekit.rendering.lists`), and items of a manifest, which are named by their ids;
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
            is_file = task.audio is not None and task.item is None and task.error is None
            same = os.path.realpath(task.audio) if is_file else task.source
            tasks.setdefault((same, task.name), task)
    _refuse_clashes(list(tasks.values()), out)
    return list(tasks.values())


def _length(audio: Path) -> float | None:
    """Return the seconds of sound by the header of a file; None for a file that cannot be read."""
    try:
        if not audio.is_file():  # reading a pipe may never end
            return None
        about, size = soundfile.info(soundfile_name(audio)), audio.stat().st_size
    except (RuntimeError, OSError, ValueError):  # its turn gives the reason
        return None
    low, high = SAMPLE_RATES
    is_possible = about.format not in _UNCOMPRESSED or about.frames <= 8 * size
    if not low <= about.samplerate <= high or not is_possible or about.duration > _MAX_SECONDS:
        return None  # a damaged header
    return about.duration


def _tasks_of(source: Source, out: Path) -> Iterator[Task]:
    if isinstance(source, Item):
        yield Task(source.id, source.id, source.audio, source)
    elif Path(source).is_dir():
        yield from _below(Path(source), out)
    elif is_glob(source):
        for path, name in matches_of_glob(str(source), SPEECH_SUFFIXES):
            yield Task(str(path), name, path)
    elif is_list(source):
        for audio, name, options in read_list(Path(source)):
            yield Task(name if audio is None else str(audio), name, audio, options=options)
    else:
        yield Task(str(source), Path(source).stem, Path(source))


def _below(folder: Path, out: Path) -> Iterator[Task]:
    trouble: list[OSError] = []
    videos: list[Path] = []
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
                videos.append(path)
            elif suffix in SPEECH_SUFFIXES or (
                suffix in OTHER_SPEECH_SUFFIXES and path.stem not in readable
            ):
                is_empty = False
                name = path.relative_to(folder).with_suffix("").as_posix()
                yield Task(str(path), name, path)
    for error in trouble:
        where = str(error.filename or folder)
        yield Task(where, "", error=f"{where}: {error.strerror}")
    for line in _listed(videos):
        log.warning("%s", line)
    if is_empty and not trouble:
        raise ConfigError(f"{folder}: the folder holds no audio files that can be read")


def _listed(paths: Sequence[Path]) -> Iterator[str]:
    """Yield a line for each reason why files cannot be read, which names the first of them."""
    reasons: dict[str, list[Path]] = {}
    for path in paths:
        reasons.setdefault(unreadable_media(path) or "", []).append(path)
    for reason, those in reasons.items():
        more = f" and {len(those) - _SHOWN} more" if len(those) > _SHOWN else ""
        yield f"{', '.join(map(str, those[:_SHOWN]))}{more}: left out: {reason}"


def _refuse_clashes(tasks: Sequence[Task], out: Path) -> None:
    seen: dict[str, Task] = {}
    clashes = []
    for task in tasks:
        if task.name.split("/")[0] == STATE:
            raise ConfigError(f"{task.source}: {STATE} in {out} holds the journal; rename the item")
        if task.error is None and seen.setdefault(task.name, task) is not task:
            clashes.append(task)
    if clashes:
        more = f" (and {len(clashes) - 1} more)" if len(clashes) > 1 else ""
        raise ConfigError(
            f"{seen[clashes[0].name].source} and {clashes[0].source} would both be written as "
            f"{out / clashes[0].name}{more}; write them into different folders (a glob such as "
            "'*.wav' selects one kind), or give each an id in a .jsonl list"
        )
