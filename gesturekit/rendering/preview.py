"""Preview of a batch of sounds: its plan, time and size."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import soundfile

import audio_features as af
from gesturekit.jobs.result import Result
from gesturekit.jobs.run import Batch
from gesturekit.jobs.task import Task
from gesturekit.systems import bundled_speech

_SHORT, _LONG = 0.5, 5.0  # seconds of sound


@dataclass(frozen=True)
class Cost:
    """Cost of the work in one process, measured on this machine.

    Attributes:
        item: (seconds, bytes) of each item, however short.
        sound: (seconds, bytes) of each second of sound.
    """

    item: tuple[float, float]
    sound: tuple[float, float]

    def of(self, items: int, sound: float) -> tuple[float, float]:
        """Return the (seconds, bytes) of a number of items with so many seconds of sound."""
        return tuple(items * a + sound * b for a, b in zip(self.item, self.sound, strict=True))


def preview(batch: Batch) -> Iterator[Result]:
    """Yield what would come of each task; nothing is written.

    The status is "left" for a task to be done, "kept" if its files are up to date, and "failed" if
    it cannot be done, or was put aside. Only the first half second of a sound is read, so that
    damage further on is not found.
    """
    for task in batch.tasks:
        result = batch.known(task)
        if result.status == "left" and (reason := _unreadable(task)):
            result = Result(task, "failed", error=reason)
        yield result


def _unreadable(task: Task) -> str | None:
    """Return why the beginning of a task's sound cannot be read; None if it can, or has none."""
    if task.path is None or task.duration is not None:
        return None
    try:
        af.Wave.load(task.path, duration=_SHORT)
    except (af.AudioError, OSError) as error:
        return str(error)
    return None


def measured_cost(batch: Batch) -> Cost:
    """Measure the cost of a short and a longer piece of speech, written to a temporary folder.

    All costs are 0 if nothing can be made of speech with these settings.
    """
    found, speech = [], af.Wave.load(bundled_speech())
    with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
        processor = batch.processor.into(Path(folder))
        for seconds in (_LONG, _SHORT, _LONG):  # the first includes compilation
            wav = Path(folder) / f"{seconds:g}.wav"
            part = speech.slice(1.0, seconds)  # it begins with silence
            soundfile.write(wav, part.samples, part.sample_rate)
            result = processor(Result(Task(wav.stem, wav)))
            size = sum(about["size"] for about in result.digests.values())
            found.append((result.seconds, size))
    if result.status != "done":
        return Cost((0.0, 0.0), (0.0, 0.0))
    _, short, long = found
    sound = tuple(max(0.0, (b - a) / (_LONG - _SHORT)) for a, b in zip(short, long, strict=True))
    item = tuple(max(0.0, a - _SHORT * b) for a, b in zip(short, sound, strict=True))
    return Cost(item, sound)
