"""Examination of all recordings of a corpus, in one process or several."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from gesturekit.corpus.problem import Problem
from gesturekit.corpus.recording import Recording, examine
from gesturekit.formats.conversion import applicable_read_options
from gesturekit.jobs.workers import Failure, Pool

Examined = tuple[Recording | None, list[Problem]]
"""A recording with its properties, None after an error; and its problems."""


@dataclass(frozen=True)
class Examination:
    """Examination of one recording with the options of a corpus; see `PrepareOptions`."""

    tolerance: float
    channel: int | None
    parts: Mapping[str, str] | None
    read: Mapping[str, Any]

    def __call__(self, recording: Recording) -> Examined:
        """Load a recording and check it."""
        recording = replace(recording, channel=self.channel)
        if recording.motion is not None:
            reading = applicable_read_options(recording.motion, self.read)
            if self.parts and "height" in reading:  # the height depends on the parts
                reading["parts"] = dict(self.parts)
            recording = replace(recording, reading=reading)
        return examine(recording, self.tolerance, self.parts)


def examine_each(
    recordings: list[Recording],
    examination: Examination,
    workers: int,
    progress: Callable[[list[Any]], Iterable[Any]],
) -> list[Examined]:
    """Examine recordings, and return the results in their order.

    Args:
        recordings: the recordings.
        examination: what is done with each.
        workers: number of processes; 1 works in this one.
        progress: wraps the list of recordings, as tqdm does.
    """
    if workers == 1:
        return [examination(recording) for recording in progress(recordings)]
    steps = iter(progress(recordings))
    next(steps, None)
    results: dict[int, Examined] = {}
    for recording, result in Pool(examination, workers).map(recordings, lambda _: None):
        if isinstance(result, Failure):
            result = None, [Problem("error", recording.file, str(result))]
        results[id(recording)] = result
        next(steps, None)
    return [results[id(recording)] for recording in recordings]
