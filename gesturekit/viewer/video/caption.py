"""Captions on an image: labels and times."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from matplotlib import font_manager
from matplotlib.ft2font import FT2Font

INK = np.array([38, 48, 59], np.float32)
_LONGEST = 80
_DPI = 72


def write(image: np.ndarray, text: str, at: tuple[float, float], size: float) -> None:
    """Write text on an image (H, W, 3) uint8; what does not fit is cut off.

    Args:
        image: changed in place.
        text: a line.
        at: (row, column) of the middle of its left edge, pixels; a negative column counts from
            the right edge to the text's right edge.
        size: of the letters, pixels.
    """
    mask = text_mask(text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…", size)
    height, width = image.shape[:2]
    row, column = at
    top = max(0, round(row - mask.shape[0] / 2))
    left = max(0, round(column if column >= 0 else width + column - mask.shape[1]))
    mask = mask[: height - top, : width - left]
    part = image[top : top + mask.shape[0], left : left + mask.shape[1]]
    part[...] = part + mask[..., None] * (INK - part)


@lru_cache(64)
def text_mask(text: str, size: float) -> np.ndarray:
    """Return how much of each pixel a line of text covers, (H, W) float32 from 0 to 1.

    Letters that the font lacks are question marks.
    """
    font = FT2Font(font_manager.findfont("DejaVu Sans"))
    font.set_size(size, _DPI)
    font.set_text("".join(letter if font.get_char_index(ord(letter)) else "?" for letter in text))
    font.draw_glyphs_to_bitmap(antialiased=True)
    return np.asarray(font.get_image(), np.float32) / 255
