"""Leases: one process for each shard, and one run for each folder."""

import json
import os
import socket
import subprocess
import sys
import threading
import time

import pytest
from filelock import FileLock

from gesturekit.errors import ConfigError
from gesturekit.jobs import Lease, live_leases
from gesturekit.jobs import lease as module

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
    with pytest.raises(ConfigError, match=rf"(?=.*1 of 2)(?=.*\b{os.getpid()}\b)"):
        Lease(tmp_path, 1, 2, RUN)
    with pytest.raises(ConfigError, match=rf"(?=.*\b{os.getpid()}\b)(?=.*--out)"):
        Lease(tmp_path, 2, 2, {"plan": "q"})
    two = Lease(tmp_path, 2, 2, RUN)
    assert [about["pid"] for about in live_leases(tmp_path)] == [os.getpid()] * 2
    one.release()
    Lease(tmp_path, 1, 2, RUN).release()
    two.release()
    assert live_leases(tmp_path) == []


def test_the_lease_of_a_killed_process_is_free_at_once(tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(ConfigError, match=rf"\b{holder.pid}\b"):
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


def test_a_lease_of_another_host_expires_without_heartbeats(tmp_path):
    path = tmp_path / "leases" / "00001-of-00001.json"
    path.parent.mkdir()
    path.write_text(json.dumps({"host": "elsewhere", "pid": 1, "since": 0.0, "run": RUN}))
    with pytest.raises(ConfigError, match="elsewhere"):
        Lease(tmp_path, 1, 1, RUN)
    for seconds in (50, -50):  # the clock of the other host may be ahead
        beat = time.time() - seconds
        os.utime(path, (beat, beat))
        (about,) = live_leases(tmp_path)
        assert about["age"] == pytest.approx(max(seconds, 0), abs=3)
    os.utime(path, (0, 0))
    Lease(tmp_path, 1, 1, RUN).release()


def test_a_suspended_process_notices_that_its_lease_was_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "HEARTBEAT", 0.01)
    mine = Lease(tmp_path, 1, 1, RUN)
    mine.check()
    mine.path.write_text(json.dumps({"host": "elsewhere"}))
    limit = time.monotonic() + 10
    while not mine.is_lost:
        assert time.monotonic() < limit
        time.sleep(0.01)
    with pytest.raises(ConfigError, match=str(mine.path)):
        mine.check()
    mine.release()
    assert mine.path.exists()  # it belongs to the other process
