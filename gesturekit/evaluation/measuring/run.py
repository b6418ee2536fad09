"""Measure all clips and sets: what is stored is read, the rest is measured on all cores."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from gesturekit.evaluation.measuring.work import PARTS, ClipTask, SetTask, Task, Work
from gesturekit.jobs.workers import Failure, Pool

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

    Each result is stored as soon as it is computed, so that an interrupted evaluation can continue.

    Args:
        work: what to measure.
        workers: number of processes; 1 measures in this one.
        progress: see `Progress`.
    """
    found = Measured()
    clip_tasks = _read_clips(work, found)
    tasks = [*clip_tasks, *_chains(work, _read_sets(work, found), workers)]
    if not tasks:
        return found
    for task, results in progress(_done(work, tasks, workers), len(tasks), "measuring"):
        if isinstance(results, Failure):
            results = _failed(work, task, str(results))
        if not isinstance(task, ClipTask):
            for one, values in zip(task, results, strict=True):
                found.sets[one.label][one.part] = values
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


def _chains(work: Work, tasks: Sequence[SetTask], workers: int) -> list[tuple[SetTask, ...]]:
    """Return the metrics of sets in chains, one for two workers, each done by one process.

    A set holds all motion of its model in memory; while one is computed, clips are measured.
    """
    chains = []
    for portable in (True, False):
        some = [task for task in tasks if work.is_portable((task,)) == portable]
        count = max(1, workers // 2) if workers > 1 else len(some)
        chains += [tuple(some[k::count]) for k in range(count) if some[k::count]]
    return chains


def _done(work: Work, tasks: Sequence[Any], workers: int) -> Iterator[tuple[Any, Any]]:
    """Yield (task, results) as tasks are done; those that cannot be handed over are done here."""
    here = [task for task in tasks if not work.is_portable(task)]
    left = [task for task in tasks if work.is_portable(task)]
    until = time.monotonic() + IN_PROCESS_SECONDS
    while left and (workers < 2 or time.monotonic() < until):
        task = left.pop(0)
        yield task, work(task)
    if left:
        left.sort(key=lambda task: isinstance(task, ClipTask))  # the longest first
        yield from Pool(work.portable(), workers).map(left, lambda _: None)
    for task in here:
        yield task, work(task)


def _failed(work: Work, task: Task, reason: str) -> list[Any]:
    """Return the results of a task whose worker process died; sets done before it are stored."""
    if not isinstance(task, ClipTask):
        failed = {"figures": {}, "problems": [("metrics of the set", reason)]}
        return [work.store.read(work.set_key(one)) or failed for one in task]
    return [(label, i, {"reason": reason}) for label, at in task.clips.items() for i in at]
