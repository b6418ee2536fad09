"""Files that a batch keeps in its output folder, below the hidden folder `STATE`, as JSON.

- `records/*/*.json`: one file for each item, see `Result`; it is replaced as a whole when an
  attempt at the item begins, and when it ends.
- `items.json`: the ids of all items, for `gesturekit jobs`.
- `running/*.json`: one file for each running process, with a file lock beside it.

`status_of` is the state of the work, from these files alone.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from audio_features.atomic import atomic_write, write_text
from gesturekit.errors import ConfigError, FormatError
from gesturekit.jobs.result import Result, Task

STATE = ".gesturekit"
"""Name of the folder of state in an output folder."""
FORMAT = 1
"""Number of the format of all files of state."""
ANY_FILE = "*"
"""Key in `Result.begun` of files of all formats."""
_ITEMS = "items.json"
_MAX_ITEMS, _MAX_RECORD = 1 << 28, 1 << 24  # bytes
_PATIENCE = 2.0  # seconds that the lock of a killed process may remain, see `running`
_STORED: dict[str, Any] = {
    **dict.fromkeys(("status", "key"), str),
    **dict.fromkeys(("failures", "killed"), int),
    **dict.fromkeys(("sound", "seconds", "time"), float),
    **dict.fromkeys(("input", "stamp", "made", "begun"), dict),
    "error": (str, type(None)),
}
"""Fields of a result in its record, with their types."""


def state_folder(out: Path) -> Path:
    """Return the folder of state of an output folder; neither need exist.

    Raises:
        ConfigError: it, or something in it, is a symbolic link.
    """
    state = out / STATE
    inside = [*state.iterdir(), *state.glob("*/*")] if state.is_dir() else []
    for path in (state, *inside):
        if path.is_symlink():
            raise ConfigError(f"{path} is a link that leads out of {out}: remove it")
    return state


def shard_of(name: str, shards: int) -> int:
    """Return the shard of an item, counted from 1: it depends on its id alone."""
    return int(_digest(name)[:15], 16) % shards + 1


def read_record(state: Path, task: Task) -> Result:
    """Return what is known of a task; its status is "left" if that is nothing.

    Of a task with a damaged record, such as after a loss of power, all files count as begun.

    Raises:
        FormatError: the record was written by a newer version.
    """
    path = _record_of(state, task.id)
    result = _result(task, _read(path))
    if result is None:
        return Result(task, begun={ANY_FILE: {}} if path.exists() else {})
    return result


def write_record(state: Path, result: Result) -> None:
    """Store what is known of a task.

    That an attempt begins is on the disk at once: a loss of power leaves no file that is not known.

    Raises:
        OSError: the file cannot be written.
    """
    values = {"format": FORMAT, "id": result.id}
    values |= {name: getattr(result, name) for name in _STORED}
    flush = result.status == "begun"
    with atomic_write(_record_of(state, result.id), flush=flush) as temporary:
        temporary.write_text(json.dumps(values), encoding="utf-8")


def all_records(state: Path) -> Iterator[Result]:
    """Yield what is known of each item.

    Raises:
        FormatError: a record was written by a newer version.
    """
    for path in sorted(state.glob("records/*/*.json"), key=str):
        values = _read(path)
        name = values.get("id")
        if isinstance(name, str) and path.stem == _digest(name)[2:32]:
            result = _result(Task(name), values)
            if result is not None:
                yield result


def write_items(state: Path, names: list[str], shards: int, about: Mapping[str, Any]) -> None:
    """Store the ids of all items, the number of shards, and further facts about the run.

    Raises:
        OSError: the file cannot be written.
    """
    before = _read(state / _ITEMS, _MAX_ITEMS)
    values = {**before, **about, "format": FORMAT, "shards": shards, "items": names}
    if values != before:
        write_text(state / _ITEMS, json.dumps(values))


def read_items(state: Path) -> dict[str, Any] | None:
    """Return what `write_items` stored: `items`, `shards` and facts; None if there was no run.

    Raises:
        FormatError: the file is damaged, or was written by a newer version.
    """
    path = state / _ITEMS
    if not path.exists():
        return None
    values = _read(path, _MAX_ITEMS)
    names, shards = values.get("items"), values.get("shards")
    is_list = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not is_list or not isinstance(shards, int) or not 1 <= shards < 100_000:
        raise FormatError(f"{path}: damaged; delete it, and the next run writes it again")
    return values


@contextmanager
def claimed(state: Path, name: str = "run", run: str = "") -> Iterator[None]:
    """Keep other processes from the same work, and from other runs in the same folder.

    Args:
        state: folder of state; it is made.
        name: of the part of the work, such as that of a shard.
        run: digest of the settings, which all processes in a folder have in common.

    Raises:
        ConfigError: a live process does this part of the work, or another run; or the folder cannot
            be written to.
    """
    path = state / "running" / f"{name}.json"
    lock, until = _lock_of(path), time.monotonic() + _PATIENCE
    about = {"host": socket.gethostname(), "pid": os.getpid(), "since": time.time(), "run": run}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while not lock.is_locked:
            with FileLock(state / "lock"):
                reason = _conflict(state, path.name, run)
                if reason is None:
                    lock.acquire(blocking=False)
                    write_text(path, json.dumps(about))
            # A worker that was being started when its parent was killed keeps the lock a moment.
            if reason is not None and time.monotonic() > until:
                raise ConfigError(f"{state.parent}: {reason}")
            time.sleep(0.0 if reason is None else 0.05)
    except OSError as error:
        lock.release()
        raise ConfigError(f"{state}: {error.strerror or error}") from None
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        lock.release()


def running(state: Path) -> list[dict[str, Any]]:
    """Return host, pid, since, run and name of the living processes that work in a folder."""
    found = []
    for path in sorted(state.glob("running/*.json")):
        lock = _lock_of(path)
        try:
            lock.acquire(blocking=False)
        except Timeout:
            found.append({**_read(path), "name": path.stem})
        except OSError:
            continue  # of another user, whose records this process cannot replace either
        else:
            lock.release()
    return found


def _conflict(state: Path, name: str, run: str) -> str | None:
    for other in running(state):
        at = ""
        with suppress(KeyError, TypeError, ValueError, OverflowError, OSError):  # written by others
            since = time.localtime(float(other["since"]))
            at = time.strftime(" since %Y-%m-%d %H:%M", since)
        owner = f"by process {other.get('pid')} on {other.get('host')}{at}"
        if other.get("run") != run:
            return (
                f"another run, with other settings or shards, is writing there, {owner}; wait for "
                "it, or give another --out"
            )
        if f"{other['name']}.json" == name:
            return f"{other['name']} is being processed {owner}; wait for it, or end that process"
    return None


def _lock_of(path: Path) -> FileLock:
    return FileLock(path.with_suffix(".lock"), thread_local=False)


def _digest(name: str) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()


def _record_of(state: Path, name: str) -> Path:
    digest = _digest(name)
    return state / "records" / digest[:2] / f"{digest[2:32]}.json"


def _result(task: Task, values: dict[str, Any]) -> Result | None:
    """Return the result of a record; None if a value is missing or has a wrong type."""
    if not all(isinstance(values.get(name), kind) for name, kind in _STORED.items()):
        return None
    abouts = (*values["made"].values(), *values["begun"].values())
    if not all(isinstance(about, dict) for about in abouts):
        return None
    return Result(task, **{name: values[name] for name in _STORED})


def _read(path: Path, most: int = _MAX_RECORD) -> dict[str, Any]:
    """Return the JSON object in a file; {} if there is none.

    Raises:
        FormatError: it was written by a newer version.
    """
    try:
        if not path.is_file():  # reading a pipe may never end
            return {}
        with path.open("rb") as file:
            # A read allocates all that it is asked for.
            values = json.loads(file.read(min(os.fstat(file.fileno()).st_size, most)))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(values, dict):
        return {}
    number = values.get("format")
    if isinstance(number, int) and number > FORMAT:
        raise FormatError(f"{path}: format {number}; this gesturekit reads {FORMAT}; upgrade it")
    return values


WINDOW = 600.0
"""Seconds of work before the latest result from which speed is computed."""
_NUMBER = re.compile(r"(?<![A-Za-z\d])\d+([.,]\d+)*")


@dataclass(frozen=True)
class Status:
    """State of the work in a folder.

    Attributes:
        items: number of items of the latest run.
        done: number of them that are done.
        sound: seconds of sound of all results.
        failed: results of the items that failed.
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
    failed: list[Result]
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
        raise ConfigError(f"{out}: no work was done in it; give the --out of a batch")
    outcomes: dict[str, Result | None] = {}  # None for an item that is done
    in_hand: list[str] = []
    times: list[tuple[float, float, float]] = []
    for result in all_records(state):
        if result.status == "done":
            outcomes[result.id] = None
            times.append((result.time, result.seconds, result.sound))
        elif result.status in ("failed", "lost"):
            outcomes[result.id] = result
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


def _without_name(item: Result) -> str:
    """Return the reason of a failure without the name of the item, and paths that have it."""
    name = re.escape(item.id.rpartition("/")[2])
    return re.sub(rf"\S*(/{name}|{name}\.)\S*", "...", str(item.error)).removeprefix("... ")
