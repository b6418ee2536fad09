"""The page and its frames, as real clients get them."""

import http.client
import json
import re
import socket
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from loud import LoudModel, raised
from pages import bundled
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from gesturekit.live import Step
from gesturekit.live.page import Page
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.face import FaceTrack
from gesturekit.viewer.human import load_human

pytestmark = bundled

SILENCE = np.zeros(0, np.float32)


@dataclass
class Served:
    """A page that is being served, and its sink."""

    page: Page
    port: int
    skeleton: Skeleton

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}/stream"

    def raise_arm(self, degrees: list[float], time: float, lag: float | None = 0.25) -> None:
        motion = raised(self.skeleton, np.deg2rad(degrees), 30.0)
        self.page.put(Step(SILENCE, motion, time, lag))

    def joints(self) -> dict:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/") as answer:
            text = answer.read().decode()
        return json.loads(re.search(r'json" id="motion">(.*?)</script>', text, re.S)[1])["live"]


@pytest.fixture
def serve() -> Iterator[Callable[..., Served]]:
    opened = []

    def start(
        body: str = "human", raised_by: float = 0.0, sound: Path | None = None, **access
    ) -> Served:
        listening = socket.create_server(("127.0.0.1", 0))
        skeleton = LoudModel().skeleton
        example = raised(skeleton, np.full(30, raised_by), 30.0)
        hosts = access.pop("hosts", ("127.0.0.1",))
        if names := access.pop("face", ()):
            example = replace(example, face=FaceTrack(names, np.ones((30, len(names))), "rules"))
        page = Page(listening, hosts, example, body=body, sound=sound, **access)
        opened.append(page)
        return Served(page, listening.getsockname()[1], skeleton)

    yield start
    for page in opened:
        page.close()


def decoded(message: bytes) -> tuple[float, float, np.ndarray, np.ndarray]:
    seconds, lag = np.frombuffer(message[:16], "<f8")
    numbers = np.frombuffer(message[16:], "<f4")
    return seconds, lag, numbers[:3], numbers[3:].reshape(-1, 4)


def watched(served: Served, *clients) -> None:
    """Wait until all clients get frames: those of second -1."""
    deadline, waiting = time.monotonic() + 5, list(clients)
    while waiting:
        assert time.monotonic() < deadline
        served.raise_arm([0.0], -1.0)
        with suppress(TimeoutError):
            waiting[0].recv(timeout=0.05)
            waiting.pop(0)


def received(client) -> tuple[float, float, np.ndarray, np.ndarray]:
    while (message := decoded(client.recv(timeout=5)))[0] < 0:
        pass
    return message


def test_a_client_gets_each_pose_with_the_time_of_its_sound(serve):
    served = serve()
    with connect(served.url) as client:
        watched(served, client)
        served.raise_arm([0.0, 60.0], 3.0)
        first, second = (received(client) for _ in range(2))
    assert first[0] == 3.0 and second[0] == pytest.approx(3.0 + 1 / 30)
    assert first[1] == 0.25 and second[1] == pytest.approx(0.25 - 1 / 30)
    joints, human = served.joints(), load_human()[0]
    assert joints["parents"][: joints["n_joints"]] == list(human.parents)
    for (_, _, root, turns), direction in ((first, [-1, 0, 0]), (second, [-0.5, 0.75**0.5, 0])):
        # The right arm, on the page's rig: the page turns each offset by all joints above it.
        rig = Skeleton(human.names, human.parents, joints["offsets"][: len(turns)])
        places = Motion(rig, turns[None], root[None], 30.0).positions()[0]
        arm, hand = (places[rig.index(name)] for name in ("RightArm", "RightHand"))
        np.testing.assert_allclose((hand - arm) / np.linalg.norm(hand - arm), direction, atol=0.03)
        assert places[:, 1].min() == pytest.approx(0.08, abs=0.08)


def test_the_body_on_the_page_gets_its_face(serve, open_browser):
    names = ("unknown", "jawOpen", "eyeBlinkLeft")
    served, browser = serve(face=names), open_browser()
    order = sorted(names[1:], key=list(load_human()[1][0].morphs).index)
    motion = raised(served.skeleton, np.zeros(3), 30.0)
    face = FaceTrack(names, np.outer([1, 2, 3], [0.3, 0.25, 0.125]), "rules")
    browser.open(f"http://127.0.0.1:{served.port}/", width=320, height=320)
    browser.wait("document.documentElement.dataset.state == 'ready'")
    with connect(served.url) as client:
        while not served.page.is_open:
            time.sleep(0.01)
        served.page.put(Step(SILENCE, replace(motion, face=face), 2.0, None))
        numbers = [np.frombuffer(client.recv(timeout=5)[16:], "<f4") for _ in range(3)]
    expected = np.stack([face.channel(name) for name in order], axis=1)
    n_joints = load_human()[0].n_joints
    np.testing.assert_allclose([row[3 + 4 * n_joints :] for row in numbers], expected)
    browser.wait("document.documentElement.dataset.frames == 3")
    shown = browser.run("[...live.figure.skin.face.slice(0, 6)]")
    np.testing.assert_allclose(shown, expected.ravel())


DRIFT = """((ppm) => {
  const playout = new window.live.Playout();
  let seed = 1, newest = 0, last = 0, worst = { behind: 0, ahead: 0, back: 0 };
  const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
  for (let k = 0; k < 1800 * 30; k++) {
    const sent = (k / 30) * (1 + ppm * 1e-6) + 50;
    playout.arrived(k / 30, sent + 0.03 * random());
    const shown = playout.at(sent + 0.033);
    if (k >= 300) {
      worst.behind = Math.max(worst.behind, k / 30 - shown);
      worst.ahead = Math.max(worst.ahead, shown - k / 30);
      worst.back = Math.max(worst.back, last - shown);
    }
    last = shown;
  }
  return worst;
})"""


@pytest.mark.stress
def test_a_browser_shows_frames_steadily_with_their_sound(
    serve, open_browser, write_speech, tmp_path
):
    """Half an hour of 200 ppm each way, and up to 30 ms on the way: 30 ms of delay, no more."""
    sound = write_speech(tmp_path / "a.wav", 9.0)
    served, browser = serve("mannequin", sound=sound), open_browser()
    browser.open(f"http://127.0.0.1:{served.port}/", width=480, height=400)
    browser.wait("document.documentElement.dataset.state == 'ready'")
    # Browsers play sound only after a click, unless they are started with a flag.
    browser.run("live.sound.play = () => Promise.reject(new Error())")
    served.raise_arm([0.0] * 30, 5.0)
    browser.wait("facts.textContent.includes('click')")
    browser.run("delete live.sound.play; window.dispatchEvent(new Event('pointerdown'))")
    browser.wait("live.sound.currentTime > 4.8 && !facts.textContent.includes('click')")
    # Frames that are late stop the sound too.
    browser.wait("live.sound.paused && live.sound.currentTime < 7")
    served.raise_arm([0.0] * 30, 6.0)
    browser.wait("!live.sound.paused")
    for ppm in (-200, 200):
        worst = browser.run(f"{DRIFT}({ppm})")
        assert worst["behind"] < 0.02 and worst["ahead"] < 0.034 and worst["back"] == 0
    served.page.close()
    browser.wait("live.sound.paused && facts.textContent.includes('ended')")
    assert not [line for line in browser.lines if "Content Security Policy" in line]


def test_clients_that_leave_or_block_slow_nobody(serve):
    served = serve()
    with connect(served.url, max_queue=1) as asleep, connect(served.url) as awake:
        with connect(served.url) as gone:
            watched(served, asleep, awake, gone)
        begun, per_step, seen = time.monotonic(), 200, []
        for k in range(18):  # 3600 frames, some 7 MB: more than the system holds for the sleeper
            served.raise_arm([0.0] * per_step, k * per_step / 30)
            while not seen or seen[-1] < ((k + 1) * per_step - 1) / 30 - 1e-6:
                seen.append(received(awake)[0])
        assert time.monotonic() - begun < 15
        # The sleeper wakes: what it missed is gone, and it gets the newest frames.
        late = [received(asleep)[0]]
        while late[-1] < 3599 / 30 - 1e-6:
            late.append(received(asleep)[0])
    assert len(late) < 3600 and (np.diff(late) > 0).all()


def test_pages_of_other_sites_get_nothing(serve):
    served = serve()
    with pytest.raises(InvalidStatus, match="403"):
        connect(served.url, origin="http://elsewhere.example")
    for path in ("/", "/stream"):
        asked = http.client.HTTPConnection("127.0.0.1", served.port, timeout=5)
        asked.request("GET", path, headers={"Host": "rebound.example"})
        assert asked.getresponse().status in (400, 404)
        asked.close()
    with connect(served.url, origin=f"http://127.0.0.1:{served.port}") as client:
        served.page.close()
        with pytest.raises(ConnectionClosed):
            client.recv(timeout=5)


def test_a_page_for_other_machines_asks_for_its_token(serve):
    """A page elsewhere that gave itself this address has Host and Origin of its own name."""
    served = serve("mannequin", hosts=("*",), token="0123456789abcdef")
    asked = http.client.HTTPConnection("127.0.0.1", served.port, timeout=5)
    for query, status in (("", 401), ("?token=0123456789abcdee", 401), ("?token=é", 401)):
        asked.request("GET", f"/{quote(query, safe='?=')}")
        answer = asked.getresponse()
        assert (answer.status, b"live" in answer.read()) == (status, False)
    asked.request("GET", "/?token=0123456789abcdef")
    answer = asked.getresponse()
    assert answer.status == 200 and b'id="motion"' in answer.read()
    cookie = answer.getheader("Set-Cookie")
    assert "HttpOnly" in cookie and "SameSite=strict" in cookie
    asked.close()
    own = {"Cookie": cookie.split(";")[0]}
    rebound = f"http://rebound.example:{served.port}"
    for headers, origin in (({}, rebound), (own, rebound), ({"Authorization": "Bearer x"}, None)):
        with (
            socket.create_connection(("127.0.0.1", served.port)) as line,
            pytest.raises(InvalidStatus, match="403"),
        ):
            name = "127.0.0.1" if headers else "rebound.example"
            connect(
                f"ws://{name}:{served.port}/stream",
                sock=line,
                origin=origin,
                additional_headers=headers,
            )
    for headers in (own, {"Authorization": "Bearer 0123456789abcdef"}):
        with connect(served.url, additional_headers=headers) as client:
            watched(served, client)
            served.raise_arm([0.0], 1.0)
            assert received(client)[0] == 1.0


def test_a_page_that_many_watch_refuses_more_and_serves_those(serve):
    served = serve("mannequin")
    with ExitStack() as opened:
        clients = []
        with pytest.raises(InvalidStatus, match="403"):
            while len(clients) < 200:
                clients.append(opened.enter_context(connect(served.url)))
        watched(served, *clients)
        served.raise_arm([0.0], 1.0)
        assert {received(client)[0] for client in clients} == {1.0}
        begun = time.monotonic()
        served.page.close()
        for client in clients:
            with pytest.raises(ConnectionClosed):
                client.recv(timeout=5)
    assert time.monotonic() - begun < 4
    with pytest.raises(OSError, match="refused"):
        connect(served.url)
