"""Leases: one process for each shard, and one run for each folder."""

from __future__ import annotations

import errno
import json
import os
import socket
import subprocess
import sys
import threading
import time
from datetime import datetime
from pathlib import Path

import pytest
from filelock import FileLock

from gesturekit.errors import ConfigError
from gesturekit.jobs import lease as module
from gesturekit.jobs.lease import Lease, live_leases

RUN = {"plan": "p"}
HOLD = """
import sys, time
from pathlib import Path
from gesturekit.jobs.lease import Lease
Lease(Path(sys.argv[1]), 1, 2, {"plan": "p"})
print("held", flush=True)
time.sleep(60)
"""


def test_a_shard_is_leased_once_and_another_shard_of_the_run_beside_it(tmp_path):
    one = Lease(tmp_path, 1, 2, RUN)
    with pytest.raises(ConfigError, match="shard 1 of 2 is being processed, by process"):
        Lease(tmp_path, 1, 2, RUN)
    with pytest.raises(ConfigError, match="another run, with other inputs or settings"):
        Lease(tmp_path, 2, 2, {"plan": "q"})
    two = Lease(tmp_path, 2, 2, RUN)
    assert [about["pid"] for about in live_leases(tmp_path)] == [os.getpid()] * 2
    one.release()
    one.release()
    again = Lease(tmp_path, 1, 2, RUN)
    again.path.unlink()
    giver = threading.Thread(target=again.release)  # of a run that another thread goes on with
    giver.start()
    giver.join()
    Lease(tmp_path, 1, 2, RUN).release()
    two.release()
    assert live_leases(tmp_path) == []
    assert not [thread for thread in threading.enumerate() if thread.name == "heartbeat"]


def test_a_lock_without_a_lease_is_another_run_that_begins(tmp_path):
    (tmp_path / "leases").mkdir()
    lock = FileLock(tmp_path / "leases" / "00002-of-00003.lock")
    with lock, pytest.raises(ConfigError, match="shard 2 of 3 is being processed$"):
        Lease(tmp_path, 2, 3, RUN)
    Lease(tmp_path, 2, 3, RUN).release()


def test_a_lease_that_cannot_be_written_leaves_the_shard_free(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        with pytest.raises(OSError, match="No space left"):
            Lease(tmp_path, 1, 1, RUN)
    FileLock(tmp_path / "leases" / "00001-of-00001.lock").acquire(timeout=0)
    assert live_leases(tmp_path) == []


def test_the_lease_of_a_killed_process_is_free_at_once(tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(ConfigError, match=f"by process {holder.pid}"):
        Lease(tmp_path, 1, 2, RUN)
    holder.kill()
    holder.wait()
    Lease(tmp_path, 1, 2, {"plan": "another"}).release()


def test_a_lock_that_outlives_its_process_for_a_moment_is_waited_for(tmp_path):
    """A worker that was being started when its parent was killed inherits the lock."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    path = tmp_path / "leases" / "00001-of-00001.json"
    path.parent.mkdir()
    about = {"host": socket.gethostname(), "pid": gone.pid, "since": 0.0, "run": RUN}
    path.write_text(json.dumps(about))
    lock = FileLock(path.with_suffix(".lock"), thread_local=False)
    lock.acquire()
    begun = time.monotonic()
    threading.Timer(0.2, lock.release).start()
    lease = Lease(tmp_path, 1, 1, RUN)
    assert time.monotonic() - begun >= 0.2
    assert [about["pid"] for about in live_leases(tmp_path)] == [os.getpid()]
    lease.release()


def test_a_lock_whose_process_may_live_is_not_waited_for(tmp_path):
    """Another user's process, this one, and numbers that no process has."""
    path = tmp_path / "leases" / "00001-of-00001.json"
    path.parent.mkdir()
    begun = time.monotonic()
    with FileLock(path.with_suffix(".lock")):
        for pid in (os.getpid(), 1, 0, -5, 1 << 31, 1 << 40, "7", None):
            path.write_text(json.dumps({"host": socket.gethostname(), "pid": pid, "run": RUN}))
            with pytest.raises(ConfigError, match=f"by process {pid} on .* since an unknown time"):
                Lease(tmp_path, 1, 1, RUN)
    assert time.monotonic() - begun < 4
    path.write_text("not JSON")  # of whatever host
    assert [about["file"] for about in live_leases(tmp_path)] == [path.name]
    os.utime(path, (0, 0))
    Lease(tmp_path, 1, 1, RUN).release()


def test_a_lease_of_another_host_expires_without_heartbeats(tmp_path):
    path = tmp_path / "leases" / "00001-of-00001.json"
    path.parent.mkdir()
    path.write_text(json.dumps({"host": "elsewhere", "pid": 1, "since": 0.0, "run": RUN}))
    since = datetime.fromtimestamp(0).strftime("%Y-%m-%d %H:%M")
    with pytest.raises(ConfigError, match=f"on elsewhere since {since}"):
        Lease(tmp_path, 1, 1, RUN)
    for seconds in (50, -50):  # the clock of the other host may be ahead
        beat = time.time() - seconds
        os.utime(path, (beat, beat))
        (about,) = live_leases(tmp_path)
        assert about["file"] == path.name
        assert about["age"] == pytest.approx(max(seconds, 0), abs=3)
    long_ago = time.time() - 2 * module.EXPIRY
    os.utime(path, (long_ago, long_ago))
    Lease(tmp_path, 1, 1, RUN).release()


def test_a_suspended_process_notices_that_its_lease_was_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "HEARTBEAT", 0.01)
    mine = Lease(tmp_path, 1, 1, RUN)
    limit = time.monotonic() + 10
    with monkeypatch.context() as patch:  # a file system that is away for a moment
        failed = []

        def fail(path):
            failed.append(path)
            raise OSError(errno.EIO, "Input/output error")

        patch.setattr(os, "utime", fail)
        while len(failed) < 2:
            assert time.monotonic() < limit
            time.sleep(0.01)
    before = mine.path.stat().st_mtime_ns
    while mine.path.stat().st_mtime_ns == before:
        assert time.monotonic() < limit
        time.sleep(0.01)
    mine.check()
    mine.path.write_text(json.dumps({"host": "elsewhere"}))
    while not mine.is_lost:
        assert time.monotonic() < limit
        time.sleep(0.01)
    with pytest.raises(ConfigError, match="another one has taken its shard over"):
        mine.check()
    mine.release()
    assert mine.path.exists()  # it belongs to the other process
    os.utime(mine.path, (0, 0))
    mine = Lease(tmp_path, 1, 1, RUN)
    mine.path.unlink()
    while not mine.is_lost:
        assert time.monotonic() < limit
        time.sleep(0.01)
    mine.release()
