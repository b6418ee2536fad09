"""The moving picture in README.md: python docs/moving_picture.py FILE.webp   (or: make picture)."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import audio_features as af
import gesturekit as gk
from audio_features.atomic import atomic_write
from gesturekit.evaluation import arm_speed
from gesturekit.evaluation.metrics.sync import speech_envelope
from gesturekit.motion import Motion
from gesturekit.systems import bundled_speech
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.human import TOPS
from gesturekit.viewer.scene import Scene
from gesturekit.viewer.video import write_caption

WIDTH, HEIGHT, STRIP = 800, 340, 80
"""Pixels of the picture's width, of the part with the body, and of the curves below it."""
FPS = 15.0
SECONDS = 8.0
SEEDS = {k: "#{:02x}{:02x}{:02x}".format(*TOPS[k]) for k in range(2)}
"""A body for each seed, and the colour of its clothes and arm speed."""
GREY, INK = "#c8d2da", (36, 41, 47)


def curves(motions: dict[int, Motion], wave: af.Wave) -> np.ndarray:
    """Return (STRIP, WIDTH, 3) uint8: arm speeds over the energy of the speech."""
    figure = Figure(figsize=(WIDTH / 100, STRIP / 100), dpi=100, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    first = motions[0]
    time = np.arange(first.n_frames) / first.fps
    energy = speech_envelope(wave, first.fps, first.n_frames)
    energy = (energy - energy.min()) / np.ptp(energy)
    axes.fill_between(time, 0, energy, color=GREY, linewidth=0, label="energy of the speech")
    speeds = {seed: arm_speed(motion) for seed, motion in motions.items()}
    top = max(speed.max() for speed in speeds.values())
    for seed, speed in speeds.items():
        axes.plot(
            time, speed / top, color=SEEDS[seed], linewidth=1.8, label=f"arm speed, seed {seed}"
        )
    axes.set(xlim=(0, SECONDS), ylim=(0, 1.3))
    axes.legend(loc="upper left", fontsize=8, frameon=False, ncols=3, borderaxespad=0)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def frames() -> list[Image.Image]:
    """Return pictures of the demo model's motion to the bundled speech, FPS a second."""
    model, wave = gk.load("demo"), af.Wave.load(bundled_speech())
    # With seed 0 the motion of `gesturekit demo`, for which the name of the file counts.
    text = bundled_speech().with_suffix(".txt").read_text("utf-8")
    how = {"item": bundled_speech().stem, "face": "phones", "transcript": text}
    made = {seed: model.generate(wave, seed=seed, **how) for seed in SEEDS}
    motions = {seed: motion[: round(SECONDS * motion.fps)] for seed, motion in made.items()}
    panel = WIDTH // len(SEEDS)
    scenes = [
        Scene(DrawnBody.of(motion, "human"), panel / HEIGHT, index=k, framing="waist")
        for k, motion in enumerate(motions.values())
    ]
    strip = curves(motions, wave)
    images = []
    for k in range(round(SECONDS * FPS)):
        bodies = np.empty((len(scenes), HEIGHT, panel, 3), np.uint8)
        for seed, scene, image in zip(SEEDS, scenes, bodies):
            scene.draw(k / FPS, image)
            write_caption(image, f"seed {seed}", (20, 14), 15)
        below = strip.copy()
        at = round(k / FPS / SECONDS * WIDTH)
        below[:, at : at + 2] = INK
        images.append(Image.fromarray(np.concatenate([np.concatenate(bodies, axis=1), below])))
    return images


def write(file: Path) -> None:
    """Write an animated WebP that repeats."""
    first, *others = frames()
    how = {"duration": round(1000 / FPS), "loop": 0, "quality": 45, "method": 5}
    with atomic_write(file) as part:
        first.save(part, "WEBP", save_all=True, append_images=others, **how)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
