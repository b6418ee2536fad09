"""Worker processes: a dead or stuck worker costs one item, and is replaced."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any

from gesturekit.errors import ConfigError
from gesturekit.jobs.journal import ATTEMPTS

log = logging.getLogger(__name__)
_context = multiprocessing.get_context("spawn")
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


class Failure(Exception):
    """Failure of an item outside of its function: its worker died, or was too slow."""


class Pool:
    """Processes that call one function with one task at a time.

    The function is handed to each process when it starts, through a pipe to our own child; no
    file is involved. Warnings and log messages of the workers appear in this process.

    Args:
        function: what to call; it must be possible to pickle it.
        workers: number of processes; the cores are divided among them.
        deadline: seconds after which an attempt is ended, or None.

    Raises:
        ConfigError: the function cannot be handed over.
    """

    def __init__(
        self, function: Callable[[Any], Any], workers: int, deadline: float | None = None
    ) -> None:
        self._deadline, self._count = deadline, workers
        try:
            self._function = pickle.dumps(function)
        except Exception as error:  # whatever an attribute's __reduce__ raises
            raise ConfigError(
                f"this model cannot be handed to worker processes ({error}); use 1 worker"
            ) from None
        self._workers: list[_Worker] = []

    def map(self, tasks: Iterable[Any], begin: Callable[[Any], None]) -> Iterator[tuple[Any, Any]]:
        """Yield (task, result) as they finish; the result is a `Failure` where there is none.

        A task whose worker died is tried again, up to `ATTEMPTS` times in all.

        Args:
            tasks: what the function is called with.
            begin: called with a task before it is handed to a worker.

        Raises:
            ConfigError: a worker cannot start.
        """
        waiting, left = iter(tasks), deque[Any]()
        deaths: dict[int, int] = {}
        try:
            while True:
                self._hand_out(waiting, left, begin)
                busy = [worker for worker in self._workers if worker.task is not None]
                if not busy:
                    return
                for worker in self._ready(busy):
                    done = worker.handle()
                    if done is None:
                        continue
                    task, result = done
                    if isinstance(result, Failure):
                        self._workers.remove(worker)
                        died = deaths[id(task)] = deaths.get(id(task), 0) + 1
                        if died < ATTEMPTS and worker.late_after is None:
                            log.warning("%s; it is tried again", result)
                            left.append(task)
                            continue
                    yield task, result
        finally:
            self.close()

    def close(self) -> None:
        """End all workers, in the middle of what they do."""
        for worker in self._workers:
            worker.end()
        self._workers.clear()

    def _hand_out(
        self, waiting: Iterator[Any], left: deque[Any], begin: Callable[[Any], None]
    ) -> None:
        """Give each idle worker a task, and start workers up to their number."""
        while True:
            idle = next((worker for worker in self._workers if worker.task is None), None)
            if idle is None and len(self._workers) >= self._count:
                return
            # Items whose worker died come last.
            task = next(waiting, None)
            if task is None:
                if not left:
                    return
                task = left.popleft()
            if idle is None:
                idle = _Worker(self._function, max(1, (os.cpu_count() or 1) // self._count))
                self._workers.append(idle)
            begin(task)
            idle.give(task)

    def _ready(self, busy: list[_Worker]) -> list[_Worker]:
        """Return workers with a message, and those that died or are past the deadline."""
        while True:
            deadline = self._deadline or float("inf")
            limit = min(worker.begun for worker in busy) + deadline
            timeout = None if limit == float("inf") else max(0.0, limit - time.monotonic())
            ready = wait([worker.pipe for worker in busy], timeout)
            if found := [worker for worker in busy if worker.pipe in ready]:
                return found
            late = [w for w in busy if w.begun + deadline <= time.monotonic()]
            for worker in late:
                worker.stop_late(deadline)
            if late:
                return late


class _Worker:
    """One process, and the task that it has."""

    def __init__(self, function: bytes, threads: int) -> None:
        self.pipe, theirs = _context.Pipe()
        self.task: Any = None
        self.late_after: float | None = None
        self.begun = float("inf")
        self.is_started = False
        self._process = _context.Process(target=_serve, args=(theirs, function), daemon=True)
        with _environment(dict.fromkeys(_THREADS, str(threads))):
            self._process.start()
        theirs.close()

    def give(self, task: Any) -> None:
        """Hand a task over; that the worker is dead is noticed in `handle`."""
        self.task = task
        # The deadline counts from the moment at which the worker has loaded everything.
        self.begun = time.monotonic() if self.is_started else float("inf")
        with suppress(OSError):
            self.pipe.send(task)

    def handle(self) -> tuple[Any, Any] | None:
        """Take one message; return (task, result) if it ends a task, else None.

        The result is a `Failure` if the worker died.
        """
        try:
            kind, value = self.pipe.recv()
        except (EOFError, OSError):
            return self._died()
        if kind == "result":
            task, self.task = self.task, None
            return task, value
        if kind == "refused":
            raise ConfigError(f"a worker process cannot start: {value}")
        if kind == "ready":
            self.is_started, self.begun = True, time.monotonic()
        elif kind == "log":
            logging.getLogger(value[0]).log(value[1], "%s", value[2])
        else:
            warnings.warn(value, stacklevel=2)
        return None

    def _died(self) -> tuple[Any, Any]:
        self._process.join()
        code = self._process.exitcode or 0
        if not self.is_started and self.late_after is None:
            raise ConfigError(
                f"a worker process ended while it started ({_ending(code)}); in a script, call "
                'this below `if __name__ == "__main__":`, or use 1 worker'
            )
        reason = (
            f"stopped after {self.late_after:g} s, the deadline of one item"
            if self.late_after is not None
            else f"its worker process ended ({_ending(code)})"
        )
        return self.task, Failure(reason)

    def stop_late(self, deadline: float) -> None:
        """End the process, whose task is past its deadline."""
        self.late_after = deadline
        self.end()

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()


def _ending(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
    return f"signal {name}" + (": perhaps memory ran out" if name == "SIGKILL" else "")


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables that are not set, for processes started inside."""
    new = {name: value for name, value in values.items() if name not in os.environ}
    os.environ.update(new)
    try:
        yield
    finally:
        for name in new:
            del os.environ[name]


class _Forward(logging.Handler):
    def __init__(self, pipe: Connection) -> None:
        super().__init__()
        self._pipe = pipe

    def emit(self, record: logging.LogRecord) -> None:
        self._pipe.send(("log", (record.name, record.levelno, record.getMessage())))


def _serve(pipe: Connection, function: bytes) -> None:
    """Call the function with what comes through the pipe, until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C ends
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    logging.getLogger().addHandler(_Forward(pipe))
    warnings.showwarning = lambda message, *_, **__: pipe.send(("warning", str(message)))
    try:
        call = pickle.loads(function)  # from our own parent, through its pipe
    except Exception as error:
        pipe.send(("refused", str(error) or type(error).__name__))
        return
    pipe.send(("ready", None))
    with suppress(EOFError):
        while True:
            pipe.send(("result", call(pipe.recv())))
