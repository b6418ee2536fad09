"""Threads on a CPU: for rows of frames, and for tasks that stand side by side."""

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


class _Allowance(threading.local):
    """How many threads this Python thread's rows may use; None leaves it to torch."""

    rows: int | None = None


_allowance = _Allowance()
T = TypeVar("T")


@contextmanager
def only_rows_in_threads() -> Iterator[None]:
    """Within, torch's own operations stay on one thread, and rows have as many as torch had.

    Training and sampling have thousands of operations too short to be shared. Between them torch's
    threads wait busily, on processors that rows could use.
    """
    if _allowance.rows is not None:
        yield
        return
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    _allowance.rows = count
    try:
        yield
    finally:
        _allowance.rows = None
        torch.set_num_threads(count)


def row_threads() -> int:
    """How many threads rows may use here."""
    return _allowance.rows or torch.get_num_threads()


def side_by_side(*tasks: Callable[[], T]) -> list[T]:
    """What independent tasks give, within `only_rows_in_threads` made on the threads of rows.

    Each thread takes the next task when it is done with one: the longest should come first. A task
    finds torch's modes (gradients, half precision) as a new thread does and sets what it needs;
    the rows that it filters have what threads are left over. Without `only_rows_in_threads` tasks
    are done in turn.
    """
    count = min(_allowance.rows or 1, len(tasks))
    if count == 1:
        return [task() for task in tasks]
    own_rows = _allowance.rows // count
    left, made = deque(enumerate(tasks)), {}

    def work() -> None:
        before, _allowance.rows = _allowance.rows, own_rows
        try:
            while left:
                try:
                    number, task = left.popleft()
                except IndexError:  # another thread was there first
                    return
                made[number] = task()
        finally:
            _allowance.rows = before

    waiting = [submit("tasks", work) for _ in range(count - 1)]
    try:
        work()
    except BaseException:
        left.clear()
        raise
    finally:
        wait(waiting)  # whatever happened here: nothing goes on unseen
    for one in waiting:
        one.result()
    return [made[number] for number in range(len(tasks))]


def submit(work: str, function: Callable[..., T], *arguments: Any) -> Future[T]:
    """Have a thread call it: one of those for tasks, or for rows, which tasks wait for."""
    return _threads(work).submit(function, *arguments)


@lru_cache(maxsize=2)
def _threads(work: str) -> ThreadPoolExecutor:
    """As many threads as were ever wanted at once."""
    return ThreadPoolExecutor(thread_name_prefix=work)


if hasattr(os, "register_at_fork"):  # threads do not come along into a forked process
    os.register_at_fork(after_in_child=_threads.cache_clear)
