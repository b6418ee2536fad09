"""The player's pages in tests: what they hold, and a browser that shows them."""

import base64
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gesturekit.viewer

bundled = pytest.mark.skipif(
    not Path(gesturekit.viewer.__file__).with_name("player.bundle.js").is_file(),
    reason="the player is not bundled: run `make setup`",
)


def data_of(page: Path) -> dict[str, Any]:
    """Return the data of a page."""
    text = page.read_text(encoding="utf-8")
    return json.loads(re.search(r'json" id="motion">(.*?)</script>', text, re.S)[1])


def unpacked(text: str, frames: int) -> np.ndarray:
    """Return what `unpack` of player/data.js does: (T, channels) uint16."""
    packed = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).astype(np.int64)
    low, high = packed.reshape(2, -1, frames)
    return np.cumsum(low + (high << 8), axis=1).astype(np.uint16).T


def opened(open_browser: Any, page: Path, at: str = "t=0.5", **options: Any) -> Any:
    """Return a browser that shows a page at a time."""
    browser = open_browser()
    browser.open(f"{page.as_uri()}#{at}", **{"width": 640, "height": 480, **options})
    browser.wait("document.documentElement.dataset.state == 'ready'")
    return browser
