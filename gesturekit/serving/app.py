"""The HTTP application: requests and their limits, one model, a short queue, and its pages.

See docs/serve.md. The pages load nothing from elsewhere.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import re
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from html import escape
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
from fastapi import FastAPI, HTTPException, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from pydantic import BaseModel, create_model
from starlette.exceptions import HTTPException as AnyHTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect
from threadpoolctl import threadpool_limits

import audio_features as af
from gesturekit.errors import ConfigError, GestureKitError
from gesturekit.field_docs import field_docs
from gesturekit.model import Control, Controls, Model, control_entries
from gesturekit.serving.access import LOOPBACK, check_origin, check_token
from gesturekit.systems import bundled_speech, drawing_options
from gesturekit.wording import printable

log = logging.getLogger(__name__)
DROP_PAGE = Path(__file__).with_name("drop.html").read_text(encoding="utf-8")
"""Page on which one drops a sound and sees the motion."""
PAGE_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
        "img-src data: blob:; media-src data: blob:; connect-src 'self' data: blob:; "
        "frame-src blob:; worker-src blob:; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
_TYPES = {"bvh": "text/plain", "npz": "application/octet-stream", "html": "text/html"}
_PROMETHEUS = "text/plain; version=0.0.4; charset=utf-8"
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
_ERRORS: dict[int | str, dict[str, Any]] = {
    400: {"description": "no sound in the body, or the connection was closed"},
    401: {"description": "the token is missing or wrong"},
    403: {"description": "sent by a page of another site"},
    408: {"description": "the sound arrived too slowly"},
    413: {"description": "the sound is too large"},
    422: {"description": "the sound or a setting cannot be used"},
    503: {"description": "the queue is full, or the disk"},
}


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
        limits = {"max_length": 4000}
    query = Query(description=field_docs(Controls)[name], **limits)
    kind: Any = Literal[entry.choices] if entry.choices else entry.kind
    return Annotated[kind if entry.default is not None else kind | None, query], entry.default


_PLAYER = "html is a player with the sound"
_ITEM = "name of the utterance; other items with the same seed are other draws"


class _Settings(BaseModel, extra="forbid"):
    """Settings of a motion beside the controls."""

    format: Literal["bvh", "npz", "html"] = Query("bvh", description=_PLAYER)
    seed: int = Query(0, ge=0, lt=2**63)
    item: str = Query("", max_length=1000, description=_ITEM)


# Settings of a motion, from the query of a URL: the controls of every system that are no file.
_CONTROLS: dict[str, Any] = {
    name: _query(name, entry)
    for name, entry in control_entries(Controls).items()
    if entry.kind not in (Path, None)
}
if TYPE_CHECKING:
    MotionRequest = _Settings
else:
    MotionRequest = create_model("MotionRequest", __base__=_Settings, **_CONTROLS)


async def receive(request: Request, file: Path, limits: Limits) -> None:
    """Write the body of a request to a file.

    Raises:
        HTTPException: it is a form, too large, too slow, or empty.
    """
    curl = "curl --data-binary @speech.wav"
    if request.headers.get("content-type", "").startswith("multipart/"):
        raise HTTPException(422, f"send the sound itself as the body, not a form: {curl}")
    size, most = 0, limits.megabytes
    try:
        async with asyncio.timeout(limits.body_seconds):
            with file.open("wb") as out:
                async for block in request.stream():
                    size += len(block)
                    if size > int(most * 2**20):
                        raise HTTPException(413, f"the sound is larger than {most:g} MB")
                    out.write(block)
    except TimeoutError:
        late = f"the sound did not arrive within {limits.body_seconds:g} s"
        raise HTTPException(408, late) from None
    except ClientDisconnect:
        raise HTTPException(400, "the connection was closed") from None
    if not size:
        raise HTTPException(400, f"send a sound file as the body: {curl}")


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
        hosts: names under which the service is reached; no page elsewhere reaches it by its own.

    Raises:
        GestureKitError: the model has no speech input.
    """
    service = _Service(model, limits or Limits(), token)
    app = FastAPI(
        title="gesturekit",
        version=metadata.version("gesturekit"),
        summary="Speech to body motion",
        docs_url=None,  # FastAPI's own page loads its scripts from a CDN
        redoc_url=None,
        exception_handlers={AnyHTTPException: _as_json, RequestValidationError: _as_json},
    )
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=list(hosts))

    @app.post("/motion", openapi_extra=_BODY, responses=_ERRORS, response_class=Response)
    async def motion(request: Request, asked: Annotated[MotionRequest, Query()]) -> Response:
        """Turn a sound into motion of the same length."""
        return await service.counted_answer(request, asked)

    @app.get("/health")
    async def health() -> dict[str, Any]:
        """Say that the service works, and with which model."""
        about = {"kind": model.kind, "fps": model.recorded_fps, "styles": list(model.styles)}
        return {"status": "ok", "version": app.version} | about

    @app.get("/metrics", response_class=Response)
    async def figures(request: Request) -> Response:
        """Return figures for Prometheus."""
        check_token(request, token)
        return Response(generate_latest(service.registry), media_type=_PROMETHEUS)

    @app.get("/", include_in_schema=False)
    async def page() -> HTMLResponse:
        return HTMLResponse(DROP_PAGE, headers=PAGE_HEADERS)

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return HTMLResponse(_api_page(app.openapi(), service.limits), headers=PAGE_HEADERS)

    return app


class _Service:
    """A model, the threads that use it, and the counters of its requests.

    Raises:
        GestureKitError: the model cannot generate motion from sound.
    """

    def __init__(self, model: Model, limits: Limits, token: str | None) -> None:
        self.limits, self._model, self._token = limits, model, token
        self._warm_up()
        self._threads = ThreadPoolExecutor(limits.workers, "motion", torch.set_num_threads, (1,))
        self._admitted = 0
        self.registry = CollectorRegistry()
        args: dict[str, Any] = {"registry": self.registry, "namespace": "gesturekit"}
        self._requests = Counter("requests", "Requests, by HTTP status.", ["status"], **args)
        self._sound = Counter("sound_seconds", "Seconds of sound in answers.", **args)
        self._seconds = Histogram(
            *("request_seconds", "Seconds of a request for motion, waiting included."),
            buckets=(0.1, 0.3, 1, 3, 10, 30, 100, 300),
            **args,
        )
        queue = Gauge("queue", "Requests that wait or are in work.", **args)
        queue.set_function(lambda: self._admitted)

    def _warm_up(self) -> None:
        """Generate a short motion, so that the first request does not wait for compilation.

        From then on, matrix products of the whole process take one thread: their last bits depend
        on the number of threads, which motions made at once would change for each other.
        """
        inputs, problem = self._model.inputs, ""
        if not inputs.speech:
            problem = "this model has no speech input; serve one that has"
        elif inputs.words or inputs.files:
            how = "use gesturekit render, or compute the features by an installed extractor"
            problem = f"this model reads a file beside each sound (own features, or words): {how}"
        if problem:
            raise GestureKitError(problem)
        self._model.generate(af.Wave.load(bundled_speech(), duration=1.0))
        threadpool_limits(1, user_api="blas")  # now that all libraries are loaded

    async def counted_answer(self, request: Request, asked: MotionRequest) -> Response:
        """Answer a request for motion, and count it.

        Raises:
            HTTPException: it cannot be done.
        """
        begun, status = time.perf_counter(), 500
        try:
            check_origin(request)
            check_token(request, self._token)
            content, seconds = await self._answer(request, asked)
            self._sound.inc(seconds)
            status = 200
        except AnyHTTPException as error:
            status = error.status_code
            raise
        finally:
            self._requests.labels(str(status)).inc()
            self._seconds.observe(time.perf_counter() - begun)
        way = "inline" if asked.format == "html" else "attachment"
        headers = {
            "Content-Disposition": f'{way}; filename="motion.{asked.format}"',
            "X-Content-Type-Options": "nosniff",
            # A player that is opened directly runs without the rights of this site.
            "Content-Security-Policy": "sandbox allow-scripts",
        }
        return Response(content, media_type=_TYPES[asked.format], headers=headers)

    async def _answer(self, request: Request, asked: MotionRequest) -> tuple[bytes, float]:
        """Return a motion's file and the seconds of its sound.

        Everything that a request writes lies in a folder of its own, under fixed names.
        """
        if self._admitted >= self.limits.workers + self.limits.queue:
            raise HTTPException(503, "all workers are busy", {"Retry-After": "10"})
        self._admitted += 1
        try:
            with tempfile.TemporaryDirectory(prefix="gesturekit-serve-") as folder:
                sound = Path(folder) / "speech"
                await receive(request, sound, self.limits)
                loop = asyncio.get_running_loop()
                try:
                    return await loop.run_in_executor(self._threads, self._render, sound, asked)
                except (GestureKitError, af.AudioFeaturesError) as error:
                    ours = "`ffmpeg -i YOUR_FILE speech.wav`"
                    reason = re.sub("`ffmpeg [^`]*`", ours, str(error))
                    reason = reason.replace(str(sound), "the sound")
                    raise HTTPException(422, reason.replace(folder, "")) from None
        except (OSError, MemoryError, RuntimeError) as error:
            if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise HTTPException(503, "the disk of the service is full") from None
            log.exception("a request failed")
            raise HTTPException(500, "the motion could not be made; see the log") from None
        finally:
            self._admitted -= 1

    def _render(self, sound: Path, asked: MotionRequest) -> tuple[bytes, float]:
        """Generate the motion of a sound file in its folder, and return it and its seconds."""
        wave = af.Wave.load(sound, max_seconds=self.limits.seconds)
        # Those that were given: a default would count as given with `raw`.
        controls = asked.model_dump(exclude={"format"}, exclude_unset=True)
        rate = controls.get("fps") or self._model.recorded_fps
        if (n_frames := wave.n_frames(rate)) > self.limits.frames:
            longest = f"at most {self.limits.frames:g}: give a lower fps, or less sound"
            long = f"{wave.duration:g} s at {rate:g} frames per second are {n_frames} frames"
            raise GestureKitError(f"{long}; this service makes {longest}")
        motion = self._model.generate(wave, **controls)
        out = sound.with_name(f"motion.{asked.format}")
        extra = {"audio": sound, "title": "motion"} | drawing_options(self._model)
        motion.save(out, **(extra if asked.format == "html" else {}))
        return out.read_bytes(), wave.duration


async def _as_json(request: Request, error: Exception) -> JSONResponse:
    if isinstance(error, RequestValidationError):
        said = (f"{wrong['loc'][-1]}: {wrong['msg']}" for wrong in error.errors()[:5])
        return JSONResponse({"error": printable("; ".join(said)[:1000])}, 422)
    assert isinstance(error, AnyHTTPException)
    return JSONResponse({"error": printable(str(error.detail))}, error.status_code, error.headers)


def _api_page(schema: dict[str, Any], limits: Limits) -> str:
    """Return a page of the requests in an OpenAPI schema, and of the limits."""
    parts = []
    for path, operations in schema["paths"].items():
        for method, about in operations.items():
            parts.append(f"<h2>{method.upper()} {path}</h2><p>{escape(about['description'])}</p>")
            settings = about.get("parameters", ())
            parts.append(_table({each["name"]: _setting(each) for each in settings}))
            answers = about["responses"].items()
            parts.append(_table({status: said["description"] for status, said in answers}))
    return (
        "<!doctype html><meta charset=utf-8><title>API</title>"
        "<style>body{font:16px/1.5 system-ui,sans-serif;max-width:50em;margin:2em auto}"
        f"th{{text-align:left}}</style><h1>gesturekit</h1>{''.join(parts)}"
        f"<h2>Limits</h2>{_table(vars(limits))}"
        '<p>Machine-readable: <a href="openapi.json">openapi.json</a></p>'
        "<pre>curl --data-binary @speech.wav 'http://127.0.0.1:8000/motion' > a.bvh</pre>"
    )


def _setting(parameter: Mapping[str, Any]) -> str:
    """Return the description of a setting, with its choices and default."""
    schema = parameter["schema"]
    choices = f"; one of {', '.join(schema['enum'])}" if "enum" in schema else ""
    default = f"; default {schema['default']}" if "default" in schema else ""
    return f"{parameter.get('description', '')}{choices}{default}"


def _table(rows: Mapping[str, object]) -> str:
    shown = (f"<tr><th>{escape(k)}<td>{escape(str(text))}" for k, text in rows.items())
    return f"<table>{''.join(shown)}</table>"
