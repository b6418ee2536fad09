"""Measure all clips and sets: what is stored is read, the rest is measured on all cores."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from gesturekit.evaluation.measuring.measurer import PARTS, ClipGroup, Measurer, Portion, SetPart
from gesturekit.workers import Failure, in_processes

IN_PROCESS_SECONDS = 4.0
"""Measuring that takes longer gets worker processes; starting them takes about as long."""

Progress = Callable[[Iterable[Any], int, str], Iterable[Any]]
"""Wraps an iterable of finished portions, such as in a progress bar, given number and label."""


@dataclass
class Measured:
    """Measurements of all models.

    Attributes:
        clips: {label: measurement of each pair}, see `Measurer.clip`.
        sets: {label: {part: metrics of the set}}, see `Measurer.set`.
    """

    clips: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    sets: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)


def measure_all(measurer: Measurer, workers: int, progress: Progress) -> Measured:
    """Return the measurements of all clips and sets, the same for any number of workers.

    Each result is stored as soon as it is computed, so that an interrupted evaluation can continue.

    Args:
        measurer: what to measure.
        workers: number of processes; 1 measures in this one.
        progress: see `Progress`.
    """
    found = Measured()
    clip_groups = _read_clips(measurer, found)
    portions = [*clip_groups, *_chains(measurer, _read_sets(measurer, found), workers)]
    if not portions:
        return found
    for portion, results in progress(
        _done(measurer, portions, workers), len(portions), "measuring"
    ):
        if isinstance(results, Failure):
            results = _failed(measurer, portion, str(results))
        if not isinstance(portion, ClipGroup):
            for one, values in zip(portion, results, strict=True):
                found.sets[one.label][one.part] = values
            continue
        for label, index, values in results:
            found.clips[label][index] = values
    return found


def _read_clips(measurer: Measurer, found: Measured) -> list[ClipGroup]:
    """Read the stored clips into `found`; return a portion for each recording with other clips."""
    missing: dict[tuple[bool, str, int], dict[str, list[int]]] = {}
    for label, pairs in measurer.pairs.items():
        stored = [measurer.store.read(measurer.clip_key(label, i)) for i in range(len(pairs))]
        found.clips[label] = [values or {} for values in stored]
        for i, pair in enumerate(pairs):
            if stored[i] is None:
                window = (
                    label in measurer.local,
                    pair.stem,
                    -1 if pair.window is None else pair.window,
                )
                missing.setdefault(window, {}).setdefault(label, []).append(i)
    return [ClipGroup(clips) for _, clips in sorted(missing.items())]


def _read_sets(measurer: Measurer, found: Measured) -> list[SetPart]:
    """Read the stored metrics of sets into `found`; return portions for the others."""
    portions = []
    for label in measurer.pairs:
        found.sets[label] = {}
        for part in PARTS:
            portion = SetPart(label, part)
            stored = measurer.store.read(measurer.set_key(portion))
            if stored is None:
                portions.append(portion)
            else:
                found.sets[label][part] = stored
    return portions


def _chains(
    measurer: Measurer, portions: Sequence[SetPart], workers: int
) -> list[tuple[SetPart, ...]]:
    """Return the metrics of sets in chains, one for two workers, each done by one process.

    A set holds all motion of its model in memory; while one is computed, clips are measured.
    """
    chains = []
    for portable in (True, False):
        some = [portion for portion in portions if measurer.is_portable((portion,)) == portable]
        count = max(1, workers // 2) if workers > 1 else len(some)
        chains += [tuple(some[k::count]) for k in range(count) if some[k::count]]
    return chains


def _done(measurer: Measurer, portions: Sequence[Any], workers: int) -> Iterator[tuple[Any, Any]]:
    """Yield (portion, results) as they are done; those that cannot be handed over are done here."""
    here = [portion for portion in portions if not measurer.is_portable(portion)]
    left = [portion for portion in portions if measurer.is_portable(portion)]
    until = time.monotonic() + IN_PROCESS_SECONDS
    while left and (workers < 2 or time.monotonic() < until):
        portion = left.pop(0)
        yield portion, measurer(portion)
    if left:
        left.sort(key=lambda portion: isinstance(portion, ClipGroup))  # the longest first
        yield from in_processes(measurer.portable(), left, workers)
    for portion in here:
        yield portion, measurer(portion)


def _failed(measurer: Measurer, portion: Portion, reason: str) -> list[Any]:
    """Return the results of a portion whose worker process died; sets done before it are stored."""
    if not isinstance(portion, ClipGroup):
        failed = {"metrics": {}, "problems": [("metrics of the set", reason)]}
        return [measurer.store.read(measurer.set_key(one)) or failed for one in portion]
    return [(label, i, {"reason": reason}) for label, at in portion.clips.items() for i in at]
