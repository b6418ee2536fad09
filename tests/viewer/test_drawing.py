"""Drawings of the player on a software renderer, seen in a headless browser."""

from __future__ import annotations

import time
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from pages import bundled, opened

from gesturekit.viewer import write_html

pytestmark = bundled
RATIO = "document.getElementById('view').width / document.getElementById('view').clientWidth"


def sides(browser, folder: Path) -> tuple[float, float]:
    """Return the mean columns, 0 to 1, of orange (left) and blue (right) pixels of the figure."""
    browser.screenshot(folder / "page.png")
    image = matplotlib.image.imread(folder / "page.png")[:230, :, :3]
    red, _, blue = np.moveaxis(image, -1, 0)
    found = [np.nonzero(mask)[1] for mask in (red > blue + 0.3, blue > red + 0.3)]
    assert min(map(len, found)) > 100
    return tuple(columns.mean() / image.shape[1] for columns in found)


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


@pytest.mark.stress
def test_frames_that_come_late_are_drawn_with_fewer_pixels(tmp_path, gesture, open_browser) -> None:
    write_html(gesture(60.0), tmp_path / "a.html")
    browser = opened(open_browser, tmp_path / "a.html", dark=True)
    browser.run("player.play()")
    browser.wait(f"{RATIO} == 0.75")
    slow = "(function burn() { const end = performance.now() + 60;"
    slow += " while (performance.now() < end); requestAnimationFrame(burn); })()"
    browser.run(slow)
    time.sleep(1)
    assert browser.run(RATIO) == 0.75  # not for a moment's delay
    browser.wait(f"{RATIO} == 0.5", 10)
    sides(browser, tmp_path)
    assert browser.lines == []
