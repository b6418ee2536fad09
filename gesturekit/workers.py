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
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any

from gesturekit.errors import ConfigError

ATTEMPTS = 3
"""Times that an item is tried whose worker dies, or that fails."""
log = logging.getLogger(__name__)
_context = multiprocessing.get_context("spawn")
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
_INFINITE = float("inf")


class Failure(Exception):
    """Failure of an item outside of its function: its worker died, or was too slow."""


def in_processes(
    function: Callable[[Any], Any],
    tasks: Iterable[Any],
    workers: int,
    *,
    deadline: float | None = None,
    begin: Callable[[Any], object] = lambda task: None,
) -> Generator[tuple[Any, Any], None, None]:
    """Call a function with each task in worker processes.

    Warnings and log messages of the workers appear in this process. A task whose worker died is
    tried again, up to `ATTEMPTS` times in all.

    Args:
        function: what to call; it must be possible to pickle it.
        tasks: what it is called with.
        workers: number of processes; the cores are divided among them.
        deadline: seconds after which an attempt is ended, or None.
        begin: called with a task before it is handed to a worker.

    Yields:
        (task, result) as they finish; the result is a `Failure` where there is none.

    Raises:
        ConfigError: the function cannot be handed over, or a worker cannot start.
    """
    pickled = _pickled(function)
    waiting, again = iter(tasks), deque[Any]()
    deaths = Counter[int]()
    crew: list[_Worker] = []
    try:
        while True:
            while (idle := _idle(crew)) is not None or len(crew) < workers:
                task = next(waiting, None)
                if task is None and not again:
                    break
                task = again.popleft() if task is None else task  # those of dead workers come last
                if idle is None:
                    crew.append(idle := _Worker(pickled, max(1, (os.cpu_count() or 1) // workers)))
                begin(task)
                idle.give(task)
            busy = [worker for worker in crew if worker.task is not None]
            if not busy:
                return
            for worker in _ready(busy, deadline or _INFINITE):
                done = worker.handle()
                if done is None:
                    continue
                task, result = done
                if isinstance(result, Failure):
                    crew.remove(worker)
                    deaths[id(task)] += 1
                    if deaths[id(task)] < ATTEMPTS and not worker.late_after:
                        log.warning("%s; it is tried again", result)
                        again.append(task)
                        continue
                yield task, result
    finally:
        for worker in crew:
            worker.end()


def _pickled(function: Callable[[Any], Any]) -> bytes:
    try:
        return pickle.dumps(function)
    except Exception as error:  # whatever an attribute's __reduce__ raises
        raise ConfigError(
            f"this model cannot be handed to worker processes ({error}); use 1 worker"
        ) from None


def _idle(crew: list[_Worker]) -> _Worker | None:
    return next((worker for worker in crew if worker.task is None), None)


def _ready(busy: list[_Worker], deadline: float) -> list[_Worker]:
    """Return workers with a message, and those that died or are past the deadline."""
    while True:
        limit = min(worker.begun for worker in busy) + deadline
        timeout = None if limit == _INFINITE else max(0.0, limit - time.monotonic())
        pipes = wait([worker.pipe for worker in busy], timeout)
        late = [w for w in busy if w.begun + deadline <= time.monotonic() and w.pipe not in pipes]
        for worker in late:
            worker.late_after = deadline
            worker.end()
        if pipes or late:
            return [worker for worker in busy if worker.pipe in pipes or worker in late]


class _Worker:
    """One process, and the task that it has."""

    def __init__(self, function: bytes, threads: int) -> None:
        self.pipe, theirs = _context.Pipe()
        self.task: Any = None
        self.late_after = 0.0
        self.begun = _INFINITE
        self.is_started = False
        self._process = _context.Process(target=_serve, args=(theirs, function), daemon=True)
        with _environment(dict.fromkeys(_THREADS, str(threads))):
            self._process.start()
        theirs.close()

    def give(self, task: Any) -> None:
        """Hand a task over; that the worker is dead is noticed in `handle`."""
        self.task = task
        # The deadline counts from the moment at which the worker has loaded everything.
        self.begun = time.monotonic() if self.is_started else _INFINITE
        with suppress(OSError):
            self.pipe.send(task)

    def handle(self) -> tuple[Any, Any] | None:
        """Take one message; return (task, result) if it ends a task, else None.

        The result is a `Failure` if the worker died.
        """
        try:
            kind, value = self.pipe.recv()
        except (EOFError, OSError):
            return self.task, self._died()
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

    def _died(self) -> Failure:
        self._process.join()
        if self.late_after:
            return Failure(f"stopped after {self.late_after:g} s, the deadline of one item")
        ending = _ending(self._process.exitcode or 0)
        if not self.is_started:
            raise ConfigError(
                f"a worker process ended while it started ({ending}); in a script, call "
                'this below `if __name__ == "__main__":`, or use 1 worker'
            )
        return Failure(f"its worker process ended ({ending})")

    def end(self) -> None:
        """End the process, in the middle of what it does."""
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
