"""Skins in the data of a page, and how its numbers are packed: see player/data.js."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.human.body import TOPS, palette_of
from gesturekit.viewer.skin import Skin, steady_turns

_LEVELS = 2
"""Skins of the human body on a page: the finest one, and one for playing on slow machines."""
_FULL = 32_767


def add_skins(page: dict[str, Any], shown: Sequence[DrawnBody]) -> None:
    """Add the skins of all figures to a page that has its figures already.

    The human body is there once, whatever the number of figures; the skins of a body model share
    everything but the vertices.
    """
    skins = next((drawn.skins for drawn in shown if drawn.skins), None)
    if skins is None:
        return
    skin = skins[0]
    if skin.regions is None:
        page["skin"] = {
            "faces": base64_text(skin.faces.astype("<u4").tobytes()),
            "joints": base64_text(skin.joints.tobytes()),
            "weights": base64_text(skin.weights.tobytes()),
        }
    else:
        page["skin"] = {"levels": [_level(each) for each in skins[:_LEVELS]]}
    for k, (figure, drawn) in enumerate(zip(page["figures"], shown)):
        if not drawn.skins:
            continue
        skin = drawn.skins[0]
        figure["skin"] = {
            "joints": base64_text((drawn.scale * skin.rest).astype("<f4").tobytes()),
            "turns": base64_text(packed(np.rint(steady_turns(drawn.motion) * _FULL))),
        }
        if skin.regions is None:
            figure["skin"]["vertices"] = base64_text(skin.vertices.astype("<f4").tobytes())
        else:
            colours = skin.palette
            if colours is None:
                colours = palette_of(TOPS[k % len(TOPS)]).values()
            palette = ["#{:02x}{:02x}{:02x}".format(*colour) for colour in colours]
            figure["skin"] |= {"scale": drawn.scale, "palette": palette}


def _level(skin: Skin) -> dict[str, Any]:
    """Return a mesh at rest as steps from its middle."""
    low, high = skin.vertices.min(axis=0), skin.vertices.max(axis=0)
    middle, step = (low + high) / 2, float((high - low).max()) / 2 / _FULL
    return {
        "n_vertices": len(skin.vertices),
        "n_faces": len(skin.faces),
        "middle": middle.tolist(),
        "step": step,
        "vertices": base64_text(packed(np.rint((skin.vertices - middle) / step))),
        "faces": base64_text(packed(skin.faces)),
        "joints": base64_text(zlib.compress(skin.joints.tobytes(), 9)),
        "weights": base64_text(zlib.compress(skin.weights.tobytes(), 9)),
        "regions": base64_text(zlib.compress(skin.regions.tobytes(), 9)),
    }


def packed(steps: np.ndarray) -> bytes:
    """Deflate whole numbers (T, ...) of 16 bits: see `unpack` in player/data.js."""
    channels = steps.astype(np.int64).reshape(len(steps), -1).T
    difference = np.diff(channels, axis=1, prepend=0) & 0xFFFF
    planes = np.stack([difference & 0xFF, difference >> 8]).astype(np.uint8)
    return zlib.compress(planes.tobytes(), 6)


def base64_text(data: bytes) -> str:
    """Return bytes as text in base64."""
    return base64.b64encode(data).decode("ascii")
