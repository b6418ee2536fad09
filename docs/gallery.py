"""Clips of the bundled model on one page: python docs/gallery.py FOLDER   (or: make gallery)."""

from __future__ import annotations

import html
import sys
from pathlib import Path
from typing import Any

import gesturekit as gk
from audio_features.atomic import atomic_write
from gesturekit.systems import bundled_speech
from gesturekit.viewer import write_picture

CLIPS: dict[str, dict[str, Any]] = {
    "The bundled speech, seed 0": {"speech": bundled_speech(), "seed": 0},
    "The same speech, seed 1": {"speech": bundled_speech(), "seed": 1},
    "Calmer: liveliness 0.5": {"speech": bundled_speech(), "liveliness": 0.5},
    "Livelier: liveliness 1.5": {"speech": bundled_speech(), "liveliness": 1.5},
    "Seed 1 with the state of movement of seed 0": {
        "speech": bundled_speech(),
        "seed": 1,
        "mood_seed": 0,
    },
    "Without speech: idle motion": {"seconds": 10.0},
}
"""Titles of the clips and the arguments of `Model.generate`."""
PAGE = """<!doctype html>
<meta charset="utf-8">
<title>gesturekit: gallery</title>
<style>body {{ font-family: sans-serif; max-width: 60rem; margin: 2rem auto; }}
img {{ width: 100%; }}</style>
<h1>The bundled model</h1>
<p>A click opens a clip with its sound.</p>
{clips}
"""


def write_clips(folder: Path) -> None:
    """Write each clip as a player, NUMBER.html, and as a picture, NUMBER.png."""
    folder.mkdir(parents=True, exist_ok=True)
    model = gk.load("demo")
    for number, (title, controls) in enumerate(CLIPS.items()):
        motion, speech = model.generate(**controls), controls.get("speech")
        motion.save(folder / f"{number}.html", audio=speech, title=title)
        write_picture(motion, folder / f"{number}.png", speech, title="")


def markdown(folder: str) -> str:
    """Return the page of the documentation, whose clips lie in `folder`."""
    lines = ["# Gallery", "", "Clips of the bundled model. A click opens a clip with its sound."]
    for number, title in enumerate(CLIPS):
        picture = f"![{title}]({folder}/{number}.png)"
        lines += ["", f"## {title}", "", f"[{picture}]({folder}/{number}.html)"]
    return "\n".join(lines) + "\n"


def make(folder: Path) -> Path:
    """Write the clips and index.html, which is returned."""
    write_clips(folder)
    shown = (
        f'<h2>{html.escape(title)}</h2>\n<a href="{number}.html">'
        f'<img src="{number}.png" alt="{html.escape(title)}"></a>'
        for number, title in enumerate(CLIPS)
    )
    with atomic_write(folder / "index.html") as part:
        part.write_text(PAGE.format(clips="\n".join(shown)), encoding="utf-8")
    return folder / "index.html"


if __name__ == "__main__":
    print(make(Path(sys.argv[1])))
