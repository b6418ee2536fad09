"""Measure all clips and sets: what is stored is read, the rest is measured on all cores."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from gesturekit.evaluation.measuring.work import PARTS, ClipTask, SetTask, Work
from gesturekit.jobs.pool import Failure, Pool

IN_PROCESS_SECONDS = 4.0
"""Measuring that takes longer gets worker processes; starting them takes about as long."""

Progress = Callable[[Iterable[Any], int, str], Iterable[Any]]
"""Wraps an iterable of finished tasks, such as in a progress bar, given number and label."""


@dataclass
class Measured:
    """Measurements of all models.

    Attributes:
        clips: {label: measurement of each pair}, see `Work.clip`.
        sets: {label: {part: metrics of the set}}, see `Work.set`.
    """

    clips: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    sets: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)


def measure_all(work: Work, workers: int, progress: Progress) -> Measured:
    """Return the measurements of all clips and sets, the same for any number of workers.

    Each is stored when it is done, so that an interrupted evaluation goes on where it was.

    Args:
        work: what to measure.
        workers: number of processes; 1 measures in this one.
        progress: see `Progress`.
    """
    found = Measured()
    clip_tasks = _read_clips(work, found)
    set_tasks = _read_sets(work, found)
    tasks = [*clip_tasks, *set_tasks]
    if not tasks:
        return found
    for task, results in progress(_done(work, tasks, workers), len(tasks), "measuring"):
        if isinstance(results, Failure):
            results = _failed(task, str(results))
        if isinstance(task, SetTask):
            found.sets[task.label][task.part] = results[0]
            continue
        for label, index, values in results:
            found.clips[label][index] = values
    return found


def _read_clips(work: Work, found: Measured) -> list[ClipTask]:
    """Read the stored clips into `found`; return a task for each recording with other clips."""
    missing: dict[tuple[bool, str, int], dict[str, list[int]]] = {}
    for label, pairs in work.pairs.items():
        stored = [work.store.read(work.clip_key(label, i)) for i in range(len(pairs))]
        found.clips[label] = [values or {} for values in stored]
        for i, pair in enumerate(pairs):
            if stored[i] is None:
                window = (
                    label in work.local,
                    pair.stem,
                    -1 if pair.window is None else pair.window,
                )
                missing.setdefault(window, {}).setdefault(label, []).append(i)
    return [ClipTask(clips) for _, clips in sorted(missing.items())]


def _read_sets(work: Work, found: Measured) -> list[SetTask]:
    """Read the stored metrics of sets into `found`; return tasks for the others."""
    tasks = []
    for label in work.pairs:
        found.sets[label] = {}
        for part in PARTS:
            task = SetTask(label, part)
            stored = work.store.read(work.set_key(task))
            if stored is None:
                tasks.append(task)
            else:
                found.sets[label][part] = stored
    return tasks


def _done(work: Work, tasks: Sequence[Any], workers: int) -> Iterator[tuple[Any, Any]]:
    """Yield (task, results) as tasks are done; those that cannot be handed over are done here."""
    here = [task for task in tasks if not work.is_portable(task)]
    left = [task for task in tasks if work.is_portable(task)]
    until = time.monotonic() + IN_PROCESS_SECONDS
    while left and (workers < 2 or time.monotonic() < until):
        task = left.pop(0)
        yield task, work(task)
    if left:
        yield from Pool(work.portable(), workers).map(left, lambda _: None)
    for task in here:
        yield task, work(task)


def _failed(task: ClipTask | SetTask, reason: str) -> list[Any]:
    """Return the results of a task whose worker process died."""
    if isinstance(task, SetTask):
        return [{"figures": {}, "problems": [("metrics of the set", reason)]}]
    return [(label, i, {"reason": reason}) for label, at in task.clips.items() for i in at]
