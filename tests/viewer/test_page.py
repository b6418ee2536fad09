"""The HTML player, as a person who opens the file meets it."""

import base64
import html
import json
import re
import subprocess
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import soundfile
from pages import bundled, data_of, opened
from rigs import rig_of
from scipy.spatial.transform import Rotation

from audio_features import Wave
from gesturekit.motion import Motion
from gesturekit.viewer import write_html
from gesturekit.viewer.player import bundle

pytestmark = bundled

SAMPLE_RATE = 16_000


def a_chain(n_frames: int = 90, fps: float = 30.0, seed: int = 0) -> Motion:
    """A rig of no known anatomy that swings and walks away."""
    rng = np.random.default_rng(seed)
    bones = {"base": (None, (0.0, 0.0, 0.0)), "middle": ("base", (0.0, 0.5, 0.0))}
    bones |= {"tip": ("middle", (0.3, 0.4, 0.0))}
    skeleton = rig_of(bones, end_sites={"tip": (np.array([0.0, 0.2, 0.0]),)})
    angles = np.cumsum(rng.normal(0, 0.05, (n_frames, 3, 3)), axis=0)
    rotations = Rotation.from_euler("ZXY", angles.reshape(-1, 3)).as_quat().reshape(n_frames, 3, 4)
    translation = np.stack([np.linspace(0, 40, n_frames), np.ones(n_frames), np.zeros(n_frames)], 1)
    return Motion(skeleton, rotations, translation, fps)


def a_voice(seconds: float = 3.0) -> Wave:
    time = np.arange(int(seconds * SAMPLE_RATE)) / SAMPLE_RATE
    samples = 0.3 * np.sin(2 * np.pi * 180 * time) * (np.sin(2 * np.pi * time) > 0)
    return Wave(samples.astype(np.float32), SAMPLE_RATE)


PLAYER = Path(bundle.__file__).parent
READ = f"""
import {{ read }} from "{PLAYER.as_uri()}/data.js";
import {{ readFileSync }} from "node:fs";
const [figure] = (await read({{ textContent: readFileSync(0, "utf8") }})).figures;
console.log(JSON.stringify([[...figure.steps], [...figure.root], figure.step]));
"""


def test_a_page_holds_every_point_to_a_tenth_of_a_millimetre(tmp_path):
    """The page's own script reads them, run by Node.js."""
    node = bundle.find_node()
    if node is None:
        pytest.skip("Node.js is not installed")
    motion = a_chain()
    write_html(motion, tmp_path / "swing.html")
    page = json.dumps(data_of(tmp_path / "swing.html"))
    command = [node[0], "--input-type=module", "--eval", READ]
    out = subprocess.run(command, input=page, capture_output=True, text=True, check=True).stdout
    steps, root, step = json.loads(out)
    points = np.reshape(root, (90, 1, 3)) + step * np.reshape(steps, (90, -1, 3))
    expected = np.concatenate([motion.positions(), motion.end_positions()["tip"]], axis=1)
    assert np.abs(points - expected).max() <= 1e-4


def test_a_page_needs_nothing_from_outside(tmp_path):
    write_html(a_chain(), tmp_path / "swing.html", audio=a_voice())
    text = (tmp_path / "swing.html").read_text(encoding="utf-8")
    markup = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert "default-src 'none'" in markup
    assert not re.search(r"""(src|href)\s*=|@import|url\(""", markup)
    assert "{{" not in markup


def test_names_and_titles_cannot_become_code(tmp_path):
    title = "</title><script>alert(1)</script> {{player}} \"&'"
    label = "</script><script>alert(2)</script><!--"
    write_html({label: a_chain(), "b": a_chain(seed=1)}, tmp_path / "x.html", title=title)
    text = (tmp_path / "x.html").read_text(encoding="utf-8")
    assert "alert(1)</script>" not in text
    assert "alert(2)</script>" not in text
    assert html.escape(title) in text
    assert data_of(tmp_path / "x.html")["figures"][0]["label"] == label


def test_small_recordings_are_embedded_byte_for_byte(tmp_path):
    voice = a_voice()
    for name, media_type in (("v.wav", "audio/wav"), ("v.flac", "audio/flac")):
        soundfile.write(tmp_path / name, voice.samples, voice.sample_rate)
        write_html(a_chain(), tmp_path / "p.html", audio=tmp_path / name)
        page = data_of(tmp_path / "p.html")
        assert page["audio"]["type"] == media_type
        assert base64.b64decode(page["audio"]["data"]) == (tmp_path / name).read_bytes()
        assert page["speech"]["duration"] == pytest.approx(3.0)


def test_long_recordings_become_small_and_stay_in_time(tmp_path):
    rng = np.random.default_rng(0)
    samples = np.zeros(130 * SAMPLE_RATE, dtype=np.float32)
    clicks = np.arange(1, 130, 7) * SAMPLE_RATE
    for click in clicks:
        samples[click : click + 800] = rng.normal(0, 0.3, 800)
    soundfile.write(tmp_path / "long.wav", samples, SAMPLE_RATE)
    write_html(a_chain(), tmp_path / "p.html", audio=tmp_path / "long.wav")
    page = data_of(tmp_path / "p.html")
    embedded = base64.b64decode(page["audio"]["data"])
    assert len(embedded) < 2_000_000 < (tmp_path / "long.wav").stat().st_size
    (tmp_path / "embedded").write_bytes(embedded)
    back, rate = soundfile.read(tmp_path / "embedded")
    assert len(back) / rate == pytest.approx(130, abs=0.1)
    for click in clicks:
        second = back[int((click / SAMPLE_RATE - 0.5) * rate) :][: int(rate)]
        assert np.argmax(np.abs(second) > 0.1) / rate == pytest.approx(0.5, abs=0.01)


def test_the_bundle_was_made_from_the_sources_beside_it():
    assert not bundle.outdated(), "player.bundle.js is out of date: run `make setup`"


@pytest.mark.stress
def test_the_page_opens_in_a_browser(tmp_path, open_browser):
    write_html(a_chain(n_frames=77), tmp_path / "swing.html", title="swing")
    browser = opened(open_browser, tmp_path / "swing.html", "t=1")
    assert browser.run("document.documentElement.dataset.frames") == "77"
    assert "frame 30" in browser.run("document.body.textContent")
    assert browser.lines == []


RATIO = "document.getElementById('view').width / document.getElementById('view').clientWidth"


def sides(browser, folder: Path) -> tuple[float, float]:
    """Return the mean columns, 0 to 1, of orange (left) and blue (right) pixels of the figure."""
    browser.screenshot(folder / "page.png")
    image = matplotlib.image.imread(folder / "page.png")[:230, :, :3]
    red, _, blue = np.moveaxis(image, -1, 0)
    found = [np.nonzero(mask)[1] for mask in (red > blue + 0.3, blue > red + 0.3)]
    assert min(map(len, found)) > 100
    return tuple(columns.mean() / image.shape[1] for columns in found)


@pytest.mark.stress
def test_the_mannequin_is_drawn_still_and_moving(tmp_path, gesture, open_browser) -> None:
    write_html(gesture(60.0), tmp_path / "a.html")
    browser = opened(open_browser, tmp_path / "a.html")
    left, right = sides(browser, tmp_path)
    assert right < 0.5 < left  # it faces the viewer
    assert browser.run(RATIO) == 2  # fine edges while nothing moves
    browser.run("player.play()")
    browser.wait(f"{RATIO} < 1")
    moving = sides(browser, tmp_path)
    np.testing.assert_allclose(moving, (left, right), atol=0.05)
    browser.run("player.pause()")
    browser.wait(f"{RATIO} == 2")
    assert browser.lines == []
