"""A headless browser driven over the DevTools protocol, and simulated answers."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gesturekit.evaluation.agreement.answers import Answer
from gesturekit.study.analysis.votes import Votes


class Browser:
    """Chromium without network; `lines` collects every console line and error of its pages."""

    def __init__(self, folder: Path) -> None:
        self.lines: list[str] = []
        self.requests: list[str] = []
        self._buffer, self._id, self._loaded = b"", 0, False
        ours_in, theirs_out = os.pipe()
        theirs_in, ours_out = os.pipe()
        # Away from 3 and 4, which the protocol uses in the browser.
        given = [fcntl.fcntl(end, fcntl.F_DUPFD, 20) for end in (theirs_in, theirs_out)]
        command = ["chromium", "--headless", "--no-sandbox", "--use-angle=swiftshader"]
        command += ["--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run"]
        command += ["--disable-background-networking", "--disable-component-update"]
        command += ["--disable-sync", "--autoplay-policy=no-user-gesture-required", "--mute-audio"]
        command += [
            "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
            f"--user-data-dir={folder}/profile",
        ]
        shell = f'exec 3<&{given[0]} 4>&{given[1]}; exec "$@"'
        self.process = subprocess.Popen(
            ["bash", "-c", shell, "bash", *command, "--remote-debugging-pipe", "about:blank"],
            pass_fds=given,
            stderr=subprocess.DEVNULL,
        )
        for end in given:
            os.close(end)
        os.close(theirs_in)
        os.close(theirs_out)
        self._in, self._out = ours_in, ours_out
        self.session: str | None = None
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(target for target in targets if target["type"] == "page")
        found = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self.session = found["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._id += 1
        message = {"id": self._id, "method": method, "params": params}
        if self.session and not method.startswith(("Browser.", "Target.")):
            message["sessionId"] = self.session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + 60
        while True:
            answer = self._read(deadline)
            if answer.get("id") == self._id:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]

    def _read(self, deadline: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._in], [], [], max(0.0, deadline - time.monotonic()))
            assert ready, "the browser does not answer"
            received = os.read(self._in, 1 << 20)
            assert received, "the browser has ended"
            self._buffer += received
        text, self._buffer = self._buffer.split(b"\0", 1)
        message = json.loads(text)
        method, params = message.get("method"), message.get("params", {})
        if method in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
            self.lines.append(json.dumps(params)[:1200])
        elif method == "Page.loadEventFired":
            self._loaded = True
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif method == "Page.javascriptDialogOpening":
            self._id += 1
            answer = {"id": self._id, "method": "Page.handleJavaScriptDialog"}
            answer |= {"params": {"accept": True}, "sessionId": self.session}
            os.write(self._out, json.dumps(answer).encode() + b"\0")
        return message

    def open(self, url: str, *, width: int = 1280, height: int = 800, dark: bool = False) -> None:
        phone = width < 600
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=2 if phone else 1, mobile=phone,
        )  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self._loaded = False
        self.call("Page.navigate", url=url)
        deadline = time.monotonic() + 60
        while not self._loaded:
            self._read(deadline)

    def run(self, code: str) -> Any:
        """Return the value of an expression, awaited."""
        found = self.call(
            "Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True,
            userGesture=True,
        )  # fmt: skip
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, code: str, seconds: float = 30.0) -> None:
        """Wait until an expression is true."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if self.run(f"Boolean({code})"):
                return
            time.sleep(0.02)
        raise AssertionError(f"still false after {seconds} s: {code}; console: {self.lines}")

    def screenshot(self, path: Path) -> None:
        found = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(found["data"]))

    def close(self) -> None:
        os.close(self._out)
        os.close(self._in)
        self.process.terminate()
        self.process.wait(20)


ANSWER_BOUNDS = (0.3, 1.2)  # of a preference's size: below equal, slight, clear


@pytest.fixture(scope="session")
def simulate() -> Callable[..., Votes]:
    """simulate(strengths, raters=40, answers=36, spread=0.3, seed=0): votes of simulated raters.

    Each rater has strengths of the systems of its own, normal around those given; answers follow
    the logistic law of Bradley and Terry.
    """

    def make(strengths, raters=40, answers=36, spread=0.3, seed=0) -> Votes:
        rng, k = np.random.default_rng(seed), len(strengths)
        own = np.asarray(strengths) + spread * rng.standard_normal((raters, k))
        pairs = np.array([(i, j) for i in range(k) for j in range(k) if i != j])
        shown = pairs[rng.integers(len(pairs), size=(raters, answers))]
        row = np.arange(raters)[:, None]
        difference = own[row, shown[..., 0]] - own[row, shown[..., 1]]
        difference = difference + rng.logistic(size=difference.shape)
        size = np.digitize(np.abs(difference), ANSWER_BOUNDS)
        better = np.where(difference > 0, shown[..., 0], shown[..., 1])
        worse = shown.sum(axis=-1) - better
        counts = np.zeros((3, raters, k, k))
        np.add.at(counts, (size, np.broadcast_to(row, size.shape), better, worse), 1)
        ties = counts[0] + counts[0].transpose(0, 2, 1)
        names = tuple("abcdefgh"[:k])
        raters = tuple(f"r{r:05d}" for r in range(raters))
        return Votes(names, raters, counts[2], counts[1], ties)

    return make


@pytest.fixture(scope="session")
def answers_of() -> Callable[[Votes], list[Answer]]:
    """answers_of(votes): the answers that give these votes, sides in turn."""

    def make(votes: Votes) -> list[Answer]:
        found = []
        for score, counts in ((2, votes.clear), (1, votes.slight), (0, np.triu(votes.ties))):
            for r, i, j in np.argwhere(counts):
                for n in range(int(counts[r, i, j])):
                    a, b, s = votes.systems[i], votes.systems[j], score
                    if (n + r) % 2:
                        a, b, s = b, a, -s
                    found.append(Answer(votes.raters[r], f"clip{len(found) % 36}", a, b, s))
        return found

    return make


@pytest.fixture
def open_browser(tmp_path) -> Iterator[Callable[[], Browser]]:
    """open_browser(): a browser whose downloads lie in tmp_path."""
    if not shutil.which("chromium"):
        pytest.skip("Chromium is not installed")
    opened = []

    def start() -> Browser:
        opened.append(Browser(tmp_path))
        return opened[-1]

    yield start
    for browser in opened:
        browser.close()
