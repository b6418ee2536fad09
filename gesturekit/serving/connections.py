"""Connections of a service: few for each client, and none that waits for its client for ever."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from gesturekit.serving.requests import Limits

_TOO_MANY = b'{"error": "too many connections of this client"}\n'
_REFUSAL = (
    b"HTTP/1.1 429 Too Many Requests\r\nContent-Type: application/json\r\nRetry-After: 10\r\n"
    b"Connection: close\r\nContent-Length: %d\r\n\r\n%s" % (len(_TOO_MANY), _TOO_MANY)
)


class Connection(H11Protocol):
    """HTTP connection with the time limits that uvicorn lacks.

    It is refused if its client's address has `limits.connections` already. It is closed if the
    header of a request, or the rest of a body after its answer, takes over `limits.header_seconds`,
    or if the client takes nothing of an answer for `limits.body_seconds`.

    Args:
        limits: limits of the service.
        given: what uvicorn gives to a protocol.
    """

    def __init__(self, limits: Limits, **given: Any) -> None:
        super().__init__(**given)
        self._limits = limits
        self._awaited: asyncio.TimerHandle | None = None
        self._unsent: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Refuse the connection if its client has too many, or await its first request."""
        super().connection_made(transport)
        address = self.client[:1] if self.client else None
        clients = [getattr(each, "client", None) for each in self.connections]
        if sum(1 for each in clients if each and each[:1] == address) > self._limits.connections:
            transport.write(_REFUSAL)
            transport.close()
        self._await_request()

    def data_received(self, data: bytes) -> None:
        """Read a part of a request."""
        super().data_received(data)
        self._await_request()

    def connection_lost(self, exc: Exception | None) -> None:
        """End all timers."""
        super().connection_lost(exc)
        self._await_request()
        self.resume_writing()

    def pause_writing(self) -> None:
        """Watch whether the client takes the answer."""
        super().pause_writing()
        self._watch_answer(None)

    def resume_writing(self) -> None:
        """Go on with the answer."""
        super().resume_writing()
        if self._unsent is not None:
            self._unsent.cancel()

    def _await_request(self) -> None:
        """Limit the time until there is a request in work."""
        in_work = self.cycle is not None and not self.cycle.response_complete
        # Connections that are closed, or that became WebSockets, are no longer listed.
        if in_work or self not in self.connections:
            if self._awaited is not None:
                self._awaited.cancel()
            self._awaited = None
        elif self._awaited is None:
            wait = self._limits.header_seconds
            self._awaited = self.loop.call_later(wait, self.transport.abort)

    def _watch_answer(self, before: int | None) -> None:
        """Close the connection if as many bytes are unsent as `before`."""
        unsent = self.transport.get_write_buffer_size()
        if unsent == before:
            self.transport.abort()
        else:
            wait = self._limits.body_seconds
            self._unsent = self.loop.call_later(wait, self._watch_answer, unsent)


def server_config(app: Any, limits: Limits, **more: Any) -> uvicorn.Config:
    """Return the settings of a server whose connections are limited.

    Args:
        app: ASGI application.
        limits: limits of the service.
        more: other settings of uvicorn.
    """
    return uvicorn.Config(
        app,
        http=partial(Connection, limits),  # type: ignore[arg-type]  # uvicorn calls what it gets
        limit_concurrency=4 * (limits.workers + limits.queue) + 32,
        timeout_keep_alive=5,
        server_header=False,
        proxy_headers=False,
        **more,
    )
