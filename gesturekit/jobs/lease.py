"""Leases: one process at a time works on a shard, and no two runs mix in one folder.

A lease is a JSON file with process and host, whose time of change is renewed as a heartbeat, and a
file lock beside it. On one host the lock tells whether the owner is alive; for an owner on another
host, whose lock may not be visible, the heartbeat does.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from audio_features.atomic import atomic_write
from gesturekit.errors import ConfigError
from gesturekit.jobs.state import MAX_LINE, parse_line, shard_name

HEARTBEAT = 15.0
"""Seconds between signs of life."""
EXPIRY = 120.0
"""Seconds without a sign of life after which a lease of another host counts as abandoned."""
_GRACE = 5.0


class Lease:
    """The right to work on one shard, until `release`.

    Args:
        state: folder of state; it must exist.
        shard, shards: the shard, counted from 1, and their number.
        run: description of plan and settings; all live leases of a folder have the same.

    Raises:
        ConfigError: a live process has this shard, or works in the folder with another `run`.
    """

    def __init__(self, state: Path, shard: int, shards: int, run: dict[str, Any]) -> None:
        folder = state / "leases"
        use = f"shard {shard} of {shards} is being processed" if shards > 1 else "it is in use"
        folder.mkdir(exist_ok=True)
        self.path = folder / f"{shard_name(shard, shards)}.json"
        self._lock = _lock_of(self.path)
        for other in live_leases(state):
            if other.get("run") != run:
                raise ConfigError(
                    f"{state.parent}: another run, with other inputs or settings, is writing "
                    f"there, {_owner(other)}; wait for it, or give another --out"
                )
            if other["file"] == self.path.name:
                raise ConfigError(
                    f"{state.parent}: {use}, {_owner(other)}; wait for it, or end that process"
                )
        try:
            self._lock.acquire(blocking=False)
        except Timeout:
            raise ConfigError(f"{state.parent}: {use}") from None
        about = {"host": socket.gethostname(), "pid": os.getpid(), "since": time.time()}
        self._about = {**about, "run": run}
        try:
            with atomic_write(self.path) as temporary:
                temporary.write_text(json.dumps(self._about), encoding="utf-8")
        except OSError:
            self._lock.release()
            raise
        self.is_lost = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True, name="heartbeat")
        self._thread.start()

    def check(self) -> None:
        """Check that the lease is still ours; a suspended process may have lost it.

        Raises:
            ConfigError: another process has taken the shard over.
        """
        if self.is_lost:
            raise ConfigError(
                f"{self.path}: this process sent no heartbeat for too long, and another one has "
                "taken its shard over; stopped"
            )

    def release(self) -> None:
        """Give the shard back; doing so twice is harmless."""
        self._stop.set()
        self._thread.join()
        if self._lock.is_locked:
            if not self.is_lost:
                self.path.unlink(missing_ok=True)
            self._lock.release()

    def _beat(self) -> None:
        while not self._stop.wait(HEARTBEAT):
            try:
                if _content(self.path) != self._about:
                    self.is_lost = True
                    return
                os.utime(self.path)
            except FileNotFoundError:
                self.is_lost = True
                return
            except OSError:
                continue  # the next beat may succeed


def live_leases(state: Path) -> list[dict[str, Any]]:
    """Return the leases of living processes: host, pid, since, run, file, and age in seconds."""
    found = []
    for path in sorted((state / "leases").glob("*.json")):
        try:
            about = _content(path) or {}
            age = max(0.0, time.time() - path.stat().st_mtime)
        except OSError:
            continue  # given back in this moment
        if _is_live(path, about, age):
            found.append(about | {"file": path.name, "age": age})
    return found


@contextmanager
def locked(state: Path) -> Iterator[None]:
    """Hold the lock of a folder's state while plan and leases are settled."""
    state.mkdir(parents=True, exist_ok=True)
    with FileLock(state / "lock"):
        yield


def _is_live(path: Path, about: dict[str, Any], age: float) -> bool:
    if about.get("host") != socket.gethostname():
        return age < EXPIRY
    lock = _lock_of(path)
    try:
        # A worker that was being started when its parent was killed has the lock a moment longer.
        lock.acquire(timeout=_GRACE if _is_gone(about.get("pid")) else 0, poll_interval=0.02)
    except Timeout:
        return True
    except OSError:
        return age < EXPIRY  # a file system without locks, or of another user
    lock.release()
    return False


def _is_gone(pid: Any) -> bool:
    """Return whether it is certain that no process of this host has a number."""
    if os.name != "posix" or not isinstance(pid, int) or not 0 < pid < 1 << 31:
        return False
    try:
        os.kill(pid, 0)  # sends nothing
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False


def _content(path: Path) -> dict[str, Any] | None:
    """Return the JSON object in a lease; None for anything else.

    Raises:
        OSError: the file cannot be read.
    """
    if path.exists() and not path.is_file():  # reading a pipe may never end
        return None
    with path.open("rb") as file:
        return parse_line(file.read(MAX_LINE))


def _lock_of(path: Path) -> FileLock:
    return FileLock(path.with_suffix(".lock"), thread_local=False)


def _owner(about: dict[str, Any]) -> str:
    try:
        since = time.strftime("%Y-%m-%d %H:%M", time.localtime(float(about["since"])))
    except (LookupError, TypeError, ValueError, OverflowError, OSError):  # written by others
        since = "an unknown time"
    return f"by process {about.get('pid')} on {about.get('host')} since {since}"
