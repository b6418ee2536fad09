"""The HTTP application and its figures for Prometheus; see docs/serve.md."""

from __future__ import annotations

import errno
import logging
import re
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from starlette.exceptions import HTTPException as AnyHTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware

from audio_features.errors import AudioFeaturesError
from gesturekit.errors import GestureKitError
from gesturekit.model import Model
from gesturekit.serving.address import LOOPBACK
from gesturekit.serving.pages import DROP_PAGE, PAGE_HEADERS, api_page
from gesturekit.serving.requests import (
    Limits,
    MotionRequest,
    Rate,
    check_origin,
    check_token,
    receive,
)
from gesturekit.serving.worker import BusyError, Worker
from gesturekit.wording import printable


class Metrics:
    """Counters of one service.

    Args:
        admitted: function that returns the number of requests that are queued or being processed.
    """

    def __init__(self, admitted: Callable[[], int]) -> None:
        self._registry = CollectorRegistry()
        args: dict[str, Any] = {"registry": self._registry, "namespace": "gesturekit"}
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


log = logging.getLogger(__name__)
_TYPES = {"bvh": "text/plain", "npz": "application/octet-stream", "html": "text/html"}
_BODY = {
    "requestBody": {
        "description": "A sound file: wav, flac, ogg, mp3, aiff, au.",
        "required": True,
        "content": {
            kind: {"schema": {"type": "string", "format": "binary"}}
            for kind in ("audio/wav", "application/octet-stream")
        },
    }
}
_ERRORS = {
    400: "no sound in the body, or the connection was closed",
    401: "the token is missing or wrong",
    403: "sent by a page of another site",
    408: "the sound arrived too slowly",
    413: "the sound is too large",
    422: "the sound or a setting cannot be used",
    429: "too many requests or connections of this client",
    503: "the queue is full, or the disk",
}


def create_app(
    model: Model,
    limits: Limits | None = None,
    *,
    token: str | None = None,
    hosts: tuple[str, ...] = LOOPBACK,
) -> FastAPI:
    """Return the application of one model.

    Args:
        model: model with speech input.
        limits: limits of requests.
        token: what requests must send as `Authorization: Bearer TOKEN`; None for no token.
        hosts: names under which the service is reached; requests for others are refused, so that
            a page elsewhere cannot reach it under a name of its own.

    Raises:
        GestureKitError: the model has no speech input.
    """
    limits = limits or Limits()
    worker = Worker(model, limits)
    figures = Metrics(lambda: worker.admitted)
    worker.warm_up()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        with tempfile.TemporaryDirectory(prefix="gesturekit-serve-") as folder:
            app.state.folder = Path(folder)
            yield

    app = FastAPI(
        title="gesturekit",
        version=metadata.version("gesturekit"),
        summary="Speech to body motion",
        docs_url=None,  # FastAPI's own page loads its scripts from a CDN
        redoc_url=None,
        lifespan=lifespan,
    )
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=list(hosts))
    app.add_exception_handler(AnyHTTPException, _as_json)
    app.add_exception_handler(RequestValidationError, _as_json)

    service = _Service(worker, Rate(limits.per_minute), figures, limits, token)
    _add_motion(app, service)
    _add_pages(app, service)
    return app


@dataclass(frozen=True)
class _Service:
    worker: Worker
    rate: Rate
    figures: Metrics
    limits: Limits
    token: str | None


def _add_motion(app: FastAPI, service: _Service) -> None:
    @app.post(
        "/motion",
        openapi_extra=_BODY,
        responses={status: {"description": text} for status, text in _ERRORS.items()},
        response_class=Response,
    )
    async def motion(request: Request, asked: Annotated[MotionRequest, Query()]) -> Response:
        """Turn a sound into motion of the same length."""
        begun, status = time.perf_counter(), 500
        try:
            check_origin(request)
            check_token(request, service.token)
            _check_rate(request, service.rate)
            content, seconds = await _answer(request, asked, service)
            service.figures.sound.inc(seconds)
            status = 200
        except HTTPException as error:
            status = error.status_code
            raise
        finally:
            service.figures.requests.labels(str(status)).inc()
            service.figures.seconds.observe(time.perf_counter() - begun)
        return _file(content, asked.format)


def _add_pages(app: FastAPI, service: _Service) -> None:
    model = service.worker.model

    @app.get("/health")
    async def health() -> dict[str, Any]:
        """Say that the service works, and with which model."""
        about = {"status": "ok", "version": metadata.version("gesturekit"), "kind": model.kind}
        return about | {"fps": model.recorded_fps, "styles": list(model.styles)}

    @app.get("/metrics", response_class=Response)
    async def figures(request: Request) -> Response:
        """Return figures for Prometheus."""
        check_token(request, service.token)
        return Response(
            service.figures.page(), media_type="text/plain; version=0.0.4; charset=utf-8"
        )

    @app.get("/", include_in_schema=False)
    async def page() -> HTMLResponse:
        return HTMLResponse(DROP_PAGE, headers=PAGE_HEADERS)

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return HTMLResponse(api_page(app.openapi(), service.limits), headers=PAGE_HEADERS)


def _check_rate(request: Request, rate: Rate) -> None:
    wait = rate.wait(request.client.host if request.client else "")
    if wait:
        after = {"Retry-After": str(int(wait) + 1)}
        raise HTTPException(429, f"too many requests; try again in {wait:.0f} s", after)


async def _answer(request: Request, asked: MotionRequest, service: _Service) -> tuple[bytes, float]:
    """Return a motion's file and the seconds of its sound.

    Everything that a request writes lies in a folder of its own, under fixed names.

    Raises:
        HTTPException: it cannot be done.
    """
    try:
        with (
            service.worker.admit(),
            tempfile.TemporaryDirectory(dir=request.app.state.folder) as folder,
        ):
            sound = Path(folder) / "speech"
            await receive(request, sound, service.limits)
            try:
                return await service.worker.render(sound, asked)
            except (GestureKitError, AudioFeaturesError) as error:
                reason = re.sub("`ffmpeg [^`]*`", "`ffmpeg -i YOUR_FILE speech.wav`", str(error))
                reason = reason.replace(str(sound), "the sound")
                raise HTTPException(422, reason.replace(folder, "")) from None
    except BusyError:
        raise HTTPException(503, "all workers are busy", {"Retry-After": "10"}) from None
    except (OSError, MemoryError, RuntimeError) as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise HTTPException(503, "the disk of the service is full") from None
        log.exception("a request failed")
        raise HTTPException(500, "the motion could not be made; see the log") from None


def _file(content: bytes, kind: str) -> Response:
    headers = {
        "Content-Disposition": f"{'inline' if kind == 'html' else 'attachment'}; "
        f'filename="motion.{kind}"',
        "X-Content-Type-Options": "nosniff",
        # A player that is opened directly runs without the rights of this site.
        "Content-Security-Policy": "sandbox allow-scripts",
    }
    return Response(content, media_type=_TYPES[kind], headers=headers)


async def _as_json(request: Request, error: Exception) -> JSONResponse:
    if isinstance(error, RequestValidationError):
        said = (f"{wrong['loc'][-1]}: {wrong['msg']}" for wrong in error.errors()[:5])
        return JSONResponse({"error": printable("; ".join(said)[:1000])}, 422)
    assert isinstance(error, AnyHTTPException)
    return JSONResponse({"error": printable(str(error.detail))}, error.status_code, error.headers)
