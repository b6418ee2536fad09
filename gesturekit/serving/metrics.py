"""Figures for Prometheus."""

from __future__ import annotations

from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest


class Metrics:
    """Counters of one service.

    Args:
        admitted: function that returns the number of requests that are queued or being processed.
    """

    def __init__(self, admitted: Callable[[], int]) -> None:
        self._registry = CollectorRegistry()
        args = {"registry": self._registry, "namespace": "gesturekit"}
        self.requests = Counter("requests", "Requests, by HTTP status.", ["status"], **args)
        self.sound = Counter("sound_seconds", "Seconds of sound in answers.", **args)
        self.seconds = Histogram(
            *("request_seconds", "Seconds of a request for motion, waiting included."),
            buckets=(0.1, 0.3, 1, 3, 10, 30, 100, 300),
            **args,
        )
        Gauge("queue", "Requests that wait or are in work.", **args).set_function(admitted)

    def page(self) -> bytes:
        """Return the figures as Prometheus reads them."""
        return generate_latest(self._registry)
