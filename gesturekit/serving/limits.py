"""Limits of the service, and the rate of each client."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from gesturekit.errors import ConfigError

_MOST_CLIENTS = 10_000


@dataclass(frozen=True)
class Limits:
    """Limits of the service.

    Attributes:
        megabytes: largest sound, in units of 2^20 bytes.
        seconds: longest sound.
        per_minute: requests for motion of each client address in a minute.
        queue: requests that are received or wait while all workers are busy.
        workers: number of motions that are generated at once.
        body_seconds: time in which a sound must have arrived.
    """

    megabytes: float = 64
    seconds: float = 600
    per_minute: float = 60
    queue: int = 16
    workers: int = 1
    body_seconds: float = 30

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            lowest = 0 if name == "queue" else 1e-3
            if not lowest <= value < float("inf"):
                raise ConfigError(f"{name} is {value}: give a positive number")

    @property
    def n_bytes(self) -> int:
        """Largest sound in bytes."""
        return int(self.megabytes * 2**20)


class Rate:
    """Rate limit of each client: a bucket of tokens that fills with time.

    Args:
        per_minute: tokens that a bucket gets in a minute, and holds at most.
        clock: function that returns seconds.
    """

    def __init__(self, per_minute: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._clock = max(1.0, per_minute), clock
        self._per_second = per_minute / 60
        # The least recently seen client is forgotten first, so that memory is bounded.
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait(self, client: str) -> float:
        """Take a token of a client; return 0, or the seconds until there is one."""
        now = self._clock()
        tokens, at = self._buckets.pop(client, (self._most, now))
        tokens = min(self._most, tokens + (now - at) * self._per_second)
        seconds = 0.0 if tokens >= 1 else (1 - tokens) / self._per_second
        self._buckets[client] = (tokens if seconds else tokens - 1, now)
        if len(self._buckets) > _MOST_CLIENTS:
            self._buckets.popitem(last=False)
        return seconds
