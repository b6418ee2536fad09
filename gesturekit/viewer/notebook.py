"""The HTML player inside a notebook's output."""

from __future__ import annotations

import html
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from audio_features import Wave
from gesturekit.motion.body_model.model import BodyModel
from gesturekit.viewer.html import page_text

if TYPE_CHECKING:
    from gesturekit.motion import Motion


@dataclass(frozen=True)
class Display:
    """A page that notebooks show as the output of a cell.

    Attributes:
        page: the HTML of the player.
        height: of the output, pixels.
    """

    page: str
    height: int

    def __repr__(self) -> str:
        return f"Display({len(self.page) / 1e6:.1f} MB of HTML, which notebooks show)"

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" allow="fullscreen; autoplay" '
            f'style="width: 100%; height: {self.height}px; border: 0"></iframe>'
        )


def display(
    motion: Motion | Mapping[str, Motion],
    audio: str | os.PathLike[str] | Wave | None = None,
    title: str = "",
    body_model: BodyModel | str | os.PathLike[str] | None = None,
    height: int = 640,
    body: str | None = None,
) -> Display:
    """Return the player of one motion, or of {label: motion}, for a notebook.

    Arguments and errors are those of `write_html`; `height` is in pixels.
    """
    return Display(page_text(motion, audio, title, body_model, body), int(height))
