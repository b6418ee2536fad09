"""Worker processes: results of all tasks, whatever happens to a worker."""

from __future__ import annotations

import logging
import operator
import os
import time
from functools import partial

import pytest

from gesturekit.errors import ConfigError
from gesturekit.jobs.workers import Failure, Pool


def test_dead_and_late_workers_fail_only_their_own_task():
    tasks = [partial(abs, -n) for n in range(4)]
    tasks.insert(1, partial(os._exit, 3))
    tasks.insert(3, partial(time.sleep, 60))
    begun = []
    results = dict(Pool(operator.call, 2, deadline=3.0).map(tasks, begun.append))
    assert [results[tasks[i]] for i in (0, 2, 4, 5)] == [0, 1, 2, 3]
    died, late = results[tasks[1]], results[tasks[3]]
    assert isinstance(died, Failure) and "exit code 3" in str(died)
    assert isinstance(late, Failure) and "after 3 s, the deadline" in str(late)
    assert [begun.count(tasks[1]), begun.count(tasks[3])] == [3, 1], "deaths are tried again"


def test_log_messages_of_a_worker_arrive(caplog):
    log = partial(logging.getLogger("there").warning, "%s is odd", "a.wav")
    ((_, result),) = Pool(operator.call, 1).map([log], lambda task: None)
    assert result is None and "a.wav is odd" in caplog.text


def test_functions_that_cannot_be_pickled_are_refused():
    with pytest.raises(ConfigError, match="use 1 worker"):
        Pool(lambda task: task, 2)
