"""Requests: their settings, their body on disk, and who may send them."""

from __future__ import annotations

import asyncio
import hmac
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

from fastapi import HTTPException, Query, Request
from pydantic import BaseModel
from starlette.requests import ClientDisconnect

from gesturekit.serving.limits import Limits


class MotionRequest(BaseModel, extra="forbid"):
    """Settings of a motion, from the query of a URL. None of them is the name of a file."""

    format: Annotated[
        Literal["bvh", "npz", "html"], Query(description="html is a player with the sound")
    ] = "bvh"
    seed: Annotated[int, Query(ge=0, lt=2**63)] = 0
    style: Annotated[str | None, Query(max_length=200, description="one of the model's styles")] = (
        None
    )
    speaker: Annotated[str | None, Query(max_length=200)] = None
    foot_lock: bool = True
    smooth: Annotated[float | None, Query(ge=0, le=2, description="seconds")] = None
    vad: Annotated[bool | None, Query(description="voice activity detection")] = None


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
    if not declared.isascii() or not declared.isdecimal() or int(declared[:20]) > limits.n_bytes:
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
    origin = request.headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != request.headers.get("host"):
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
