"""The page of a study in a headless browser without network, as raters meet it."""

import csv
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from urllib.parse import quote

import pytest
from pages import bundled

from gesturekit.evaluation import GENEA_COLUMNS, read_answers
from gesturekit.study import CODES, StudyConfig, build_study

pytestmark = bundled

COMMENT = "the <i>third</i>, lagged"
ANSWERS = tuple(f"answer {k}" for k in range(5))
TEXTS = dict(zip(ANSWERS, CODES, strict=True))


@pytest.fixture(scope="module")
def videos(tmp_path_factory) -> dict[str, str]:
    """Folders of 12 videos of a tenth of a second with a tone, of two systems."""
    if not shutil.which("ffmpeg"):
        pytest.skip("ffmpeg is not installed")
    folder = tmp_path_factory.mktemp("videos")
    for system, hue in (("ours", "red"), ("base line", "blue")):
        (folder / system).mkdir()
        first = folder / system / "clip 00.webm"
        command = ["ffmpeg", "-v", "error", "-f", "lavfi", "-i", f"color={hue}:s=64x64:d=0.08:r=25"]
        command += ["-f", "lavfi", "-i", "sine=300:d=0.08", "-c:v", "libvpx", "-c:a", "libopus"]
        subprocess.run([*command, str(first)], check=True)
        for k in range(1, 12):
            shutil.copy(first, first.with_name(f"clip {k:02d}.webm"))
    return {path.name: str(path) for path in folder.iterdir()}


def start(browser, page: Path, query: str = "", **options) -> None:
    browser.open(f"{page.as_uri()}?{query}", **options)
    browser.wait("document.querySelector('.page .next')")
    browser.run("document.querySelector('.consent input')?.click()")
    browser.run("document.querySelector('.page .next').click()")
    browser.wait("document.querySelector('[name=tones]') || document.querySelector('.progress')")
    if browser.run("Boolean(document.querySelector('[name=tones]'))"):
        hear(browser)


def hear(browser) -> None:
    """Count the tones that the page plays, once say another number, then the right one."""
    browser.run(
        "(() => { window.tones = 0; const { prototype } = OscillatorNode, { start } = prototype;"
        " prototype.start = function (at) { tones += 1; start.call(this, at); }; })()"
    )
    for wrong in (1, 0):
        assert browser.run("document.querySelectorAll('[name=tones]:enabled').length") == 0
        browser.run("tones = 0; document.querySelector('.page .play').click()")
        browser.wait("document.querySelectorAll('[name=tones]:enabled').length == 5")
        count = browser.run("tones")
        assert 2 <= count <= 5
        answer = 2 + (count - 1) % 4 if wrong else count
        browser.run(f"document.querySelector('[name=tones][value=\"{answer}\"]').click()")
        browser.run("document.querySelector('.page .next').click()")


def play_both(browser) -> None:
    """Play both sides; the five answers are locked until then."""
    for side in (0, 1):
        browser.wait("document.querySelectorAll('.play:enabled').length == 2")
        assert browser.run("document.querySelectorAll('.answer :enabled').length") == 0
        browser.run(f"document.querySelectorAll('.play')[{side}].click()")
        again = "Play left again" if side == 0 else "Play right again"
        browser.wait(f"document.querySelectorAll('.play')[{side}].textContent == '{again}'")


def rate(browser, choose: Callable[[int, str], str]) -> int:
    """Go through a study; `choose(index, message)` gives the code of an answer."""
    n = 0
    while True:
        browser.wait(
            "document.querySelector('.clips') || document.querySelector('.page .next')"
            " || document.documentElement.dataset.study"
        )
        if browser.run("document.documentElement.dataset.study"):
            return n
        if browser.run("Boolean(document.querySelector('.page .next'))"):
            browser.run(
                "{ const box = document.querySelector('.page textarea');"
                f" if (box) box.value = {COMMENT!r}; }}"
            )
            browser.run("document.querySelector('.page .next').click()")
            continue
        play_both(browser)
        message = browser.run("document.querySelector('.message').textContent")
        code = choose(n, message)
        browser.run(f"document.querySelector('input[value={code}]').click()")
        browser.run("document.querySelector('.foot .next').click()")
        n += 1


def attentive(n: int, message: str) -> str:
    return next((c for t, c in TEXTS.items() if t in message), CODES[n % 5])


def downloaded(folder: Path, name: str) -> Path:
    for _ in range(100):
        if (folder / name).is_file():
            return folder / name
        time.sleep(0.05)
    raise AssertionError(f"{name} was not downloaded: {list(folder.iterdir())}")


def test_pairs_are_rated_from_a_disk_and_analysed(videos, tmp_path, open_browser, gesturekit):
    browser, files = open_browser(), []
    options = {"consent": "I *agree*.", "answers": ANSWERS, "attention_checks": 1}
    page = build_study(StudyConfig("Study", videos, pairs=2, **options), tmp_path / "my study").page
    for user, choose in (("p1", attentive), ("Zoë_語", lambda *_: "TheyAreEqual")):
        start(browser, page, f"PROLIFIC_PID={quote(user)}&STUDY_ID=st&SESSION_ID=se&list=3")
        assert rate(browser, choose) == 1 + 2 + 1, "practice, comparisons, attention check"
        files.append(downloaded(tmp_path, f"my_study_{user}.csv"))
    assert browser.lines == []
    assert all(url.startswith(("file:", "blob:", "data:")) for url in browser.requests)

    lines = files[0].read_text().splitlines()
    assert lines[0].split(",")[: len(GENEA_COLUMNS)] == list(GENEA_COLUMNS)
    found = read_answers(files)
    assert list(found.excluded) == ["Zoë_語"] and "1 of 1" in found.excluded["Zoë_語"]
    assert found.comments == {"p1": COMMENT, "Zoë_語": COMMENT}
    assert len(found.kept) == len({answer.clip for answer in found.kept}) == 2
    sides = [(answer.left, answer.right) for answer in found.kept]
    assert set(sides) == {("ours", "base line"), ("base line", "ours")}
    rows = [*csv.DictReader(lines)]
    scores = dict(zip(CODES, (2, 1, 0, -1, -2), strict=True))
    for row, answer in zip(rows, found.kept, strict=True):
        assert scores[row["answer"]] == answer.score
        assert (row["study_id"], row["session_id"], row["list"]) == ("st", "se", "3")
        assert row["plays_left"] == row["plays_right"] == "1"

    done = gesturekit("study", "analyse", *files, "--out", tmp_path / "report.html").ok()
    assert "2 answers" in done.out and re.search(r"\b1 rater\b", done.out)
    browser.open((tmp_path / "report.html").as_uri())
    browser.wait("document.body.innerText.includes('base line')")
    assert browser.lines == []


def rate_with_sliders(browser, value: Callable[[int, str], int]) -> int:
    """Go through a study of sliders; `value(position, message)` is the rating of a clip."""
    n = 0
    while True:
        browser.wait("document.querySelector('.row .play:enabled, .page .next, [data-study]')")
        if browser.run("Boolean(document.querySelector('[data-study]'))"):
            return n
        if browser.run("Boolean(document.querySelector('.page .next'))"):
            browser.run("document.querySelector('.page .next').click()")
            continue
        rows = browser.run("document.querySelectorAll('.row input').length")
        for k in range(rows):
            assert browser.run(f"document.querySelectorAll('.row input')[{k}].disabled")
            browser.run(f"document.querySelectorAll('.row .play')[{k}].click()")
            browser.wait(f"!document.querySelectorAll('.row input')[{k}].disabled")
            shown = "document.querySelectorAll('.screen')"
            visible = [
                browser.run(f"getComputedStyle({shown}[{i}]).visibility") for i in range(rows)
            ]
            assert visible == ["visible" if i == k else "hidden" for i in range(rows)]
            assert browser.run("document.querySelector('.foot .next').disabled")
            message = browser.run(f"{shown}[{k}].textContent")
            seen = browser.run(f"{shown}[{k}].querySelector('.message').hidden") is False
            browser.run(
                f"(() => {{ const slider = document.querySelectorAll('.row input')[{k}];"
                f" slider.value = {value(k, message if seen else '')};"
                " slider.dispatchEvent(new Event('input')); })()"
            )
        browser.run("document.querySelector('.foot .next').click()")
        n += 1


def test_sliders_of_several_systems_are_rated_and_analysed(
    videos, tmp_path, open_browser, gesturekit
):
    """Shown in another order on each page; each clip is played before its slider counts."""
    shutil.copytree(videos["ours"], tmp_path / "third")
    systems = {**videos, "third": str(tmp_path / "third")}
    config = StudyConfig(
        "Study", systems, "rating", sound="none", pairs=3, attention_checks=1, seed=3
    )
    page = build_study(config, tmp_path / "out").page

    def obedient(position: int, message: str) -> int:
        asked = re.search(r"to (\d+)", message)
        return int(asked[1]) if asked else 10 * (position + 1)

    browser, files = open_browser(), []
    for user, value in (("u", obedient), ("v", lambda position, message: 50 + position)):
        start(browser, page, f"user={user}")
        assert rate_with_sliders(browser, value) == 1 + 3 + 1
        files.append(downloaded(tmp_path, f"out_{user}.csv"))
    assert browser.lines == []
    rows = [*csv.DictReader(files[0].read_text().splitlines())]
    assert len(rows) == 9 and {row["system"] for row in rows} == {*systems}
    assert all(row["value"] == f"{row['position']}0" and row["plays"] == "1" for row in rows)
    orders = {tuple(row["system"] for row in rows[k : k + 3]) for k in (0, 3, 6)}
    assert len(orders) > 1
    found = read_answers(files)
    assert list(found.excluded) == ["v"] and len(found.kept) == 3 * 3
    done = gesturekit("study", "analyse", *files, "--out", tmp_path / "report.html").ok()
    assert "9 comparisons of 1 rater" in done.out


@pytest.mark.stress
def test_motions_are_shown_in_3d_on_a_phone_without_controls(
    tmp_path, gesture, write_speech, open_browser
):
    for k, system in enumerate(("ours", "base <b>")):
        for clip in ("a b", "c"):
            gesture(0.6, seed=k).save(tmp_path / system / f"{clip}.bvh")
            write_speech(tmp_path / "speech" / f"{clip}.wav", 0.5, 44100)
    systems = {name: str(tmp_path / name) for name in ("ours", "base <b>")}
    config = StudyConfig(
        "Study", systems, audio=tmp_path / "speech", reasons="realism", attention_checks=0,
        practice=False,
    )  # fmt: skip
    built = build_study(config, tmp_path / "out")
    assert built.page_bytes < 2_000_000
    browser = open_browser()
    start(browser, built.page, "user=u", width=390, height=700, dark=True)
    play_both(browser)
    inside = "document.querySelector('iframe').contentDocument"
    assert browser.run(f"{inside}.querySelector('footer').offsetHeight") == 0
    assert browser.run(f"{inside}.title") == ""
    assert browser.run(f"{inside}.documentElement.dataset.state") == "ready"
    assert browser.run("document.documentElement.scrollWidth") <= 390
    browser.run("document.querySelector('input[value=LeftSlightlyBetter]').click()")
    browser.run("document.querySelector('input[value=MotionSmoothness]').click()")
    browser.run("document.querySelector('textarea').value = 'it, \"glides\"\\nwell'")
    browser.run("document.querySelector('.foot .next').click()")
    assert rate(browser, lambda n, message: "TheyAreEqual") == 1
    assert browser.lines == []
    first, second = read_answers([downloaded(tmp_path, "out_u.csv")]).kept
    assert (first.score, first.reasons, second.score) == (1, ("MotionSmoothness",), 0)
    assert {first.clip, second.clip} == {"a b", "c"}


@pytest.mark.stress
@pytest.mark.parametrize("status", [200, 500])
def test_answers_are_posted_and_never_lost(videos, tmp_path, open_browser, status):
    received = []

    class Collector(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            received.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
            self.send_response(status)
            self.send_header("Access-Control-Allow-Origin", "*")
            self.end_headers()

        def log_message(self, *args: object) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Collector)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        config = StudyConfig(
            "Study", videos, "mismatch", pairs=1, attention_checks=0, practice=False,
            sound_check=False,
            post_url=f"http://127.0.0.1:{server.server_port}/answers",
            completion_url="https://app.prolific.com/submissions/complete?cc=ABC",
        )  # fmt: skip
        browser = open_browser()
        start(browser, build_study(config, tmp_path / "out").page, "user=u")
        rate(browser, lambda n, message: "LeftClearlyBetter")
        browser.wait("document.querySelector('a.next')")
        assert browser.run("document.querySelector('a.next').href") == config.completion_url
        state = browser.run("document.documentElement.dataset.study")
    finally:
        server.shutdown()
        server.server_close()
    (text,) = received
    assert state == ("sent" if status == 200 else "downloaded")
    if status == 500:
        assert downloaded(tmp_path, "out_u.csv").read_bytes().decode() == text
    (tmp_path / "posted.csv").write_text(text, encoding="utf-8", newline="")
    (answer,) = read_answers([tmp_path / "posted.csv"]).kept
    assert answer.matched in videos and answer.score == 2
