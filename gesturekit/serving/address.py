"""Addresses of services: where they listen, and from where they may be used."""

from __future__ import annotations

import socket

from starlette.requests import HTTPConnection

from gesturekit.errors import ConfigError

LOOPBACK = ("localhost", "127.0.0.1", "[::1]", "::1")


def listening_socket(host: str, port: int) -> socket.socket:
    """Return a socket that listens; port 0 takes a free one.

    Raises:
        ConfigError: the address is in use, or not of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        # The message of `create_server` repeats the address.
        reason = (error.strerror or str(error)).partition(" (while")[0]
        raise ConfigError(
            f"--host {host} --port {port}: {reason}; another --port may be free"
        ) from None


def address_of(listening: socket.socket, host: str) -> str:
    """Return the URL of a socket that listens on this host."""
    shown = f"[{host}]" if ":" in host else host
    return f"http://{shown}:{listening.getsockname()[1]}/"


def is_foreign(request: HTTPConnection) -> bool:
    """Return whether a page of another site sends a request, or opens a WebSocket."""
    origin = request.headers.get("origin")
    # An origin is scheme://host[:port], or no address at all ("null", "http://[::1").
    return origin is not None and origin.partition("://")[2] != request.headers.get("host")
