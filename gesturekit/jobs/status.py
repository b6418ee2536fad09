"""State of the work in a folder, from its plan, journals and leases alone."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gesturekit.errors import ConfigError
from gesturekit.jobs.journal import ATTEMPTS, journal_files
from gesturekit.jobs.lease import live_leases
from gesturekit.jobs.plan import PLAN, Plan
from gesturekit.jobs.state import parse_line, read_lines, state_folder

WINDOW = 600.0
"""Seconds of work before the latest result from which speed is computed."""
# Our own lines have a fixed order of fields; parsing a million of them as JSON takes seconds.
_TEXT = rb'"(?:[^"\\]|\\.)*"'
_RESULT = re.compile(rb'\{"status": "(\w+)", "id": (' + _TEXT + rb'), "key": "(\w*)"')
_SOUND = re.compile(rb', "sound": ([\d.e+-]+)')
_SECONDS = re.compile(rb', "seconds": ([\d.e+-]+)')
_TIME = re.compile(rb', "time": ([\d.e+]+)\}$')
_STARTED = re.compile(rb'\{"started": (' + _TEXT + rb")")
_PLANNED = re.compile(rb'\{"shard": (\d+), "id": (' + _TEXT + rb")")


@dataclass(frozen=True)
class FailedItem:
    """An item whose last attempt failed."""

    id: str
    error: str
    attempts: int

    @property
    def is_aside(self) -> bool:
        """True if it is put aside."""
        return self.attempts >= ATTEMPTS


@dataclass
class Status:
    """State of the work in a folder.

    Attributes:
        items: number of items in the plan.
        seconds: seconds of sound in the plan.
        done: number of items of the plan that are done.
        sound: seconds of sound of all results.
        failed: items of the plan that failed.
        left: ids of the items of the plan that are neither done nor failed.
        earlier: number of items that were done and are not in the plan.
        shards: (number of items, number done or failed) of each shard.
        running: leases of living processes, see `gesturekit.jobs.lease.live_leases`.
        in_hand: ids of items that were begun and have no result.
        items_per_minute: speed in the last `WINDOW` seconds of work.
        real_time_factor: seconds of sound per second, in the same time.
    """

    items: int
    seconds: float
    done: int = 0
    sound: float = 0.0
    failed: list[FailedItem] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    earlier: int = 0
    shards: list[list[int]] = field(default_factory=list)
    running: list[dict[str, Any]] = field(default_factory=list)
    in_hand: list[str] = field(default_factory=list)
    items_per_minute: float = 0.0
    real_time_factor: float = 0.0

    @property
    def seconds_left(self) -> float | None:
        """Time until all items are done at the present speed; None without a speed."""
        if not self.items_per_minute:
            return None
        by_items = 60 * len(self.left) / self.items_per_minute
        if not self.real_time_factor or not self.seconds:
            return by_items
        sound_left = max(0.0, self.seconds * len(self.left) / max(self.items, 1))
        return max(0.0, sound_left / self.real_time_factor)

    def reasons(self) -> list[tuple[str, int, str]]:
        """Return (reason, number of items, id of the first), the most frequent first.

        Names and numbers are left out of a reason, so that equal reasons count together.
        """
        counts: Counter[str] = Counter()
        first: dict[str, str] = {}
        for item in self.failed:
            reason = _general(item)
            counts[reason] += 1
            first.setdefault(reason, item.id)
        return [(reason, count, first[reason]) for reason, count in counts.most_common()]


def status_of(out: Path) -> Status:
    """Read the state of the work in a folder; it may be going on.

    Raises:
        ConfigError: no work was done in the folder.
        FormatError: plan or journals are damaged, or were written by a newer version.
    """
    state = state_folder(out)
    plan = Plan.open(state / PLAN)
    if plan is None:
        raise ConfigError(f"{out}: no plan in it; give the --out of `gesturekit render`")
    results = _Results()
    for path in journal_files(state):
        results.read(path)
    status = Status(plan.n_items, plan.seconds, shards=[[n, 0] for n, _ in plan.shards])
    planned = 0
    for line in read_lines(plan.path):
        match = _PLANNED.match(line)
        if match is None:
            continue
        shard, name = int(match[1]), match[2]
        result = results.last.pop(name, None)
        if result is None or result[1] not in (b"done", b"failed", b"lost"):
            status.left.append(json.loads(name))
            continue
        planned += 1
        status.shards[shard - 1][1] += 1
        if result[1] == b"done":
            status.done += 1
        else:
            status.failed.append(results.failed(name, result[2]))
    status.earlier = sum(kind == b"done" for _, kind, _ in results.last.values())
    status.sound = sum(sound for _, sound, _ in results.times)
    status.running = live_leases(state)
    status.in_hand = [json.loads(name) for name in results.begun]
    status.items_per_minute, status.real_time_factor = results.speed()
    return status


class _Results:
    """The last result of each item, by the JSON of its id."""

    def __init__(self) -> None:
        self.last: dict[bytes, tuple[float, bytes, bytes]] = {}
        self.times: list[tuple[float, float, float]] = []
        self.begun: dict[bytes, None] = {}
        self._failures: dict[bytes, tuple[bytes, int]] = {}

    def read(self, path: Path) -> None:
        """Add the results of a journal."""
        for line in read_lines(path):
            if match := _STARTED.match(line):
                self.begun[match[1]] = None
                continue
            match, time = _RESULT.match(line), _TIME.search(line)
            if match is None or time is None:
                continue
            kind, name, key = match.groups()
            self.begun.pop(name, None)
            at = float(time[1])
            if kind == b"done":
                sound, seconds = _SOUND.search(line), _SECONDS.search(line)
                length = float(sound[1]) if sound else 0.0
                self.times.append((at, length, float(seconds[1]) if seconds else 0.0))
                self._failures.pop(name, None)
            elif kind in (b"failed", b"lost"):
                was, count = self._failures.get(name, (key, 0))
                self._failures[name] = (key, count + 1 if was == key else 1)
            before = self.last.get(name)
            if before is None or at >= before[0]:
                self.last[name] = (at, kind, line if kind != b"done" else b"")

    def failed(self, name: bytes, line: bytes) -> FailedItem:
        """Return the failure of an item from its last line."""
        error = (parse_line(line) or {}).get("error")
        _, count = self._failures.get(name, (b"", 1))
        return FailedItem(json.loads(name), str(error), count)

    def speed(self) -> tuple[float, float]:
        """Return items per minute and seconds of sound per second."""
        if not self.times:
            return 0.0, 0.0
        latest = max(at for at, _, _ in self.times)
        recent = [result for result in self.times if result[0] >= latest - WINDOW]
        first = min(at - seconds for at, _, seconds in recent)
        span = max(latest - first, 1e-3)
        return 60 * len(recent) / span, sum(sound for _, sound, _ in recent) / span


def _general(item: FailedItem) -> str:
    """Return the reason of a failure without the name of the item and without numbers."""
    text = re.sub(rf"\S*{re.escape(item.id.rpartition('/')[2])}\S*:?", "", item.error)
    text = re.sub(r"\d+([.,]\d+)*", "N", text)
    return " ".join(text.split()).strip(": ") or item.error
