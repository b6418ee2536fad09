"""Requests for motion: their settings, their limits, and their body on disk."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from fastapi import HTTPException, Query, Request
from pydantic import BaseModel, create_model
from starlette.requests import ClientDisconnect

from gesturekit.errors import ConfigError
from gesturekit.field_docs import field_docs
from gesturekit.model import Control, Controls, control_entries


@dataclass(frozen=True)
class Limits:
    """Limits of the service.

    Attributes:
        megabytes: largest sound, in units of 2^20 bytes.
        seconds: longest sound.
        queue: requests that are received or wait while all workers are busy.
        workers: number of motions that are generated at once.
        body_seconds: time in which a sound must have arrived.
        frames: longest motion: seconds of the sound times frames per second.
    """

    megabytes: float = 64
    seconds: float = 600
    queue: int = 16
    workers: int = 1
    body_seconds: float = 30
    frames: float = 36_000

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            lowest = 0 if name == "queue" else 1e-3
            if not lowest <= value < float("inf"):
                raise ConfigError(f"{name} is {value}: give a positive number")


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
    size, most = 0, int(limits.megabytes * 2**20)
    try:
        async with asyncio.timeout(limits.body_seconds):
            with file.open("wb") as out:
                async for block in request.stream():
                    size += len(block)
                    if size > most:
                        raise HTTPException(
                            413, f"the sound is larger than {limits.megabytes:g} MB"
                        )
                    out.write(block)
    except TimeoutError:
        raise HTTPException(
            408, f"the sound did not arrive within {limits.body_seconds:g} s"
        ) from None
    except ClientDisconnect:
        raise HTTPException(400, "the connection was closed") from None
    if not size:
        raise HTTPException(400, "send a sound file as the body: curl --data-binary @speech.wav")
