"""Clients that hold connections without using them, against a real server."""

import http.client
import socket
import threading
import time
from collections.abc import Iterator

import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.responses import Response
from starlette.routing import Route

from gesturekit.serving import Limits
from gesturekit.serving.connections import server_config

LARGE = 64 << 20
HEAD = b"POST / HTTP/1.1\r\nHost: a\r\n"
HELD = {
    "nothing": b"",
    "a part of a header": HEAD,
    "a part of a body": HEAD + b"Content-Length: 9\r\n\r\nx",
    "a part of a body that is not read": HEAD.replace(b"/ ", b"/none ")
    + b"Content-Length: 9\r\n\r\nx",
}


@pytest.fixture
def serve() -> Iterator:
    """serve(**limits): start a server; return it and its port."""
    servers = []

    async def answer(request) -> Response:
        body = bytes(LARGE) if request.method == "GET" else await request.body()
        return Response(body, headers={"client": request.client.host})

    def start(**limits: float) -> tuple[uvicorn.Server, int]:
        app = Starlette(routes=[Route("/", answer, methods=["GET", "POST"])])
        ways = {"log_level": "critical", "timeout_graceful_shutdown": 0, "lifespan": "off"}
        server = uvicorn.Server(server_config(app, Limits(**limits), **ways))
        listening = socket.create_server(("127.0.0.1", 0))
        thread = threading.Thread(target=server.run, args=([listening],), daemon=True)
        thread.start()
        servers.append((server, thread))
        return server, listening.getsockname()[1]

    yield start
    for server, thread in servers:
        server.should_exit = True
        thread.join(10)


def status(port: int, client: str) -> int:
    asked = http.client.HTTPConnection("127.0.0.1", port, timeout=60, source_address=(client, 0))
    try:
        asked.request("POST", "/", b"a")
        answer = asked.getresponse()
        answer.read()
    except ConnectionError:  # refused before the request was read
        return 429
    finally:
        asked.close()
    return answer.status


def test_the_address_of_a_client_is_that_of_its_connection_whatever_its_headers_say(serve):
    asked = http.client.HTTPConnection("127.0.0.1", serve()[1], timeout=60)
    asked.request("POST", "/", b"a", {"X-Forwarded-For": "10.0.0.9"})
    answer = asked.getresponse()
    assert answer.getheader("client") == "127.0.0.1" and not answer.getheader("server")
    asked.close()


@pytest.mark.parametrize("held", HELD.values(), ids=HELD)
def test_a_client_that_holds_connections_takes_none_from_others(serve, held):
    _, port = serve(connections=3, header_seconds=300)
    lines = [socket.create_connection(("127.0.0.1", port)) for _ in range(3)]
    for line in lines:
        line.sendall(held)
    assert status(port, "127.0.0.1") == 429
    assert status(port, "127.0.0.2") == 200
    lines.pop().close()
    deadline = time.monotonic() + 60
    while status(port, "127.0.0.1") == 429:
        assert time.monotonic() < deadline
    for line in lines:
        line.close()


@pytest.mark.parametrize("held", [v for k, v in HELD.items() if k != "a part of a body"])
def test_a_request_that_does_not_come_is_not_awaited_for_ever(serve, held):
    """Not even if a byte comes now and then."""
    server, port = serve(header_seconds=0.2)
    with socket.create_connection(("127.0.0.1", port)) as line:
        line.sendall(held)
        line.settimeout(0.05)
        deadline = time.monotonic() + 3  # uvicorn's own 5 s begin anew with each byte
        with pytest.raises((ConnectionError, BrokenPipeError)):
            while time.monotonic() < deadline:
                try:
                    if held:
                        line.sendall(b"x")
                    if not line.recv(1000):
                        raise ConnectionError
                except TimeoutError:
                    continue


def test_an_answer_that_is_not_taken_is_given_up(serve):
    server, port = serve(body_seconds=0.1)
    with socket.create_connection(("127.0.0.1", port)) as line:
        line.sendall(b"GET / HTTP/1.1\r\nHost: a\r\n\r\n")
        assert line.recv(1)
        deadline = time.monotonic() + 10
        while server.server_state.connections:
            assert time.monotonic() < deadline, "the connection is still open"
            time.sleep(0.01)
        taken = 0
        with pytest.raises(ConnectionError):
            while data := line.recv(1 << 20):
                taken += len(data)
            raise ConnectionError
    assert taken < LARGE
