"""List of motions to render: for sound files, folders and items of a manifest, or a length."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import audio_features as af
from gesturekit.corpus.item import Item
from gesturekit.errors import ConfigError
from gesturekit.formats.sources import (
    OTHER_SPEECH_SUFFIXES,
    SPEECH_SUFFIXES,
    unreadable_media,
    visible_folders,
)

_SHOWN = 3

Source = str | os.PathLike[str] | Item
"""A sound file, a folder of them, or an item of a manifest."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Task:
    """One motion to render, or several samples of it.

    Attributes:
        source: name of the input in messages.
        name: path of the results below the output folder, without suffix.
        audio: the sound file, or None.
        item: the manifest's item, which gives the interval of the sound, or None.
        error: reason why it cannot be rendered, or None.
    """

    source: str
    name: str
    audio: Path | None = None
    item: Item | None = None
    error: str | None = None

    def load_wave(self, channel: int | None) -> af.Wave | None:
        """Read the sound, cut to the item's interval, and log its faults; None without a sound.

        Raises:
            AudioError: the file cannot be read.
        """
        if self.audio is None:
            return None
        if self.item is not None:
            wave = self.item.load_wave()
        else:
            wave = af.Wave.load(self.audio, channel=channel)
        if not wave.is_silent:  # the model warns of silence
            for fault in wave.faults():
                log.warning("%s: %s", self.source, fault)
        return wave


def find_tasks(sources: Source | Sequence[Source], out: Path) -> list[Task]:
    """List what to render.

    A folder stands for all sounds below it, which keep their relative path; other files with
    sound are warned about. Hidden files and `out` itself are skipped.

    Args:
        sources: sound files, folders, and items of a manifest, which are named by their ids; one
            of them, or several.
        out: folder for the results.

    Raises:
        ConfigError: a folder without sound, or two sources that would write the same file.
    """
    if isinstance(sources, str | os.PathLike | Item):
        sources = [sources]
    tasks: dict[tuple[str, str], Task] = {}
    for source in sources:
        if isinstance(source, Item):
            found = iter([Task(source.id, source.id, source.audio, source)])
        elif Path(source).is_dir():
            found = _below(Path(source), out)
        else:
            found = iter([Task(str(source), Path(source).stem, Path(source))])
        for task in found:
            # A file that is named twice is rendered once.
            same = task.source if task.item or task.error else os.path.realpath(task.audio)
            tasks.setdefault((same, task.name), task)
    _refuse_clashes(list(tasks.values()), out)
    return list(tasks.values())


def _below(folder: Path, out: Path) -> Iterator[Task]:
    trouble: list[OSError] = []
    others: list[Path] = []
    is_empty = True
    results = os.path.realpath(out)
    for here, folders, files in visible_folders(folder, trouble.append):
        if os.path.realpath(here) == results != os.path.realpath(folder):
            folders.clear()
            continue
        others += [path for path in files if path.suffix.lower() in OTHER_SPEECH_SUFFIXES]
        for path in files:
            if path.suffix.lower() in SPEECH_SUFFIXES:
                is_empty = False
                name = path.relative_to(folder).with_suffix("").as_posix()
                yield Task(str(path), name, path)
    for error in trouble:
        where = str(error.filename or folder)
        yield Task(where, "", error=f"{where}: {error.strerror}")
    for line in _listed(others):
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
        yield f"{', '.join(map(str, those[:_SHOWN]))}{more}: not rendered: {reason}"


def _refuse_clashes(tasks: Sequence[Task], out: Path) -> None:
    seen: dict[str, Task] = {}
    for task in tasks:
        if task.error is None and seen.setdefault(task.name, task) is not task:
            raise ConfigError(
                f"{seen[task.name].source} and {task.source} would both be written as "
                f"{out / task.name}; render them into different folders"
            )
