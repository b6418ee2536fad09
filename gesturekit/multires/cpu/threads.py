"""Thread pools of the CPU engine: one for kernels, one for independent tasks."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, TypeVar

import torch


class _Local(threading.local):
    """Threads that kernels called from this Python thread may use; None for torch's number."""

    kernel_threads: int | None = None


_local = _Local()
T = TypeVar("T")


@contextmanager
def threads_for_kernels() -> Iterator[None]:
    """Within this context kernels use all of torch's threads, and torch's operators only one.

    Training and sampling call thousands of torch operators too short to be parallel. Between them
    torch's threads would spin on the cores that the kernels need.
    """
    if _local.kernel_threads is not None:
        yield
        return
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    _local.kernel_threads = count
    try:
        yield
    finally:
        _local.kernel_threads = None
        torch.set_num_threads(count)


def kernel_threads() -> int:
    """Return how many threads a kernel called from this thread may use."""
    return _local.kernel_threads or torch.get_num_threads()


def run_tasks(*tasks: Callable[[], T]) -> list[T]:
    """Return the results of independent tasks, run in parallel within `threads_for_kernels`.

    A free thread takes the next task, so that the longest should come first. A task starts with
    torch's default modes (gradients, autocast) and sets those it needs. The kernels it calls share
    the threads that are left. Outside of that context tasks run one after another.
    """
    count = min(_local.kernel_threads or 1, len(tasks))
    if count == 1:
        return [task() for task in tasks]
    own_threads = _local.kernel_threads // count
    left, made = deque(enumerate(tasks)), {}

    def work() -> None:
        before, _local.kernel_threads = _local.kernel_threads, own_threads
        try:
            while left:
                try:
                    number, task = left.popleft()
                except IndexError:  # another thread took the last one
                    return
                made[number] = task()
        finally:
            _local.kernel_threads = before

    futures = [submit("tasks", work) for _ in range(count - 1)]
    try:
        work()
    except BaseException:
        left.clear()
        raise
    finally:
        wait(futures)  # after an error too: no task may run on in the background
    for future in futures:
        future.result()
    return [made[number] for number in range(len(tasks))]


def submit(pool: str, function: Callable[..., T], *arguments: Any) -> Future[T]:
    """Call a function on a pool's thread: "tasks", or "kernels", which tasks wait for."""
    return _threads(pool).submit(function, *arguments)


@lru_cache(maxsize=2)
def _threads(pool: str) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix=pool)


if hasattr(os, "register_at_fork"):  # a forked process does not inherit threads
    os.register_at_fork(after_in_child=_threads.cache_clear)
