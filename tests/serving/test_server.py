"""One real server under concurrent good, huge, slow and malicious requests."""

import http.client
import os
import random
import re
import socket
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
import uvicorn
from sounds import wav
from starlette.testclient import TestClient


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A server of the demo model and its port; the process is ended at the end."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    folder = tmp_path_factory.mktemp("serve")
    command = [sys.executable, "-m", "gesturekit", "serve", "--model", "demo"]
    command += ["--port", str(number), "--max-mb", "2", "--max-seconds", "30", "--queue", "60"]
    command += ["--workers", "2"]
    environment = {**os.environ, "TMPDIR": str(folder)}
    with (folder / "log.txt").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
    try:
        for _ in range(600):
            assert process.poll() is None, (folder / "log.txt").read_text()
            try:
                socket.create_connection(("127.0.0.1", number), 1).close()
                break
            except OSError:
                time.sleep(0.1)
        yield process, number
        assert process.poll() is None, "the server ended"
        assert [path.name for path in folder.iterdir()] == ["log.txt"], "a request left files"
        process.terminate()
        assert process.wait(20) == 0 or process.returncode == -15
        assert "Traceback" not in (folder / "log.txt").read_text()
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def port(server):
    """The port of the server."""
    return server[1]


def post(port: int, body: bytes, query: str = "", **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request("POST", f"/motion{query}", body, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def raw(port: int, *pieces: bytes, pause: float = 0.0) -> bytes:
    """Send bytes, and return what comes back until the server closes or a second is over."""
    with socket.create_connection(("127.0.0.1", port), 5) as connection:
        try:
            for piece in pieces:
                connection.sendall(piece)
                time.sleep(pause)
            connection.settimeout(2)
            return connection.recv(4096)
        except OSError:
            return b""


def good(port: int) -> str:
    return f"good {post(port, wav(0.5), '?format=bvh&seed=1')[0]}"


def huge(port: int) -> str:
    try:
        return f"huge {post(port, bytes(4 << 20))[0]}"
    except OSError:  # the server answers and closes before it has read everything
        return "huge 413"


def slow(port: int) -> str:
    raw(port, HEAD + b"Content-Length: 1000\r\n\r\n", *[b"x"] * 5, pause=0.2)
    return "slow"


HEAD = b"POST /motion HTTP/1.1\r\nHost: 127.0.0.1\r\n"
CHUNKED = b"Transfer-Encoding: chunked\r\n"
MALICIOUS = (
    random.Random(0).randbytes(300),
    HEAD + b"Content-Length: -5\r\n\r\n",
    HEAD + b"Content-Length: " + b"9" * 5000 + b"\r\n\r\n",
    HEAD + b"Content-Length: 4\r\n" + CHUNKED + b"\r\n0\r\n\r\nGET / HTTP/1.1\r\n\r\n",
    HEAD + CHUNKED + b"\r\nFFFFFFFFFFFFFFFF\r\n",
    HEAD + b"A: " + b"x" * 100_000 + b"\r\n\r\n",
    b"GET /../../../etc/passwd HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    b"GET /%2e%2e/%2e%2e/etc/passwd HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    b"POST /motion?format=../../x HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
)


def malicious(request: bytes, port: int) -> str:
    said = raw(port, request)
    assert not said or re.match(rb"HTTP/1\.1 4\d\d", said), said
    assert b"root:" not in said
    return "malicious"


def test_many_requests_at_once(port):
    """Every good request is answered, whatever the others do."""
    kinds = [good] * 3 + [huge] * 2 + [slow] * 3 + [partial(malicious, one) for one in MALICIOUS]
    random.Random(0).shuffle(kinds)
    with ThreadPoolExecutor(32) as threads:
        said = Counter(threads.map(lambda kind: kind(port), kinds))
    assert said == {"good 200": 3, "huge 413": 2, "slow": 3, "malicious": len(MALICIOUS)}


def test_answers_do_not_depend_on_other_requests(port):
    sounds = [wav(0.5), wav(1.0), wav(0.7, 22_050)]
    alone = [post(port, sound) for sound in sounds]
    assert [status for status, _ in alone] == [200, 200, 200]
    with ThreadPoolExecutor(6) as threads:
        together = list(threads.map(lambda sound: post(port, sound), sounds * 2))
    assert together == alone * 2


@pytest.fixture
def served(gesturekit, monkeypatch):
    """served(*arguments, **environment): a client of the application that the command serves."""
    clients, server = [], {}

    def run(self, sockets):
        server.update(vars(self.config), address=sockets[0].getsockname())
        clients.append(TestClient(self.config.app))
        sockets[0].close()

    def serve(*arguments: object, **environment: str):
        monkeypatch.setattr(uvicorn.Server, "run", run)
        monkeypatch.delenv("GESTUREKIT_TOKEN", raising=False)
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        done = gesturekit("serve", "--model", "demo", "--port", 0, *arguments).ok()
        assert f":{server['address'][1]}/" in done.err
        return clients[-1]

    serve.server = server
    return serve


TOKEN = "0123456789abcdef"


def test_a_public_address_answers_nobody_without_its_token(served, gesturekit, tmp_path):
    """Refused at the start without a token; with one, a request that lacks it is refused."""
    public = ("--host", "0.0.0.0")
    gesturekit("serve", "--model", "demo", *public).fails(2, "--token-file", "0.0.0.0")
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    client = served(*public, "--token-file", tmp_path / "token")
    assert served.server["address"][0] == "0.0.0.0"
    for given in (None, f"Bearer {TOKEN[:-1]}e", "Basic x"):
        headers = {"Host": "any.name"} | ({"Authorization": given} if given else {})
        assert client.post("/motion", content=wav(0.5), headers=headers).status_code == 401
    headers["Authorization"] = f"Bearer {TOKEN}"
    assert client.get("/metrics", headers=headers).status_code == 200


@pytest.mark.parametrize(
    ("token", "is_used"),
    [(TOKEN, True), (TOKEN[1:], False), (TOKEN + " a", False), (TOKEN + "é", False), ("", False)],
)
def test_a_token_is_long_plain_and_without_spaces(served, gesturekit, tmp_path, token, is_used):
    (tmp_path / "token").write_text(f"{token}\n", encoding="utf-8")
    if not is_used:
        wrong = gesturekit("serve", "--model", "demo", "--token-file", tmp_path / "token")
        wrong.fails(2, "16", "ASCII")
        return
    # A file counts more than the environment.
    client = served("--token-file", tmp_path / "token", GESTUREKIT_TOKEN="f" * 16)
    for given, status in (("f" * 16, 401), (token, 200)):
        headers = {"Host": "localhost", "Authorization": f"Bearer {given}"}
        assert client.get("/metrics", headers=headers).status_code == status


def test_a_service_answers_to_the_names_that_it_is_given(served):
    client = served("--name", "one.example", "--name", "two.example")
    for name, status in (("one.example", 200), ("two.example", 200), ("o", 400), ("evil", 400)):
        assert client.get("/health", headers={"Host": name}).status_code == status
    assert served.server["address"][0] == "127.0.0.1"


def test_a_device_that_is_not_there_is_one_line_and_exit_2(gesturekit):
    gesturekit("serve", "--model", "demo", "--port", 0, "--device", "cuda:7").fails(2, "'cuda:7'")


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("--port", "65536", "65535"),
        ("--port", "-1", "65535"),
        ("--token-file", "none", "'none' does not exist"),
        ("--token-file", ".", "'.' is a directory"),
    ],
)
def test_an_address_or_token_that_cannot_be_is_refused(gesturekit, option, value, says):
    gesturekit("serve", "--model", "demo", option, value).fails(2, option, says)


def test_a_port_in_use_is_one_line_and_exit_2(gesturekit):
    with socket.create_server(("127.0.0.1", 0)) as used:
        number = used.getsockname()[1]
        done = gesturekit("serve", "--model", "demo", "--port", number)
    done.fails(2, str(number), "--port")


@pytest.mark.stress
def test_ten_thousand_requests_leave_no_open_file_and_no_memory(server):
    process, port = server
    sounds = [wav(seconds=0.3), wav(seconds=0.3)[:1000], b"", b"RIFF" + bytes(3000)]
    rng = random.Random(0)
    bodies = [rng.choice(sounds[rng.random() < 0.9 :]) for _ in range(10_000)]
    with ThreadPoolExecutor(4) as pool:

        def answered(part: list[bytes]) -> Counter[int]:
            return Counter(status for status, _ in pool.map(lambda body: post(port, body), part))

        counts = answered(bodies[:1000])
        before = used(process.pid)
        counts += answered(bodies[1000:])
        after = used(process.pid)
    assert counts.keys() <= {200, 400, 422} and counts[200] == bodies.count(sounds[0])
    assert after["files"] <= before["files"] + 4
    assert after["memory"] < before["memory"] + (60 << 20)


def used(pid: int) -> dict[str, int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    found = Counter(files=len([*Path(f"/proc/{pid}/fd").iterdir()]))
    status = Path(f"/proc/{pid}/status").read_text()
    found["memory"] = 1024 * int(re.search(r"VmRSS:\s+(\d+)", status)[1])
    for child in children:
        found += used(int(child))
    return found


def test_the_limits_are_those_of_the_command_line(served):
    options = ("--max-mb", 3, "--max-seconds", 7, "--max-frames", 50, "--queue", 2, "--workers", 4)
    bodies = (bytes((3 << 20) + 1), wav(7.5), wav(2.0))
    with served(*options) as client:
        client.headers["Host"] = "localhost"
        answers = [client.post("/motion", content=body) for body in bodies]
        words = re.sub("<[^>]*>", " ", client.get("/docs").text).split()
    assert [answer.status_code for answer in answers] == [413, 422, 422]
    assert all(limit in answer.text for limit, answer in zip(("3", "7", "50"), answers))
    shown = dict(zip(words, words[1:]))  # what follows a name
    for name, value in {"queue": 2, "workers": 4}.items():
        assert float(shown[name]) == value, name
