"""The HTML player: one file, or the output of a notebook, that shows a motion with its sound.

It needs no network and no server.

The page holds three.js and the player (bundled by `make setup`), the motion and the sound. The
motion is stored as the points of its `Figure`, so any skeleton plays. Points are whole steps of
0.1 mm on an adult from the root (longer only where they lie far from it), stored as differences
from frame to frame and deflated; ten minutes at 60 fps with 75 joints come to about 20 MB.
"""

from __future__ import annotations

import html
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from audio_features.atomic import write_text
from gesturekit.motion.body_model import BodyModel
from gesturekit.viewer.drawn_body import drawn_bodies
from gesturekit.viewer.figure import Figure
from gesturekit.viewer.human import COLOURS
from gesturekit.viewer.page_data import (
    BANDS,
    OUTLINE_RATE,
    Playable,
    add_skins,
    as_wave,
    base64_text,
    contact_track,
    encoded,
    onsets,
    outline,
    packed,
    spectrogram,
    speed_minima,
)
from gesturekit.viewer.pages import bundled_script, filled, insert, script_json
from gesturekit.wording import printable

if TYPE_CHECKING:
    from gesturekit.motion import Motion

STEP = 6e-5
"""Resolution of stored points, as a share of the figure's height: 0.1 mm on an adult."""

_HERE = Path(__file__).parent
_BUNDLE = _HERE / "player.bundle.js"


def write_html(
    motion: Motion | Mapping[str, Motion],
    path: str | os.PathLike[str],
    *,
    audio: Playable | None = None,
    title: str | None = None,
    body: str | None = None,
    body_model: BodyModel | str | os.PathLike[str] | None = None,
    framing: str = "whole",
) -> None:
    """Write a page that plays a motion: open it by a double click, send it by mail.

    Args:
        motion: what to show; or {label: motion} to stand several side by side.
        path: the .html file to write.
        audio: the speech that belongs to it, a file or a `Wave`; it starts with the motion.
        title: the page's heading; the file's stem by default.
        body: "mannequin" (by default), "human", "skeleton" or the path of a VRM avatar; see
            `gesturekit.viewer.drawn_body`.
        body_model: shows the skin of this body in place of limbs: a `BodyModel`, its .npz file or a
            folder of models; the motion is put on its rig.
        framing: the camera's first view, "whole", "waist" (without the legs) or "face".

    Raises GestureKitError where the player has not been bundled, AudioError where `audio` is no
    sound, FormatError where `body_model` is none or the framing is unknown.
    """
    title = Path(path).stem if title is None else title
    shown = display(motion, audio, title, body_model, body=body, framing=framing)
    write_text(path, shown.page)


def player_shell() -> str:
    """The page without its motion: `{{title}}` and `{{motion}}` are still to be filled in.

    For pages that show several motions in one player.

    Raises GestureKitError where the player has not been bundled.
    """
    return filled(_HERE / "player", {"player": bundled_script(_BUNDLE, "the HTML player")})


def player_data(
    motion: Motion | Mapping[str, Motion],
    audio: Playable | None = None,
    body_model: BodyModel | str | os.PathLike[str] | None = None,
    colours: Mapping[str, str] | None = None,
    body: str | None = None,
    framing: str = "whole",
    compress: bool = False,
) -> str:
    """Return the JSON for `{{motion}}` of `player_shell`; arguments as for `write_html`.

    `compress` makes MP3 of sound of any size. `colours` are those of figures by label, such as
    "#3f7fae"; the player's own for all others. A human body has clothes of its figure's colour.

    Raises AudioError where `audio` is not sound, FormatError where `body_model` is none.
    """
    shown = drawn_bodies(motion, body, body_model)
    page: dict[str, Any] = {
        "format": 1,
        "height": max(drawn.figure.extent for drawn in shown.values()),
        "figures": [_figure(label, drawn.motion, drawn.figure) for label, drawn in shown.items()],
    }
    add_skins(page, list(shown.values()))
    if audio is not None and (wave := as_wave(audio)) is not None:
        data, media_type = encoded(audio, wave, compress)
        spectrum, rate = spectrogram(wave)
        page["speech"] = {
            "duration": wave.duration,
            "rate": OUTLINE_RATE,
            "peaks": _levels(outline(wave)),
            "onsets": _times(onsets(wave)),
            "spectrum": {"bands": BANDS, "rate": rate, "values": _levels(spectrum)},
        }
        page["audio"] = {"type": media_type, "data": base64_text(data)}
    page["below"] = max(drawn.figure.below(framing) for drawn in shown.values())
    motions = motion.values() if isinstance(motion, Mapping) else [motion]
    for figure, given in zip(page["figures"], motions):
        figure["file_joints"] = given.skeleton.n_joints  # a human body has more
        if colours is not None and figure["label"] in colours:
            figure["ink"] = colours[figure["label"]]
            if body == "human" and "skin" in figure:
                figure["skin"]["palette"][list(COLOURS).index("top")] = figure["ink"]
    return script_json(page)


def _figure(label: str, motion: Motion, figure: Figure) -> dict[str, Any]:
    points = figure.points
    root = points[:, :1].astype(np.float32)
    relative = points - root
    step = max(STEP * figure.height, float(np.abs(relative).max()) / 32_767)
    peak = figure.top_speed
    contacts = contact_track(motion)
    head: dict[str, float] | None = None
    if figure.head:
        head = {**dict(zip(("base", "up", "face"), figure.head)), "size": figure.head_size}
    return {
        "label": label,
        "fps": figure.fps,
        "floor": figure.floor,
        "front": figure.front,
        "n_frames": len(points),
        "n_points": points.shape[1],
        "n_joints": motion.skeleton.n_joints,
        "root": base64_text(np.ascontiguousarray(root, "<f4").tobytes()),
        "step": step,
        "points": base64_text(packed(np.rint(relative / step))),
        "limbs": [
            vars(limb) | {"radii": [*map(_short, limb.radii)], "length": _short(limb.length)}
            for limb in figure.limbs
        ],
        "head": head,
        "hands": figure.hands,
        "contacts": None if contacts is None else base64_text(contacts.tobytes()),
        "beats": _times(speed_minima(figure.hand_speed, figure.fps)),
        "speed": {"of": figure.speed_of, "peak": peak, "values": _levels(figure.hand_speed / peak)},
    }


def _short(length: float) -> float:
    """Return a length with four digits."""
    return float(f"{length:.4g}")


def _times(seconds: np.ndarray) -> list[float]:
    return [round(float(second), 3) for second in seconds]


def _levels(values: np.ndarray) -> str:
    """Encode values (N,) from 0 to 1 as bytes in base64."""
    return base64_text(np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8).tobytes())


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
    audio: Playable | None = None,
    title: str = "",
    body_model: BodyModel | str | os.PathLike[str] | None = None,
    height: int = 640,
    body: str | None = None,
    framing: str = "whole",
) -> Display:
    """Return the player of one motion, or of {label: motion}, for a notebook.

    Arguments and errors are those of `write_html`; `height` is in pixels.
    """
    data = player_data(motion, audio, body_model, body=body, framing=framing)
    places = {"title": html.escape(printable(title)), "motion": data}
    return Display(insert(player_shell(), places), int(height))
