"""The service: right answers, limits that hold, and nothing that a request can reach."""

import errno
import re
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import uvicorn
from fastapi.responses import FileResponse, HTMLResponse
from sounds import wav
from starlette.testclient import TestClient

import gesturekit as gk
from gesturekit.errors import ConfigError, GestureKitError
from gesturekit.model import Inputs
from gesturekit.motion import Motion
from gesturekit.serving import Limits, create_app
from gesturekit.serving.app import DROP_PAGE, PAGE_HEADERS
from gesturekit.systems import bundled_speech

HOST = "http://127.0.0.1"


@pytest.fixture(scope="module")
def model():
    return gk.load("demo")


@pytest.fixture
def client(model, tmp_path, monkeypatch):
    clients = []
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def make(token=None, **limits) -> TestClient:
        app = create_app(model, Limits(**limits), token=token)
        clients.append(TestClient(app, base_url=HOST).__enter__())
        return clients[-1]

    yield make
    for one in clients:
        one.__exit__(None, None, None)


def test_nothing_of_a_request_stays(client, tmp_path):
    one = client()
    for body in (wav(), b"RIFF"):
        one.post("/motion?format=html", content=body)
        assert list(tmp_path.iterdir()) == []


def test_a_wav_gives_the_motion_that_the_model_makes(client, model, tmp_path):
    sound, one = tmp_path / "a.wav", client()
    sound.write_bytes(wav(1.5, 44_100, 2))
    seen = set()
    for controls in ({"seed": 3}, {"seed": 3, "item": "day/a"}, {"seed": 3, "raw": True}):
        model.generate(sound, **controls).save(tmp_path / "expected.bvh")
        asked = {name: str(value) for name, value in controls.items()}
        answer = one.post("/motion", params={"format": "bvh"} | asked, content=sound.read_bytes())
        assert answer.status_code == 200, answer.text
        assert answer.content == (tmp_path / "expected.bvh").read_bytes()
        seen.add(answer.content)
    assert len(seen) == 3 and answer.headers["x-content-type-options"] == "nosniff"
    assert "motion.bvh" in answer.headers["content-disposition"]
    (tmp_path / "a.npz").write_bytes(one.post("/motion?format=npz", content=wav()).content)
    assert Motion.load(tmp_path / "a.npz").n_frames == 30
    page = one.post("/motion?format=html", content=wav())
    assert '"audio"' in page.text
    assert "sandbox allow-scripts" in page.headers["content-security-policy"]


@pytest.mark.parametrize(
    ("query", "body", "status", "says"),
    [
        ("", b"", 400, "--data-binary"),
        ("", b"RIFF", 422, "sound"),
        ("", b"\0\0\0\x20ftypM4A " + bytes(99), 422, "ffmpeg"),
        ("", wav(11.0), 422, "10"),
        ("", b"\0" * (1 << 20), 413, "0.5 MB"),
        ("?format=exe", wav(), 422, "format"),
        ("?seed=-1", wav(), 422, "seed"),
        (f"?seed={2**63}", wav(), 422, "seed"),
        ("?a=1&b=2&c=3&d=4&e=5&f=6", wav(), 422, "e: "),
        ("?item=" + "a" * 2000, wav(), 422, "item"),
        ("?style=old", wav(), 422, "style"),
        ("?face=phones&transcript=" + "a" * 4001, wav(), 422, "transcript: "),
        ("?transcript=" + "a " * 2000, wav(), 422, "face='phones'"),
        ("?path=/etc/passwd", wav(), 422, "path"),
        ("?fps=801&format=html", wav(5.0), 422, "4000"),
        ("?smooth=nan", wav(), 422, "smooth"),
        ("?keep=/etc/passwd", wav(), 422, "keep"),
    ],
)
def test_invalid_requests_are_refused_with_a_reason(client, tmp_path, query, body, status, says):
    one = client(megabytes=0.5, seconds=10, frames=4000)
    answer = one.post(f"/motion{query}", content=body)
    assert (answer.status_code, says in answer.json()["error"]) == (status, True), answer.text
    assert len(answer.json()["error"]) <= 1000
    assert str(tmp_path) not in answer.text and list(tmp_path.iterdir()) == []


def test_figures_for_prometheus(client):
    one = client()
    one.post("/motion", content=wav(2.0))
    one.post("/motion", content=b"x")
    page = one.get("/metrics").text
    assert 'gesturekit_requests_total{status="200"} 1.0' in page
    assert 'gesturekit_requests_total{status="422"} 1.0' in page
    assert "gesturekit_sound_seconds_total 2.0" in page and "gesturekit_queue 0.0" in page
    assert "gesturekit_request_seconds_count 2.0" in page
    assert 0 < float(re.search(r"gesturekit_request_seconds_sum (\S+)", page)[1]) < 60


@pytest.mark.parametrize(
    ("error", "status", "says"),
    [
        (OSError(errno.ENOSPC, "full"), 503, "disk"),
        (MemoryError(), 500, "log"),
    ],
)
def test_failures_of_the_machine_are_named_and_logged(
    client, model, monkeypatch, caplog, error, status, says
):
    def generate(*_, **__) -> None:
        raise error

    one = client()
    monkeypatch.setattr(type(model), "generate", generate)
    answer = one.post("/motion", content=wav())
    assert (answer.status_code, says in answer.json()["error"]) == (status, True)
    assert says != "log" or any(record.exc_info for record in caplog.records)
    assert f'requests_total{{status="{status}"}} 1.0' in one.get("/metrics").text


def test_the_pages_load_nothing_from_elsewhere_and_name_the_settings(client):
    one = client()
    for address in ("/", "/docs"):
        page = one.get(address)
        assert page.status_code == 200
        assert re.findall(r"""(?:src|href)=["']?(?:https?:)?//[^"'> ]*""", page.text) == []
        assert "default-src 'none'" in page.headers["content-security-policy"]
    schema = one.get("/openapi.json").json()
    names = {parameter["name"] for parameter in schema["paths"]["/motion"]["post"]["parameters"]}
    assert {"format", "seed", "item", "fps", "style", "raw", "foot_lock"} <= names
    guide = (Path(__file__).parents[2] / "docs" / "serve.md").read_text(encoding="utf-8")
    for name in names:
        assert re.search(rf"\b{name}\b", page.text) and f"`{name}" in guide


@pytest.mark.parametrize("wrong", [{"megabytes": 0}, {"seconds": float("nan")}, {"queue": -1}])
def test_limits_are_positive(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Limits(**wrong)


def test_every_error_is_json_with_its_reason(client):
    one = client()
    form = one.post("/motion", files={"file": wav()})
    assert form.status_code == 422 and "form" in form.json()["error"]
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


def test_health_names_the_model(client):
    state = {"status": "ok", "version": gk.__version__, "kind": "multires", "fps": 30.0}
    assert client().get("/health").json().items() >= state.items()


@pytest.mark.parametrize(
    ("inputs", "says"),
    [
        (Inputs(speech=False), "speech"),
        (Inputs(speech=True, words=True), "words"),
        (Inputs(speech=True, files=("mine",)), "features"),
    ],
)
def test_a_model_that_a_sound_is_not_enough_for_is_not_served(inputs, says):
    with pytest.raises(GestureKitError, match=says):
        create_app(SimpleNamespace(inputs=inputs))


def test_a_queue_that_is_full_says_so_at_once(client, model, monkeypatch):
    one, held = client(queue=0), threading.Event()
    generate = model.generate
    monkeypatch.setattr(
        type(model), "generate", lambda _, *a, **k: (held.wait(10), generate(*a, **k))[1]
    )
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
