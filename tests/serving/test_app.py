"""The service: right answers, limits that hold, and nothing that a request can reach."""

from __future__ import annotations

import asyncio
import errno
import re
import socket
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import uvicorn
from fastapi import HTTPException
from fastapi.responses import FileResponse, HTMLResponse
from sounds import wav
from starlette.requests import Request
from starlette.testclient import TestClient
from threadpoolctl import threadpool_info, threadpool_limits

import gesturekit as gk
from gesturekit.errors import ConfigError, GestureKitError
from gesturekit.model import Inputs
from gesturekit.motion import Motion
from gesturekit.serving.address import address_of, listening_socket
from gesturekit.serving.app import create_app
from gesturekit.serving.pages import DROP_PAGE, PAGE_HEADERS
from gesturekit.serving.requests import Limits, Rate, receive
from gesturekit.serving.worker import BusyError, Worker
from gesturekit.systems import bundled_speech
from gesturekit.viewer.human.body import is_baked

HOST = "http://127.0.0.1"


@pytest.fixture(scope="module")
def model():
    return gk.load("demo")


@pytest.fixture
def client(model):
    clients = []

    def make(token=None, headers=None, **limits) -> TestClient:
        app = create_app(model, Limits(**limits), token=token)
        clients.append(TestClient(app, base_url=HOST, headers=headers).__enter__())
        return clients[-1]

    yield make
    for one in clients:
        one.__exit__(None, None, None)


def folder_of(client: TestClient):
    return client.app.state.folder


def test_a_wav_gives_the_motion_that_the_model_makes(client, model, tmp_path):
    sound = tmp_path / "a.wav"
    sound.write_bytes(wav(1.5, 44_100, 2))
    model.generate(sound, seed=3).save(tmp_path / "expected.bvh")
    one = client()
    answer = one.post("/motion?format=bvh&seed=3", content=sound.read_bytes())
    assert answer.status_code == 200, answer.text
    assert answer.content == (tmp_path / "expected.bvh").read_bytes()
    model.generate(sound, seed=3, item="day/a").save(tmp_path / "named.bvh")
    named = one.post("/motion?format=bvh&seed=3&item=day/a", content=sound.read_bytes())
    assert named.content == (tmp_path / "named.bvh").read_bytes() != answer.content
    model.generate(sound, seed=3, raw=True).save(tmp_path / "raw.bvh")
    raw = one.post("/motion?format=bvh&seed=3&raw=true", content=sound.read_bytes())
    assert raw.content == (tmp_path / "raw.bvh").read_bytes() != answer.content
    assert answer.headers["content-disposition"] == 'attachment; filename="motion.bvh"'
    assert answer.headers["content-type"].startswith("text/plain")
    assert answer.headers["x-content-type-options"] == "nosniff"
    (tmp_path / "a.npz").write_bytes(one.post("/motion?format=npz", content=wav()).content)
    assert Motion.load(tmp_path / "a.npz").n_frames == 30
    page = one.post("/motion?format=html", content=wav())
    assert "<title>motion</title>" in page.text and re.search(r'"audio": ?\{', page.text)
    assert ('"skin":' in page.text) == is_baked(), "the demo's motion is drawn with the human body"
    assert page.headers["content-disposition"] == 'inline; filename="motion.html"'
    assert page.headers["content-type"].startswith("text/html")
    assert page.headers["content-security-policy"] == "sandbox allow-scripts"
    assert list(folder_of(one).iterdir()) == []


@pytest.mark.parametrize(
    ("query", "body", "status", "says"),
    [
        ("", b"", 400, "--data-binary"),
        ("", b"RIFF", 422, "the sound: "),
        ("", b"\0\0\0\x20ftypM4A " + bytes(99), 422, "run `ffmpeg -i YOUR_FILE speech.wav`"),
        ("", b"<script>alert(1)</script>" * 99, 422, "cannot be read as sound"),
        ("", wav(11.0), 422, "10"),
        ("", b"\0" * (1 << 20), 413, "larger than 0.5 MB"),
        ("?format=exe", wav(), 422, "format"),
        ("?seed=-1", wav(), 422, "seed"),
        (f"?seed={2**63}", wav(), 422, "seed"),
        ("?a=1&b=2&c=3&d=4&e=5&f=6", wav(), 422, "e: "),
        ("?seed=" + "9" * 5000, wav(), 422, "seed"),
        ("?item=" + "a" * 2000, wav(), 422, "item"),
        ("?style=old", wav(), 422, "style"),
        ("?speaker=/etc/passwd", wav(), 422, "speaker"),
        ("?path=/etc/passwd", wav(), 422, "path"),
        ("?fps=1e9", wav(), 422, "less than or equal to 1000"),
        ("?fps=801&format=html", wav(5.0), 422, "4005 frames; this service makes at most 4000"),
        ("?fps=0", wav(), 422, "greater than 0"),
        ("?facing=-361", wav(), 422, "greater than or equal to -360"),
        ("?smooth=nan", wav(), 422, "smooth"),
        ("?style=" + "a" * 201, wav(), 422, "at most 200 characters"),
        ("?keep=/etc/passwd", wav(), 422, "keep"),
    ],
)
def test_invalid_requests_are_refused_with_a_reason(client, query, body, status, says):
    one = client(megabytes=0.5, seconds=10, frames=4000)
    answer = one.post(f"/motion{query}", content=body)
    assert (answer.status_code, says in answer.json()["error"]) == (status, True), answer.text
    assert str(folder_of(one)) not in answer.text
    assert list(folder_of(one).iterdir()) == []


def test_every_error_is_json_with_its_reason(client):
    one = client()
    form = one.post("/motion", files={"file": wav()})
    assert form.status_code == 422 and "not a form" in form.json()["error"]
    for answer, status in ((one.get("/nothing"), 404), (one.get("/motion"), 405)):
        assert answer.status_code == status and answer.json()["error"]


def test_a_body_without_length_is_cut_off_at_the_limit(client):
    def blocks():
        for _ in range(100):
            yield b"\0" * 65_536

    one = client(megabytes=0.5)
    assert one.post("/motion", content=blocks()).status_code == 413
    # The limit itself is allowed, with and without a length.
    most, half = bytes(1 << 19), bytes(1 << 18)
    for whole, split in ((most, (half, half)), (most + b"\0", (half, half, b"\0"))):
        answers = [one.post("/motion", content=c).status_code for c in (whole, iter(split))]
        assert answers == ([422, 422] if whole is most else [413, 413])


@pytest.mark.parametrize(
    ("messages", "status"),
    [
        ([{"type": "http.request", "body": b"a", "more_body": True}], 408),
        (
            [
                {"type": "http.request", "body": b"a", "more_body": True},
                {"type": "http.disconnect"},
            ],
            400,
        ),
    ],
)
def test_a_body_that_stops_is_given_up(tmp_path, messages, status):
    left = list(messages)

    async def next_message():
        if not left:
            await asyncio.sleep(60)
        return left.pop(0)

    request = Request({"type": "http", "headers": []}, next_message)
    with pytest.raises(HTTPException) as refused:
        asyncio.run(receive(request, tmp_path / "a", Limits(body_seconds=0.05)))
    assert refused.value.status_code == status


@pytest.mark.parametrize("length", ["-5", "1e3", "\xb2", "9" * 30, "1048577"])
def test_a_body_that_says_to_be_too_large_is_not_read(tmp_path, length):
    async def next_message():
        raise AssertionError("the body is read")

    headers = [(b"content-length", length.encode("latin-1"))]
    request = Request({"type": "http", "headers": headers}, next_message)
    with pytest.raises(HTTPException) as refused:
        asyncio.run(receive(request, tmp_path / "a", Limits(megabytes=1)))
    assert refused.value.status_code == 413 and not list(tmp_path.iterdir())


def test_requests_of_other_sites_and_names_are_refused(client):
    one = client()
    for origin in ("https://evil.example", "null", "http://127.0.0.1:1", "http://[::1"):
        answer = one.post("/motion", content=wav(), headers={"Origin": origin})
        assert answer.status_code == 403
    assert one.post("/motion", content=wav(), headers={"Origin": HOST}).status_code == 200
    assert one.get("/health", headers={"Host": "evil.example"}).status_code == 400


def test_the_token_is_required_where_there_is_one(client):
    one = client(token="0123456789abcdef")
    for header in ({}, {"Authorization": "Bearer 0123456789abcdee"}, {"Authorization": "é"}):
        headers = {name: value.encode() for name, value in header.items()}
        assert one.post("/motion", content=wav(), headers=headers).status_code == 401
        assert one.get("/metrics", headers=headers).status_code == 401
    right = {"Authorization": "Bearer 0123456789abcdef"}
    assert one.post("/motion", content=wav(), headers=right).status_code == 200
    assert one.get("/health").status_code == 200


def test_the_rate_is_limited_and_recovers(client):
    one = client(per_minute=2)
    answers = [one.post("/motion", content=b"x") for _ in range(4)]
    assert [answer.status_code for answer in answers] == [422, 422, 429, 429]
    # A token in 30 s, of which the requests took less than 9.
    after = int(answers[-1].headers["retry-after"])
    assert 21 <= int(re.search(r"in (\d+) s", answers[-1].json()["error"])[1]) <= after <= 30
    other = TestClient(one.app, base_url=HOST, client=("10.0.0.9", 1))
    assert other.post("/motion", content=b"x").status_code == 422
    now = [0.0]
    rate = Rate(60, lambda: now[0])
    assert [rate.wait("a") for _ in range(60)] == [0.0] * 60
    assert rate.wait("a") == pytest.approx(1.0) and rate.wait("b") == 0.0
    now[0] = 1.01
    assert rate.wait("a") == 0.0
    now[0] = 1000.0  # no more than a minute's requests are saved
    assert [rate.wait("a") for _ in range(61)] == [0.0] * 60 + [pytest.approx(1.0)]
    seldom = Rate(0.5, lambda: now[0])
    assert [seldom.wait("a"), seldom.wait("a")] == [0.0, pytest.approx(120.0)]
    now[0] = 1030.0
    assert seldom.wait("a") == pytest.approx(90.0)


def test_more_clients_than_are_remembered_leave_the_newest_one_limited(monkeypatch):
    monkeypatch.setattr("gesturekit.serving.requests._MOST_CLIENTS", 3)
    rate = Rate(1, clock=lambda: 0.0)
    assert [rate.wait(name) for name in "abcad"] == [0, 0, 0, 60, 0]
    # b was seen longest ago, and has a full bucket again; all others still wait.
    assert [rate.wait(name) for name in "acdb"] == [60, 60, 60, 0]


def test_figures_for_prometheus(client):
    one = client()
    begun = time.perf_counter()
    one.post("/motion", content=wav(2.0))
    one.post("/motion", content=b"x")
    passed = time.perf_counter() - begun
    page = one.get("/metrics").text
    assert 'gesturekit_requests_total{status="200"} 1.0' in page
    assert 'gesturekit_requests_total{status="422"} 1.0' in page
    assert "gesturekit_sound_seconds_total 2.0" in page and "gesturekit_queue 0.0" in page
    assert "gesturekit_request_seconds_count 2.0" in page
    bounds = [float(b) for b in re.findall(r'seconds_bucket\{le="([\d.]+)"\}', page)]
    guide = (Path(__file__).parents[2] / "docs" / "serve.md").read_text(encoding="utf-8")
    said = re.search(r"times \(within (.*) s\)", guide)[1]
    assert bounds == [float(number) for number in re.findall(r"[\d.]+", said)]
    assert 0 < float(re.search(r"gesturekit_request_seconds_sum (\S+)", page)[1]) < passed


@pytest.mark.parametrize(
    ("error", "status", "says"),
    [
        (OSError(errno.ENOSPC, "full"), 503, "disk of the service is full"),
        (OSError(errno.EIO, "broken"), 500, "see the log"),
        (MemoryError(), 500, "see the log"),
    ],
)
def test_failures_of_the_machine_are_named_and_logged(
    client, model, monkeypatch, caplog, error, status, says
):
    one = client()

    def generate(*_, **__):
        raise error

    monkeypatch.setattr(model, "generate", generate)
    answer = one.post("/motion", content=wav())
    assert (answer.status_code, says in answer.json()["error"]) == (status, True)
    assert ("a request failed" in caplog.text) == (status == 500)
    assert f'requests_total{{status="{status}"}} 1.0' in one.get("/metrics").text


def test_an_unforeseen_failure_is_counted_as_500(client, model, monkeypatch):
    one = client()
    monkeypatch.setattr(model, "generate", lambda *_, **__: {}["no such key"])
    with pytest.raises(KeyError):
        one.post("/motion", content=wav())
    assert 'requests_total{status="500"} 1.0' in one.get("/metrics").text


def test_motion_is_computed_by_one_thread_for_each_worker(client, model, monkeypatch):
    """The last bits of matrix products depend on their number, and so would the motion."""
    used, before = [], torch.get_num_threads()
    generate = model.generate

    def counted(*arguments, **controls):
        blas = [lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"]
        used.append((torch.get_num_threads(), blas))
        (folder,) = folder_of(one).iterdir()
        assert [path.name for path in folder.iterdir()] == ["speech"]
        return generate(*arguments, **controls)

    torch.set_num_threads(2)
    try:
        with threadpool_limits(2, user_api="blas"):
            one = client()
            monkeypatch.setattr(model, "generate", counted)
            assert one.post("/motion", content=wav()).status_code == 200
    finally:
        torch.set_num_threads(before)
    ((threads, blas),) = used
    assert threads == 1 and blas and set(blas) == {1}


def test_of_many_wrong_settings_five_are_named(client):
    query = "&".join(f"wrong{n}={'x' * 9}" for n in range(6))
    answer = client().post(f"/motion?{query}", content=wav())
    said = answer.json()["error"]
    assert answer.status_code == 422 and said.count("wrong") == said.count("; ") + 1 == 5
    answer = client().post(f"/motion?{'y' * 2000}=1", content=wav())
    assert len(answer.json()["error"]) == 1000
    too_long = client().post(f"/motion?style={'z' * 201}", content=wav()).json()["error"]
    assert "at most 200 characters" in too_long
    unknown = client().post(f"/motion?style={'z' * 200}", content=wav()).json()["error"]
    assert "characters" not in unknown


def test_health_names_the_model(client, model):
    version = gk.__version__
    state = {"status": "ok", "version": version, "kind": "multires", "fps": 30.0, "styles": []}
    assert client().get("/health").json() == state | {"styles": list(model.styles)}


def test_the_pages_load_nothing_from_elsewhere(client):
    one = client()
    for address in ("/", "/docs"):
        page = one.get(address)
        assert page.status_code == 200
        assert re.findall(r"""(?:src|href)=["']?(?:https?:)?//[^"'> ]*""", page.text) == []
        assert "default-src 'none'" in page.headers["content-security-policy"]
    page = one.get("/docs").text
    assert "POST /motion" in page and one.get("/redoc").status_code == 404
    # Choices, types and defaults of the settings, the answers and the limits.
    for text in (
        "<th>format</th><td>html is a player with the sound (bvh, npz, html; default bvh)</td>",
        "(integer; default 0)",
        "(number, null)",
        "(boolean; default True)",
        "<th>403</th><td>sent by a page of another site</td>",
        "<th>megabytes</th><td>64</td>",
        '<a href="openapi.json">',
    ):
        assert text in page
    schema = one.get("/openapi.json").json()
    about = {"title": "gesturekit", "summary": "Speech to body motion", "version": gk.__version__}
    assert schema["info"] == about
    assert set(schema["paths"]) == {"/motion", "/health", "/metrics"}
    body = schema["paths"]["/motion"]["post"]["requestBody"]
    assert body["required"] and "audio/wav" in body["content"]
    names = {parameter["name"] for parameter in schema["paths"]["/motion"]["post"]["parameters"]}
    controls = {"style", "speaker", "facing", "in_place", "raw", "foot_lock", "smooth", "vad"}
    assert names == {"format", "seed", "item", "fps"} | controls
    table = (Path(__file__).parents[2] / "docs" / "serve.md").read_text(encoding="utf-8")
    assert all(f"`{name}" in table for name in names)


def test_limits_are_positive():
    with pytest.raises(ConfigError, match="megabytes is 0"):
        Limits(megabytes=0)
    with pytest.raises(ConfigError, match="seconds is nan"):
        Limits(seconds=float("nan"))
    with pytest.raises(ConfigError, match="per_minute is inf"):
        Limits(per_minute=float("inf"))
    with pytest.raises(ConfigError, match="queue is -1"):
        Limits(queue=-1)
    with pytest.raises(ConfigError, match=r"seconds is 0.0009"):
        Limits(seconds=0.0009)
    assert Limits(seconds=0.001, queue=0).queue == 0


def test_the_limits_are_those_of_the_documentation():
    guide = (Path(__file__).parents[2] / "docs" / "serve.md").read_text(encoding="utf-8")
    table = [
        float(number) for number in re.findall(r"^\| [a-z ]+, (\d+)[ a-zA-Z]* \|", guide, re.M)
    ]
    limits = Limits()
    assert table == [
        *(limits.megabytes, limits.seconds, limits.frames, limits.body_seconds),
        *(limits.header_seconds, limits.connections),
        *(limits.per_minute, limits.queue, limits.workers),
    ]
    assert Limits(megabytes=0.5).n_bytes == 524_288


def test_as_many_requests_are_admitted_as_are_in_work_or_wait(model):
    worker = Worker(model, Limits(workers=2, queue=1))
    with ExitStack() as admitted:
        for number in (1, 2, 3):
            admitted.enter_context(worker.admit())
            assert worker.admitted == number
        with pytest.raises(BusyError), worker.admit():
            pass
    assert worker.admitted == 0


@pytest.mark.parametrize(
    ("inputs", "says"),
    [
        (Inputs(speech=False), "no speech input"),
        (Inputs(speech=True, words=True), "a file beside each sound"),
        (Inputs(speech=True, files=("mine",)), "a file beside each sound"),
    ],
)
def test_a_model_that_a_sound_is_not_enough_for_is_not_served(inputs, says):
    with pytest.raises(GestureKitError, match=says):
        create_app(SimpleNamespace(inputs=inputs))


def test_a_service_on_ipv6_has_its_address_in_brackets():
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no IPv6 on this machine")
    with listening_socket("::1", 0) as listening:
        port = listening.getsockname()[1]
        assert address_of(listening, "::1") == f"http://[::1]:{port}/"


def test_a_queue_that_is_full_says_so_at_once(client, model, monkeypatch):
    one, held = client(queue=0), threading.Event()
    generate = model.generate
    monkeypatch.setattr(model, "generate", lambda *a, **k: (held.wait(10), generate(*a, **k))[1])
    answers = []
    first = threading.Thread(target=lambda: answers.append(one.post("/motion", content=wav())))
    first.start()
    while "gesturekit_queue 1.0" not in one.get("/metrics").text:
        time.sleep(0.01)
    begun = time.monotonic()
    busy = one.post("/motion", content=wav())
    assert busy.status_code == 503 and "Retry-After" in busy.headers
    assert time.monotonic() - begun < 5
    held.set()
    first.join()
    assert answers[0].status_code == 200


DROP = """<script>
fetch("speech.wav").then((answer) => answer.blob()).then((sound) => {
  const data = new DataTransfer();
  data.items.add(new File([sound], "my <b>speech</b>.wav"));
  document.dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));
});
</script></html>"""


@pytest.mark.stress
def test_a_sound_is_dropped_on_the_page(model, open_browser):
    app = create_app(model)
    dropped = DROP_PAGE.replace("</html>", DROP)
    app.get("/dropped")(lambda: HTMLResponse(dropped, headers=PAGE_HEADERS))
    app.get("/speech.wav")(lambda: FileResponse(bundled_speech()))
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="warning"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.05)
    port = server.servers[0].sockets[0].getsockname()[1]
    browser = open_browser()
    browser.open(f"http://127.0.0.1:{port}/dropped")
    browser.wait("document.querySelector('iframe')")
    frame = browser.run("document.querySelector('iframe').outerHTML")
    server.should_exit = True
    assert '<iframe sandbox="allow-scripts" src="blob:http://127.0.0.1' in frame
    assert browser.run("document.getElementById('state').textContent") == ""
    assert not any("Refused to" in line for line in browser.lines)
    thread.join(20)
