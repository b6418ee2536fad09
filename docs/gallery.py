"""Clips of the bundled model on one page: python docs/gallery.py FOLDER   (or: make gallery)."""

from __future__ import annotations

import html
import sys
from pathlib import Path

import gesturekit as gk
from gesturekit.atomic import atomic_write

SPEECH = Path(gk.__file__).parent / "models" / "demo" / "speech.wav"
CLIPS = {
    **{f"The bundled speech, seed {seed}": {"speech": SPEECH, "seed": seed} for seed in range(4)},
    "Without speech": {"seconds": 10.0},
}
PAGE = """<!doctype html>
<meta charset="utf-8">
<title>gesturekit: gallery</title>
<style>body {{ font-family: sans-serif; max-width: 60rem; margin: 2rem auto; }}
img {{ width: 100%; }}</style>
<h1>The bundled model</h1>
<p>A click opens a clip with its sound.</p>
{clips}
"""


def make(folder: Path) -> Path:
    """Write every clip as a page and a picture, and index.html, which is returned."""
    folder.mkdir(parents=True, exist_ok=True)
    model, shown = gk.load("demo"), []
    for number, (title, controls) in enumerate(CLIPS.items()):
        motion = model.generate(**controls)
        for suffix in ("html", "png"):
            motion.save(folder / f"{number}.{suffix}", audio=controls.get("speech"))
        name = html.escape(title)
        shown.append(
            f'<h2>{name}</h2><a href="{number}.html"><img src="{number}.png" alt="{name}"></a>'
        )
    with atomic_write(folder / "index.html") as part:
        part.write_text(PAGE.format(clips="\n".join(shown)), encoding="utf-8")
    return folder / "index.html"


if __name__ == "__main__":
    print(make(Path(sys.argv[1])))
