"""Worker processes: results of all tasks, whatever happens to a worker."""

import logging
import operator
import os
import signal
import time
import warnings
from functools import partial

import pytest

from gesturekit import workers
from gesturekit.errors import ConfigError
from gesturekit.workers import Failure, in_processes


def test_dead_and_late_workers_fail_only_their_own_task():
    tasks = [partial(abs, -n) for n in range(4)]
    tasks.insert(1, partial(os._exit, 3))
    tasks.insert(3, partial(time.sleep, 60))
    begun = []
    results = dict(in_processes(operator.call, tasks, 2, deadline=1.0, begin=begun.append))
    assert [results[tasks[i]] for i in (0, 2, 4, 5)] == [0, 1, 2, 3]
    died, late = results[tasks[1]], results[tasks[3]]
    assert isinstance(died, Failure) and "exit code 3" in str(died)
    assert isinstance(late, Failure) and "after 1 s" in str(late)
    assert [begun.count(tasks[k]) for k in (1, 3)] == [workers.ATTEMPTS, 1]


def test_cores_are_divided_among_the_workers_unless_the_user_says_otherwise(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("MKL_NUM_THREADS", "7")
    tasks = [partial(os.getenv, name) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")]
    found = dict(in_processes(operator.call, tasks, 2))
    assert [found[task] for task in tasks] == ["3", "7"]


class OnArrival:
    """A function that calls another one when a worker opens it."""

    def __init__(self, call, *arguments) -> None:
        self.call = call, arguments

    def __reduce__(self):
        return self.call

    def __call__(self, task) -> None: ...


def test_workers_that_cannot_start_are_one_clear_error():
    for function, says in (
        (OnArrival(int, "x"), "start & 'x'"),
        (OnArrival(os._exit, 4), "start & exit code 4"),
    ):
        with pytest.raises(ConfigError) as caught:
            list(in_processes(function, [1], 1))
        assert all(fact in str(caught.value) for fact in says.split(" & "))


def test_what_a_worker_says_arrives_and_a_signal_that_ended_it_is_named(monkeypatch, caplog):
    monkeypatch.setattr(workers, "ATTEMPTS", 1)
    tasks = [partial(warnings.warn, "odd sound"), partial(signal.raise_signal, signal.SIGKILL)]
    tasks.insert(1, partial(logging.getLogger("there").warning, "%s is odd", "a.wav"))
    with pytest.warns(UserWarning, match="odd sound"):
        found = dict(in_processes(operator.call, tasks, 1))
    assert found[tasks[0]] is None and "a.wav is odd" in caplog.text
    assert all(word in str(found[tasks[2]]) for word in ("SIGKILL", "memory"))
