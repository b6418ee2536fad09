"""Requests: their settings, their limits and rate, their body on disk, and who may send them."""

from __future__ import annotations

import asyncio
import hmac
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from fastapi import HTTPException, Query, Request
from pydantic import BaseModel, create_model
from starlette.requests import ClientDisconnect

from gesturekit.errors import ConfigError
from gesturekit.field_docs import field_docs
from gesturekit.model import Control, Controls, control_entries
from gesturekit.serving.address import is_foreign

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
        body_seconds: time in which a sound must have arrived, and a client must take at least a
            part of an answer.
        frames: longest motion: seconds of the sound times frames per second.
        connections: open connections of each client address. With fewer than `workers` and `queue`
            together, no client alone can fill the queue.
        header_seconds: time in which the header of a request must have arrived.
    """

    megabytes: float = 64
    seconds: float = 600
    per_minute: float = 60
    queue: int = 16
    workers: int = 1
    body_seconds: float = 30
    frames: float = 36_000
    connections: int = 12
    header_seconds: float = 10

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
        seconds = max(0.0, 1 - tokens) / self._per_second
        self._buckets[client] = (tokens if seconds else tokens - 1, now)
        if len(self._buckets) > _MOST_CLIENTS:
            self._buckets.popitem(last=False)
        return seconds


def _query(name: str, entry: Control) -> tuple[Any, Any]:
    """Return the type and default of the query parameter of a control."""
    limits: dict[str, Any] = {"gt": entry.above, "ge": entry.least, "le": entry.most}
    if entry.kind is str:
        limits = {"max_length": 200}
    query = Query(description=field_docs(Controls)[name], **limits)
    kind: Any = Literal[entry.choices] if entry.choices else entry.kind
    return Annotated[kind if entry.default is not None else kind | None, query], entry.default


class _Settings(BaseModel, extra="forbid"):
    """Settings of a motion beside the controls."""

    format: Annotated[
        Literal["bvh", "npz", "html"], Query(description="html is a player with the sound")
    ] = "bvh"
    seed: Annotated[int, Query(ge=0, lt=2**63)] = 0
    item: Annotated[
        str,
        Query(
            max_length=1000,
            description="name of the utterance; other items with the same seed are other draws",
        ),
    ] = ""


# Settings of a motion, from the query of a URL: the controls of every system that are no file.
_CONTROLS: dict[str, Any] = {
    name: _query(name, entry)
    for name, entry in control_entries(Controls).items()
    if entry.kind not in (Path, None)
}
if TYPE_CHECKING:

    class MotionRequest(_Settings):
        """Settings and controls of a motion."""

        fps: float | None
else:
    MotionRequest = create_model("MotionRequest", __base__=_Settings, **_CONTROLS)


async def receive(request: Request, file: Path, limits: Limits) -> None:
    """Write the body of a request to a file.

    Raises:
        HTTPException: it is a form, too large, too slow, or empty.
    """
    if request.headers.get("content-type", "").startswith("multipart/"):
        raise HTTPException(
            422, "send the sound itself as the body, not a form: curl --data-binary @speech.wav"
        )
    too_large = HTTPException(413, f"the sound is larger than {limits.megabytes:g} MB")
    declared = request.headers.get("content-length", "0")
    if not declared.isdecimal() or int(declared[:20]) > limits.n_bytes:
        raise too_large
    size = 0
    try:
        async with asyncio.timeout(limits.body_seconds):
            with file.open("wb") as out:
                async for block in request.stream():
                    size += len(block)
                    if size > limits.n_bytes:
                        raise too_large
                    out.write(block)
    except TimeoutError:
        raise HTTPException(
            408, f"the sound did not arrive within {limits.body_seconds:g} s"
        ) from None
    except ClientDisconnect:
        raise HTTPException(400, "the connection was closed") from None
    if not size:
        raise HTTPException(400, "send a sound file as the body: curl --data-binary @speech.wav")


def check_origin(request: Request) -> None:
    """Refuse requests that a page of another site sends through a user's browser.

    Raises:
        HTTPException: the page is of another site.
    """
    if is_foreign(request):
        raise HTTPException(403, "a page of another site may not use this service")


def check_token(request: Request, token: str | None) -> None:
    """Compare the token of a request with that of the service, if it has one.

    Raises:
        HTTPException: the token is missing or wrong.
    """
    given = request.headers.get("authorization", "").encode()
    if token is not None and not hmac.compare_digest(given, f"Bearer {token}".encode()):
        raise HTTPException(
            401, "send the header Authorization: Bearer TOKEN", {"WWW-Authenticate": "Bearer"}
        )
