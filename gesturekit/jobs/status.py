"""State of the work in a folder, from its records alone."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.errors import ConfigError
from gesturekit.jobs.records import all_records, read_items, running, shard_of, state_folder
from gesturekit.workers import ATTEMPTS

WINDOW = 600.0
"""Seconds of work before the latest result from which speed is computed."""
_NUMBER = re.compile(r"(?<![A-Za-z\d])\d+([.,]\d+)*")


@dataclass(frozen=True, slots=True)
class FailedItem:
    """An item whose last attempt failed."""

    id: str
    error: str
    attempts: int

    @property
    def is_aside(self) -> bool:
        """True if it is put aside."""
        return self.attempts >= ATTEMPTS


@dataclass(frozen=True)
class Status:
    """State of the work in a folder.

    Attributes:
        items: number of items of the latest run.
        done: number of them that are done.
        sound: seconds of sound of all results.
        failed: items that failed.
        left: ids of the items that are neither done nor failed.
        earlier: number of items that were done and are not in the latest run.
        shards: (number of items, number done or failed) of each shard.
        running: living processes, see `gesturekit.jobs.records.running`.
        in_hand: ids of items that were begun and have no result.
        items_per_minute: speed in the last `WINDOW` seconds of work.
        real_time_factor: seconds of sound per second, in the same time.
    """

    items: int
    done: int
    sound: float
    failed: list[FailedItem]
    left: list[str]
    earlier: int
    shards: list[list[int]]
    running: list[dict[str, Any]]
    in_hand: list[str]
    items_per_minute: float
    real_time_factor: float

    @property
    def seconds_left(self) -> float | None:
        """Time until all items are done at the present speed; None without a speed."""
        return 60 * len(self.left) / self.items_per_minute if self.items_per_minute else None

    def reasons(self) -> list[tuple[str, int, str]]:
        """Return (reason, number of items, id of the first), the most frequent first.

        Names are left out of a reason, and numbers in which its items differ, so that equal reasons
        count together.
        """
        groups: dict[str, tuple[list[str], int, str]] = {}
        for item in self.failed:
            text = _without_name(item)
            reason, words = _NUMBER.sub("N", text), text.split()
            before, count, first = groups.get(reason, (words, 0, item.id))
            shared = [
                word if word == other else _NUMBER.sub("N", word)
                for word, other in zip(words, before, strict=True)
            ]
            groups[reason] = shared, count + 1, first
        found = [(" ".join(words), count, first) for words, count, first in groups.values()]
        return sorted(found, key=lambda reason: -reason[1])


def status_of(out: Path) -> Status:
    """Read the state of the work in a folder; it may be going on.

    Raises:
        ConfigError: no work was done in the folder.
        FormatError: a file is damaged, or was written by a newer version.
    """
    state = state_folder(out)
    listed = read_items(state)
    if listed is None:
        raise ConfigError(
            f"{out}: no work was done in it; give the output folder of render, features or convert"
        )
    outcomes: dict[str, FailedItem | None] = {}  # None for an item that is done
    in_hand: list[str] = []
    times: list[tuple[float, float, float]] = []
    for result in all_records(state):
        if result.status == "done":
            outcomes[result.id] = None
            times.append((result.time, result.seconds, result.sound))
        elif result.status in ("failed", "lost"):
            outcomes[result.id] = FailedItem(result.id, str(result.error), result.failures)
        elif result.status == "begun":
            in_hand.append(result.id)
    done, failed, left = 0, [], []
    shards = [[0, 0] for _ in range(listed["shards"])]
    for name in listed["items"]:
        shard = shards[shard_of(name, len(shards)) - 1]
        is_ended = name in outcomes
        shard[0], shard[1] = shard[0] + 1, shard[1] + is_ended
        failure = outcomes.pop(name, None)
        if failure is not None:
            failed.append(failure)
        elif is_ended:
            done += 1
        else:
            left.append(name)
    times = [values for values in times if all(map(math.isfinite, values))]
    speed, factor = _speed(times)
    return Status(
        items=len(listed["items"]),
        done=done,
        sound=sum(sound for _, _, sound in times),
        failed=failed,
        left=left,
        earlier=sum(failure is None for failure in outcomes.values()),
        shards=shards,
        running=running(state),
        in_hand=in_hand,
        items_per_minute=speed,
        real_time_factor=factor,
    )


def _speed(results: list[tuple[float, float, float]]) -> tuple[float, float]:
    """Return items per minute and seconds of sound per second of (time, seconds, sound)."""
    if not results:
        return 0.0, 0.0
    times, seconds, sounds = np.array(results).T
    recent = times >= times.max() - WINDOW
    span = max(times.max() - (times - seconds)[recent].min(), 1e-3)
    return float(60 * recent.sum() / span), float(sounds[recent].sum() / span)


def _without_name(item: FailedItem) -> str:
    """Return the reason of a failure without the name of the item, and paths that have it."""
    name = re.escape(item.id.rpartition("/")[2])
    return re.sub(rf"\S*(/{name}|{name}\.)\S*", "...", item.error).removeprefix("... ")
