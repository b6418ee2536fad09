"""Access to services: where they listen, and who may use them."""

from __future__ import annotations

import hmac
import os
import socket
from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection

from gesturekit.errors import ConfigError

LOOPBACK = ("localhost", "127.0.0.1", "[::1]", "::1")
TOKEN = "GESTUREKIT_TOKEN"
"""Environment variable of the token."""
_ALL_INTERFACES = ("0.0.0.0", "::")


def listen(
    host: str, port: int, names: tuple[str, ...], token_file: Path | None
) -> tuple[socket.socket, str, tuple[str, ...], str | None]:
    """Return a socket that listens, its URL, the names under which it is reached, and the token.

    Args:
        host: address on which it listens. One of all interfaces has many names; there, any name is
            taken unless `names` are given, and the token protects.
        port: 0 takes a free one.
        names: additional names.
        token_file: file of the token; None for that of the environment.

    Raises:
        ConfigError: the address is in use, or not of this machine; see `_token_of`.
    """
    token, family = _token_of(host, token_file), socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listening = socket.create_server((host, port), family=family)
    except OSError as error:
        # The message of `create_server` repeats the address.
        reason = (error.strerror or str(error)).partition(" (while")[0]
        reason = f"{reason}; another --port may be free"
        raise ConfigError(f"--host {host} --port {port}: {reason}") from None
    is_any = host in _ALL_INTERFACES and not names
    shown = f"[{host}]" if ":" in host else host
    url = f"http://{shown}:{listening.getsockname()[1]}/"
    return listening, url, ("*",) if is_any else (*LOOPBACK, host, f"[{host}]", *names), token


def _token_of(host: str, file: Path | None) -> str | None:
    """Return the token of a file, or of the environment; None without one on this machine.

    Raises:
        ConfigError: it is short or more than one line, or `host` needs one.
    """
    if file is None and TOKEN not in os.environ:
        if host in LOOPBACK:
            return None
        how = f"give a token by --token-file or ${TOKEN}"
        raise ConfigError(f"--host {host} is reached from other machines: {how}")
    token = os.environ[TOKEN] if file is None else file.read_text(encoding="utf-8").strip()
    if len(token) < 16 or not token.isascii() or not token.isprintable() or " " in token:
        rule = "at least 16 printable ASCII characters without spaces"
        raise ConfigError(f"the token must be {rule}, such as those of: openssl rand -hex 16")
    return token


def is_foreign(request: HTTPConnection) -> bool:
    """Return whether a page of another site sends a request, or opens a WebSocket."""
    origin = request.headers.get("origin")
    # An origin is scheme://host[:port], or no address at all ("null", "http://[::1").
    return origin is not None and origin.partition("://")[2] != request.headers.get("host")


def check_origin(request: HTTPConnection) -> None:
    """Refuse requests that a page of another site sends through a user's browser.

    Raises:
        HTTPException: the page is of another site.
    """
    if is_foreign(request):
        raise HTTPException(403, "a page of another site may not use this service")


def check_token(request: HTTPConnection, token: str | None) -> None:
    """Compare the token of a request with that of the service, if it has one.

    Raises:
        HTTPException: the token is missing or wrong.
    """
    given = request.headers.get("authorization", "").encode()
    if token is not None and not hmac.compare_digest(given, f"Bearer {token}".encode()):
        headers = {"WWW-Authenticate": "Bearer"}
        raise HTTPException(401, "send the header Authorization: Bearer TOKEN", headers)
