"""Plan of the work on many items: an immutable file with one JSON line for each.

The first line is a header: format, number of items and seconds of sound in each shard, and the
SHA-256 of all other lines. The file is replaced as a whole or not at all.
"""

from __future__ import annotations

import hashlib
import heapq
import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from audio_features.atomic import atomic_write
from gesturekit.errors import ConfigError, FormatError
from gesturekit.jobs.state import FORMAT, MAX_LINE, parse_line
from gesturekit.jobs.task import Task

PLAN = "plan.jsonl"
"""Name of the plan in the folder of state."""


@dataclass(frozen=True)
class Plan:
    """A plan file.

    Attributes:
        path: the file.
        request: SHA-256 of the request: two runs with the same request share a plan.
        sha256: SHA-256 of the lines of all items.
        shards: (number of items, seconds of sound) of each shard.
        made: time of writing, seconds since 1970.
    """

    path: Path
    request: str
    sha256: str
    shards: tuple[tuple[int, float], ...]
    made: float

    @property
    def n_items(self) -> int:
        """Number of items in all shards."""
        return sum(count for count, _ in self.shards)

    @property
    def seconds(self) -> float:
        """Seconds of sound in all shards."""
        return sum(seconds for _, seconds in self.shards)

    @classmethod
    def open(cls, path: Path) -> Plan | None:
        """Read and check a plan; None if there is none.

        Raises:
            FormatError: the file is damaged, or written by a newer version.
        """
        try:
            with path.open("rb") as file:
                header = parse_line(file.readline(MAX_LINE)) or {}
                if header.get("format") != FORMAT:
                    what = header.get("format", "none")
                    raise FormatError(
                        f"{path}: format {what!r}, expected {FORMAT}: made by another version of "
                        "gesturekit, or damaged; delete it, and the next run makes a new plan"
                    )
                body = hashlib.file_digest(file, "sha256").hexdigest()
            plan = cls(
                path,
                str(header["request"]),
                str(header["sha256"]),
                tuple((int(count), float(seconds)) for count, seconds in header["shards"]),
                float(header["made"]),
            )
        except FileNotFoundError:
            return None
        except OSError as error:
            raise FormatError(f"{path}: {error.strerror}") from None
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            if isinstance(error, FormatError):
                raise
            raise FormatError(f"{path}: damaged header; delete it for a new plan") from None
        if plan.sha256 != body or not plan.shards:
            raise FormatError(f"{path}: its lines were changed; delete it for a new plan")
        return plan

    def tasks(self, shard: int | None = None) -> Iterator[Task]:
        """Yield the tasks of a shard (counted from 1), or all, in the order of the plan.

        Raises:
            FormatError: the file cannot be read.
        """
        # Lines begin with the shard, so that those of others need not be parsed.
        begin = b'{"shard": ' + (b"" if shard is None else b"%d," % shard)
        try:
            with self.path.open("rb") as file:
                file.readline(MAX_LINE)
                for line in file:
                    if line.startswith(begin):
                        yield self._task(parse_line(line) or {})
        except OSError as error:
            raise FormatError(f"{self.path}: {error.strerror}") from None

    def _task(self, values: dict[str, Any]) -> Task:
        is_valid = values.keys() <= _TYPES.keys() and "id" in values
        if not is_valid or any(not isinstance(v, _TYPES[name]) for name, v in values.items()):
            raise FormatError(f"{self.path}: an item with wrong fields; delete it for a new plan")
        fields = {name: value for name, value in values.items() if name != "shard"}
        path = fields.get("path")
        return Task(**{**fields, "path": None if path is None else Path(path)})


_TYPES: dict[str, Any] = {
    "shard": int,
    "id": str,
    "path": (str, type(None)),
    "duration": (int, float, type(None)),
    "more": dict,
    "source": str,
}


def write_plan(path: Path, tasks: Sequence[Task], shards: int, request: str) -> Plan:
    """Write a plan whose shards hold about the same seconds of sound, and return it.

    The longest items are assigned first, each to the shard with the least so far. Equal tasks and
    number of shards give equal lines.

    Raises:
        OSError: the file cannot be written.
    """
    numbers = balanced([task.duration or 0.0 for task in tasks], shards)
    totals = [(0, 0.0)] * shards
    digest = hashlib.sha256()
    with atomic_write(path) as temporary:
        body = temporary.with_suffix(".body")
        try:
            with body.open("wb") as file:
                for task, number in zip(tasks, numbers, strict=True):
                    count, seconds = totals[number - 1]
                    totals[number - 1] = count + 1, seconds + (task.duration or 0.0)
                    line = _line(task, number)
                    digest.update(line)
                    file.write(line)
            header: dict[str, Any] = {"format": FORMAT, "request": request}
            header |= {"sha256": digest.hexdigest(), "shards": totals, "made": time.time()}
            with temporary.open("wb") as file, body.open("rb") as lines:
                file.write(json.dumps(header).encode() + b"\n")
                while block := lines.read(1 << 20):
                    file.write(block)
        finally:
            body.unlink(missing_ok=True)
    return Plan(path, request, header["sha256"], tuple(totals), header["made"])


def balanced(durations: Sequence[float], shards: int) -> list[int]:
    """Return the shard of each item, counted from 1, so that all have about equal sums.

    Raises:
        ConfigError: `shards` is not positive.
    """
    if shards < 1:
        raise ConfigError(f"{shards} shards: give at least 1")
    # Items without a duration cost little, but not nothing.
    heap = [(0.0, number) for number in range(1, shards + 1)]
    numbers = [1] * len(durations)
    for index in sorted(range(len(durations)), key=lambda i: (-durations[i], i)):
        total, number = heap[0]
        heapq.heapreplace(heap, (total + durations[index] + 0.1, number))
        numbers[index] = number
    return numbers


def parse_shard(text: str) -> tuple[int, int]:
    """Return (1, 8) of "1/8".

    Raises:
        ConfigError: not two whole numbers of which the first is between 1 and the second.
    """
    number, _, count = text.partition("/")
    try:
        shard, shards = int(number), int(count)
    except ValueError:
        shard, shards = 0, 0
    if not 1 <= shard <= shards <= 99_999:
        raise ConfigError(f"shard {text!r}: expected a number of 1 to N and N, such as 1/8 or 8/8")
    return shard, shards


def _line(task: Task, shard: int) -> bytes:
    # Another process may read it in another working folder.
    path = None if task.path is None else os.path.abspath(task.path)  # noqa: PTH100
    values: dict[str, Any] = {"shard": shard, "id": task.id}
    values |= {"path": path, "duration": task.duration}
    if task.more:
        values["more"] = task.more
    if task.source != (path or task.id):
        values["source"] = task.source
    return json.dumps(values).encode() + b"\n"
