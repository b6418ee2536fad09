"""Journals: append-only files of JSON lines, one file for each shard; the record of what was done.

Kinds of lines, by their first field:

- `{"run": NAME, ...}`: a process begins, with the settings that its results have in common;
- `{"started": ID, "run": ..., "time": ...}`: an item is in progress;
- `{"status": ..., "id": ..., ...}`: the result of an attempt, see `Result`.

An item that was started and has no result was in progress when a process was killed. Damaged lines,
which a killed process or a full disk may leave, are ignored.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from gesturekit.errors import FormatError
from gesturekit.jobs.result import Result, file_facts, path_digest
from gesturekit.jobs.state import FORMAT, parse_line, read_lines, shard_name
from gesturekit.jobs.task import Task

ATTEMPTS = 3
"""Failures with the same input and settings after which an item is skipped."""
FIRST_FIELDS = ("status", "id", "time", "seconds", "sound", "key")
"""Fields with which the line of a result begins, in this order."""
_LAST_TIME = 1e11  # later times, in the year 5138, are damage
_STARTED, _STATUS = b'{"started"', b'{"status"'


class Journal:
    """Journal of one shard, open for appending.

    Args:
        state: folder of state; it must exist.
        shard, shards: the shard, counted from 1, and their number.
        settings: what all results of this process have in common, as JSON values.
        run: name of these settings.
        about: further fields of the first line.
        after: time of the latest line so far (`History.latest`); a clock that was set back since
            is corrected by the difference, as results are ordered by time.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(
        self,
        state: Path,
        shard: int,
        shards: int,
        *,
        run: str,
        settings: dict[str, Any],
        about: dict[str, Any],
        after: float = 0.0,
    ) -> None:
        self._begun = max(time.time(), math.nextafter(after, math.inf)) - time.monotonic()
        path = state / "journal" / f"{shard_name(shard, shards)}.jsonl"
        path.parent.mkdir(exist_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0)
        self.run, self._file = run, os.open(path, flags, 0o666)
        try:
            size = os.fstat(self._file).st_size
            # Begin a new line after one that a killed process left unfinished.
            self._begin = b"\n" if size and os.pread(self._file, 1, size - 1) != b"\n" else b""
            about = {"format": FORMAT, "time": self._time(), **about}
            self._append({"run": run, "settings": settings, **about})
        except BaseException:
            os.close(self._file)
            raise

    def start(self, name: str) -> None:
        """Record that an item is in progress, before any of its files is written."""
        self._append({"started": name, "run": self.run, "time": self._time()})
        os.fsync(self._file)

    def finish(self, result: Result) -> None:
        """Record the result of an attempt."""
        values = {name: getattr(result, _FIELDS.get(name, name)) for name in _TYPES}
        values |= {"run": self.run, "time": self._time(), "sound": round(result.sound, 4)}
        # `jobs` finds what it needs at the beginning of a line, without parsing the whole.
        first = {name: values[name] for name in FIRST_FIELDS}
        self._append(first | {name: value for name, value in values.items() if value})

    def close(self) -> None:
        """Write everything to the disk, and close the file."""
        os.fsync(self._file)
        os.close(self._file)

    def _time(self) -> float:
        return self._begun + time.monotonic()

    def _append(self, values: dict[str, Any]) -> None:
        line = self._begin + json.dumps(values).encode() + b"\n"
        written = os.write(self._file, line)  # one call: lines of processes never mix
        self._begin = b"" if written == len(line) else b"\n"
        if written < len(line):
            os.write(self._file, line[written:])  # raises OSError if the disk is full
            self._begin = b""


class History:
    """Content of the journals of a folder, by item.

    Args:
        state: folder of state; it need not exist.
        wanted: ids of the items to remember; None for all.

    Attributes:
        latest: the latest time in the journals, seconds since 1970; 0 without one.

    Raises:
        FormatError: a journal cannot be opened, or was written by a newer version.
    """

    def __init__(self, state: Path, wanted: Container[str] | None = None) -> None:
        self._out = state.parent
        self.runs: dict[str, dict[str, Any]] = {}
        self._results: dict[str, list[bytes]] = {}
        self._started: dict[str, list[tuple[float, str]]] = {}
        self.latest = 0.0
        for path in journal_files(state):
            for kind, values, line in _read(path):
                if isinstance(values.get("time"), int | float):
                    self.latest = max(self.latest, min(values["time"], _LAST_TIME))
                if kind == "run":
                    self.runs[values["run"]] = values
                elif wanted is None or values["id"] in wanted:
                    if kind == "started":
                        start = (values["time"], values["run"])
                        self._started.setdefault(values["id"], []).append(start)
                    else:
                        self._results.setdefault(values["id"], []).append(line)

    def names(self) -> list[str]:
        """Return the ids of all items with a result, in the order of their first."""
        return list(self._results)

    def results(self, name: str) -> list[Result]:
        """Return the results of all attempts at an item, the latest last."""
        lines = self._results.get(name, ())
        found = [result for line in lines if (result := _result(parse_line(line) or {}))]
        return sorted(found, key=lambda result: result.time)

    def killed(self, name: str) -> list[str]:
        """Return the runs that were killed while they processed this item, since its last
        result."""
        starts = self._started.get(name)
        if not starts:
            return []
        last = max((result.time for result in self.results(name)), default=0.0)
        return [run for at, run in starts if at >= last]

    def unfinished(self, name: str) -> list[str]:
        """Return the runs that may have left files of an item which no journal lists."""
        runs = self.killed(name)
        for result in self.results(name):
            if result.status in ("lost", "dropped"):
                runs.append(result.run)
        return runs

    def failures(self, name: str, key: str) -> list[Result]:
        """Return the failures of an item with a key since it was last done."""
        found: list[Result] = []
        for result in self.results(name):
            if result.key == key and result.status != "dropped":
                found = [] if result.status == "done" else [*found, result]
        return found

    def compare(
        self, name: str, file: Path, made_with: Mapping[str, Any]
    ) -> Literal["same", "begun", "other"]:
        """Compare an existing file of an item with the one that would be made now.

        Returns:
            "same" for a complete file with the same `made_with`; "begun" for one that an
            interrupted run was writing with the same settings; "other" for anything else.
        """
        result = self._latest(name, file)
        if result is not None and self._made_with(result.run, result.input, file) == made_with:
            if self._is_unchanged(file, result.digests[self._key(file)]):
                return "same"
            return "other"
        for run in self.unfinished(name):
            was = self._made_with(run, {}, file)
            if was.items() <= made_with.items():
                return "begun"
        return "other"

    def differences(self, name: str, file: Path, made_with: Mapping[str, Any]) -> list[str]:
        """Return the settings that differed when a file was made; empty without a record of it."""
        result = self._latest(name, file)
        if result is None:
            return []
        was = self._made_with(result.run, result.input, file)
        return [name for name in {**was, **made_with} if was.get(name) != made_with.get(name)]

    def input_digest(self, name: str, audio: Path) -> str | None:
        """Return the SHA-256 of an input as a journal has it, if its size and time are the same."""
        about = file_facts(audio)
        for result in reversed(self.results(name)):
            if result.stamp == about:
                return result.input.get("input")
        return None

    def _latest(self, name: str, file: Path) -> Result | None:
        key = self._key(file)
        results = reversed(self.results(name))
        return next((result for result in results if key in result.digests), None)

    def _made_with(self, run: str, item: Mapping[str, Any], file: Path) -> dict[str, Any]:
        about = self.runs.get(run, {"settings": {"run": run}})
        written = about.get("written", {}).get(file.suffix[1:], {})
        return {**about["settings"], **item, **written}

    def _is_unchanged(self, file: Path, about: Mapping[str, Any]) -> bool:
        facts = file_facts(file)
        if facts is not None and all(facts[name] == about.get(name) for name in facts):
            return True
        return about.get("sha256") == path_digest(file)

    def _key(self, file: Path) -> str:
        return file.relative_to(self._out).as_posix()


def journal_files(state: Path) -> list[Path]:
    """Return the journals of a folder of state, by name."""
    return sorted((state / "journal").glob("*.jsonl"))


def last_run(state: Path, field: str = "run") -> dict[str, Any] | None:
    """Return the first line of the latest run in a folder that has a field; None without one."""
    lines = [
        values
        for path in journal_files(state)
        for kind, values, _ in _read(path)
        if kind == "run" and field in values
    ]
    return max(lines, key=lambda values: values["time"], default=None)


def _read(path: Path) -> Iterator[tuple[str, dict[str, Any], bytes]]:
    """Yield (run, started or result; its values; the line) of one journal.

    A start whose result is the next line is left out, as most are.
    """
    pending: bytes | None = None
    for line in read_lines(path):
        if line.startswith(_STARTED):
            if pending is not None:
                yield from _checked_start(pending)
            pending = line
            continue
        values = parse_line(line)
        if values is None:
            continue
        if not line.startswith(_STATUS):
            yield from _checked_run(path, values, line)
        elif isinstance(values.get("id"), str):
            if pending is not None and (parse_line(pending) or {}).get("started") != values["id"]:
                yield from _checked_start(pending)
            pending = None
            yield "result", values, line
    if pending is not None:
        yield from _checked_start(pending)


def _checked_start(line: bytes) -> Iterator[tuple[str, dict[str, Any], bytes]]:
    values = parse_line(line) or {}
    name, at, run = (values.get(key) for key in ("started", "time", "run"))
    if isinstance(name, str) and isinstance(at, int | float) and isinstance(run, str):
        yield "started", {"id": name, "time": at, "run": run}, line


def _checked_run(
    path: Path, values: dict[str, Any], line: bytes
) -> Iterator[tuple[str, dict[str, Any], bytes]]:
    number = values.get("format")
    if isinstance(number, int) and number > FORMAT:
        raise FormatError(
            f"{path}: format {number} is newer than this gesturekit reads ({FORMAT}); upgrade it, "
            "or give another folder"
        )
    is_run = isinstance(values.get("run"), str) and isinstance(values.get("settings"), dict)
    if is_run and number == FORMAT and isinstance(values.get("time"), int | float):
        yield "run", values, line


_TYPES: dict[str, Any] = {
    **dict.fromkeys(("status", "id", "key", "run"), str),
    "attempt": int,
    **dict.fromkeys(("seconds", "sound", "time"), (int, float)),
    **dict.fromkeys(("files", "input", "source"), dict),
    "error": (str, type(None)),
}
"""Fields of a result in the journal, with their types."""
_FIELDS = {"files": "digests", "source": "stamp"}
"""Names in `Result` of those fields that have another there."""


def _result(values: dict[str, Any]) -> Result | None:
    """Return the result in a line's values; None if one has a wrong type."""
    known = {name: value for name, value in values.items() if name in _TYPES}
    if any(not isinstance(value, _TYPES[name]) for name, value in known.items()):
        return None
    if any(not isinstance(about, dict) for about in known.get("files", {}).values()):
        return None
    task = Task(known.pop("id"))
    return Result(task, **{_FIELDS.get(name, name): value for name, value in known.items()})
