"""State of the work in a folder, from its plan, journals and leases alone."""

from __future__ import annotations

import gc
import json
import os
import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.errors import ConfigError, FormatError
from gesturekit.jobs.journal import ATTEMPTS, journal_files
from gesturekit.jobs.lease import live_leases
from gesturekit.jobs.plan import PLAN, Plan
from gesturekit.jobs.state import MAX_LINE, parse_line, state_folder

WINDOW = 600.0
"""Seconds of work before the latest result from which speed is computed."""
# Our own lines begin with fields in a fixed order; parsing a million of them as JSON takes seconds.
# Ids are ASCII, as json.dumps writes them; a line with other bytes is not ours.
_TEXT = rb'("[ !#-\[\]-~]*(?:\\["\\/bfnrtu][ !#-\[\]-~]*)*")'
_NUMBER = rb"(-?\d+(?:\.\d+)?(?:e[+-]?\d+)?)"
_RESULT = re.compile(
    rb'\{"status": "(\w+)", "id": %b, "time": %b, "seconds": %b, "sound": %b, "key": "(\w*)"'
    % (_TEXT, _NUMBER, _NUMBER, _NUMBER)
)
_STARTED = re.compile(rb'\{"started": ' + _TEXT)
_PLANNED = re.compile(rb'\{"shard": (\d{1,9}), "id": ' + _TEXT)
_DIGITS = re.compile(r"(?<![A-Za-z\d])\d+([.,]\d+)*")
_BLOCK = 1 << 24
_TAIL = 1 << 17  # bytes at the end of a journal in which the start of an item in progress is found


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


@dataclass(frozen=True)
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
        if not self.items_per_minute:
            return None
        by_items = 60 * len(self.left) / self.items_per_minute
        if not self.real_time_factor or not self.seconds:
            return by_items
        sound_left = self.seconds * len(self.left) / max(self.items, 1)
        return max(0.0, sound_left / self.real_time_factor)

    def reasons(self) -> list[tuple[str, int, str]]:
        """Return (reason, number of items, id of the first), the most frequent first.

        Names are left out of a reason, and numbers in which its items differ, so that equal reasons
        count together.
        """
        counts: Counter[str] = Counter()
        first: dict[str, tuple[str, str]] = {}
        numbers: dict[str, list[str]] = {}
        for item in self.failed:
            text = _without_name(item)
            reason, own = _DIGITS.sub("N", text), [found[0] for found in _DIGITS.finditer(text)]
            counts[reason] += 1
            first.setdefault(reason, (text, item.id))
            shared = zip(numbers.setdefault(reason, own), own, strict=True)
            numbers[reason] = [one if one == other else "N" for one, other in shared]
        found = []
        for reason, count in counts.most_common():
            text, name = first[reason]
            found.append((_with_numbers(text, numbers[reason]), count, name))
        return found


def status_of(out: Path) -> Status:
    """Read the state of the work in a folder; it may be going on.

    Raises:
        ConfigError: no work was done in the folder.
        FormatError: plan or journals are damaged, or were written by a newer version.
    """
    state = state_folder(out)
    plan = Plan.open(state / PLAN)
    if plan is None:
        raise ConfigError(
            f"{out}: no plan in it; give the output folder of render, features or convert"
        )
    with _without_collection():
        return _counted(plan, state)


def _counted(plan: Plan, state: Path) -> Status:
    results = _Results()
    for path in journal_files(state):
        results.read(path)
    done, failed, left = 0, [], []
    shards = [[n, 0] for n, _ in plan.shards]
    for line in (line for lines in _blocks(plan.path) for line in lines):
        match = _PLANNED.match(line)
        if match is None:
            continue
        shard, name = int(match[1]), match[2]
        if not 1 <= shard <= len(shards):
            raise FormatError(f"{plan.path}: shard {shard} of {len(shards)}; delete it")
        result = results.last.pop(name, None)
        if result is None or result[1] == b"dropped":
            left.append(json.loads(name))
            continue
        shards[shard - 1][1] += 1
        if result[1] == b"done":
            done += 1
        else:
            failed.append(results.failed(name, result[2]))
    speed, factor = results.speed()
    return Status(
        items=plan.n_items,
        seconds=plan.seconds,
        done=done,
        sound=sum(results.sounds),
        failed=failed,
        left=left,
        earlier=sum(kind == b"done" for _, kind, _ in results.last.values()),
        shards=shards,
        running=live_leases(state),
        in_hand=[json.loads(name) for name in results.begun],
        items_per_minute=speed,
        real_time_factor=factor,
    )


@contextmanager
def _without_collection() -> Iterator[None]:
    """Pause the search for reference cycles, which a million new tuples would start often."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


class _Results:
    """The last result of each item, by the JSON of its id."""

    def __init__(self) -> None:
        self.last: dict[bytes, tuple[float, bytes, bytes]] = {}
        self.times, self.sounds, self.seconds = array("d"), array("d"), array("d")
        self.begun: dict[bytes, None] = {}
        self._failures: dict[bytes, tuple[bytes, int]] = {}

    def read(self, path: Path) -> None:
        """Add the results of a journal."""
        match = _RESULT.match
        for lines in _blocks(path):
            for line in lines:
                if not line.startswith(b'{"status"') or not (found := match(line)):
                    continue
                kind, name, time, seconds, sound, key = found.groups()
                at = float(time)
                if kind == b"done":
                    self.times.append(at)
                    self.sounds.append(float(sound))
                    self.seconds.append(float(seconds))
                    line = b""
                    if self._failures:
                        self._failures.pop(name, None)
                elif kind != b"dropped":
                    was, count = self._failures.get(name, (key, 0))
                    self._failures[name] = (key, count + 1 if was == key else 1)
                before = self.last.get(name)
                if before is None or at >= before[0]:
                    self.last[name] = (at, kind, line)
        begun: dict[bytes, None] = {}
        for line in _lines_at_end(path, _TAIL):
            if found := _STARTED.match(line):
                begun[found[1]] = None
            elif found := match(line):
                begun.pop(found[2], None)
        self.begun |= begun

    def failed(self, name: bytes, line: bytes) -> FailedItem:
        """Return the failure of an item from its last line."""
        error = (parse_line(line) or {}).get("error")
        _, count = self._failures.get(name, (b"", 1))
        return FailedItem(json.loads(name), str(error), count)

    def speed(self) -> tuple[float, float]:
        """Return items per minute and seconds of sound per second."""
        if not self.times:
            return 0.0, 0.0
        times, sounds, seconds = (
            np.frombuffer(values) for values in (self.times, self.sounds, self.seconds)
        )
        recent = times >= times.max() - WINDOW
        span = max(times.max() - (times - seconds)[recent].min(), 1e-3)
        return float(60 * recent.sum() / span), float(sounds[recent].sum() / span)


def _blocks(path: Path) -> Iterator[list[bytes]]:
    """Yield the complete lines of a file, many at a time.

    Raises:
        FormatError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            rest = b""
            while block := file.read(_BLOCK):
                *lines, rest = (rest + block).split(b"\n")
                yield lines
                rest = rest if len(rest) <= MAX_LINE else b""
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror}") from None


def _lines_at_end(path: Path, size: int) -> list[bytes]:
    """Return the complete lines among the last bytes of a file."""
    with path.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - size))
        return file.read().split(b"\n")[:-1]


def _without_name(item: FailedItem) -> str:
    """Return the reason of a failure without the name of the item."""
    text, name = item.error, item.id.rpartition("/")[2]
    # Most begin with the path of the input, which ends with the name and a suffix.
    _, found, after = text.partition(name)
    if found and ": " in after and " " not in after.partition(": ")[0]:
        text = after.partition(": ")[2]
    is_path = (f"{name}.", f"/{name}")
    words = ("..." if any(part in word for part in is_path) else word for word in text.split())
    return " ".join(words) or item.error


def _with_numbers(text: str, numbers: Iterable[str]) -> str:
    """Return a text with other numbers in place of its own."""
    given = iter(numbers)
    return _DIGITS.sub(lambda _: next(given), text)
