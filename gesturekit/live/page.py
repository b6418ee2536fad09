"""Page that shows a stream while it goes on: today's player, fed over a WebSocket."""

from __future__ import annotations

import asyncio
import hmac
import json
import socket
import struct
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import HTTPConnection
from starlette.responses import HTMLResponse
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from gesturekit.live.sinks import Step
from gesturekit.motion import Motion
from gesturekit.motion.rotations import invert_quaternions, rotate_vectors
from gesturekit.serving.access import is_foreign
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.html import player_data, player_shell
from gesturekit.viewer.pages import insert, script_json

_MOST_CLIENTS = 32
_MESSAGES = 64
"""Frames that may wait for a slow client, a second or two; of more, the oldest is dropped."""
_END_SECONDS = 2
_COOKIE = "gesturekit_token"
_HEADERS = {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}
_ASK = "<!doctype html><title>Live</title><form>Token <input name=token type=password></form>"


class Page:
    """Sink that serves a page, at /, and its frames, at /stream.

    A frame is a binary message, little endian: two float64, the seconds of the sound to which it
    belongs and the seconds from its capture until now (NaN if unknown); then float32: the root's
    position in metres, the local quaternions xyzw of all joints, and the values of the face
    channels that move the body, if the example has a face.

    Args:
        listening: socket that listens.
        hosts: names under which the page is reached; ("*",) for any.
        example: motion on the stream's rig, from which its standing pose is measured.
        body: body to draw; see `DrawnBody`.
        framing: first view, "whole", "waist" or "face".
        sound: file that the page plays with its frames; None for the sound of a microphone.
        token: what a client must send, as `?token=`, as `Authorization: Bearer`, or in the cookie
            that it gets with the page; None for no token.

    Raises:
        GestureKitError: the player was not bundled, or the body cannot be read.
    """

    def __init__(
        self,
        listening: socket.socket,
        hosts: tuple[str, ...],
        example: Motion,
        *,
        body: str = "human",
        framing: str = "whole",
        sound: Path | None = None,
        token: str | None = None,
    ) -> None:
        self._token = token
        drawn = DrawnBody.of(example, body)
        self._fitting = drawn.fitting
        self._channels = drawn.face.names if drawn.face else ()
        page = json.loads(player_data(example, sound, body=body, framing=framing))
        page["live"] = _joints(drawn)
        places = {"title": "Live", "motion": script_json(page)}
        self._html = insert(player_shell(), places)
        self._clients: set[asyncio.Queue[bytes]] = set()
        app = Starlette(
            routes=[Route("/", self._page), WebSocketRoute("/stream", self._stream)],
            middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=list(hosts))],
        )
        quiet: dict[str, Any] = {"log_level": "critical", "ws_per_message_deflate": False}
        config = uvicorn.Config(app, timeout_graceful_shutdown=_END_SECONDS, **quiet)
        self._server = uvicorn.Server(config)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._serve, args=(listening,), daemon=True)
        self._thread.start()

    @property
    def is_open(self) -> bool:
        """True if a client is connected."""
        return bool(self._clients)

    def put(self, step: Step) -> None:
        """Send the frames of a step to all clients; none of them is waited for."""
        if step.motion is None or not self._clients:
            return
        motion = step.motion if self._fitting is None else self._fitting.on_body(step.motion)
        columns = [motion.translation, motion.rotations.reshape(motion.n_frames, -1)]
        if (face := step.motion.face) is not None:
            columns += [face.channel(name)[:, None] for name in self._channels]
        rows = np.concatenate(columns, axis=1).astype("<f4")
        lag = float("nan") if step.lag is None else step.lag
        for k, row in enumerate(rows):
            since = k / motion.fps
            message = struct.pack("<dd", step.time + since, lag - since) + row.tobytes()
            self._loop.call_soon_threadsafe(self._spread, message)

    def close(self) -> None:
        """End the service, after the frames that wait."""
        self._loop.call_soon_threadsafe(self._spread, b"")
        self._server.should_exit = True
        self._thread.join(2 * _END_SECONDS)

    def _serve(self, listening: socket.socket) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._server.serve(sockets=[listening]))

    def _spread(self, message: bytes) -> None:
        for waiting in self._clients:
            if waiting.full():
                waiting.get_nowait()
            waiting.put_nowait(message)

    async def _page(self, request: HTTPConnection) -> HTMLResponse:
        if not self._is_known(request):
            return HTMLResponse(_ASK, 401, _HEADERS)
        page = HTMLResponse(self._html, headers=_HEADERS)
        if self._token is not None:  # its WebSocket sends the cookie
            page.set_cookie(_COOKIE, self._token, httponly=True, samesite="strict")
        return page

    def _is_known(self, client: HTTPConnection) -> bool:
        """Return whether a client has the token, if there is one."""
        bearer = client.headers.get("authorization", "").removeprefix("Bearer ")
        given = (client.query_params.get("token", ""), client.cookies.get(_COOKIE, ""), bearer)
        token = self._token
        return token is None or any(
            hmac.compare_digest(each.encode(), token.encode()) for each in given
        )

    async def _stream(self, client: WebSocket) -> None:
        known = self._is_known(client) and not is_foreign(client)
        if not known or len(self._clients) >= _MOST_CLIENTS:
            return await client.close()
        await client.accept()
        waiting: asyncio.Queue[bytes] = asyncio.Queue(_MESSAGES)
        self._clients.add(waiting)
        with suppress(WebSocketDisconnect):
            try:
                while message := await waiting.get():
                    await client.send_bytes(message)
                await client.close()
            finally:
                self._clients.discard(waiting)


def _joints(drawn: DrawnBody) -> dict[str, Any]:
    """Return the rig of a body for player/live.js, with added points of its figure as joints."""
    figure, skeleton = drawn.figure, drawn.motion.skeleton
    parents, offsets = list(skeleton.parents), skeleton.offsets.tolist()
    owners = {limb.ends[1]: limb.ends[0] for limb in figure.limbs}
    if figure.head is not None:
        base, top, face = figure.head
        owners |= {top: base, face: base}
    places, turns = figure.points[0], drawn.motion.global_rotations()[0]
    for point in range(skeleton.n_joints, len(places)):
        owner = owners.get(point, 0)
        parents.append(owner)
        way = rotate_vectors(invert_quaternions(turns[owner]), places[point] - places[owner])
        offsets.append(way.tolist())
    return {"n_joints": skeleton.n_joints, "parents": parents, "offsets": offsets}
