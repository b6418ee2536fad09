"""Pictures of the documentation, computed by gesturekit: python docs/pictures.py FOLDER."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

import audio_features as af
import gesturekit as gk
from gesturekit.diffusion.conditions import weight_track
from gesturekit.evaluation import arm_speed
from gesturekit.evaluation.metrics.sync import speech_envelope
from gesturekit.motion import Motion
from gesturekit.systems import bundled_speech

ORANGE, BLUE, GREY, INK = "#c65d2e", "#3b7dae", "#c8d2da", "#24292f"


@cache
def _demo(seed: int) -> Motion:
    return gk.load("demo").generate(bundled_speech(), seed=seed)


def _axes(width: float, height: float, rows: int = 1) -> tuple[Figure, list]:
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, 1, squeeze=False)[:, 0]
    for one in axes:
        one.spines[["top", "right"]].set_visible(False)
        one.tick_params(labelsize=8, colors=INK)
    return figure, list(axes)


def pyramid(file: Path) -> None:
    """Draw one angle of the demo motion at four levels, with the detail that each adds."""
    motion = _demo(0)
    joint = motion.skeleton.index("LeftForeArm")
    angle = np.degrees(2 * np.arccos(np.clip(np.abs(motion.rotations[:, joint, 3]), 0, 1)))
    lengths = af.level_lengths(len(angle), levels=10)
    figure, axes = _axes(8, 5.2, 4)
    before = np.full(len(angle), np.nan)
    for one, level in zip(axes, (1, 4, 7, 10)):
        coarse = af.resample_frames(angle[:, None], lengths[level - 1])
        shown = af.resample_frames(coarse, len(angle))[:, 0]
        time = np.arange(len(angle)) / motion.fps
        one.fill_between(time, before, shown, color=GREY, linewidth=0)
        one.plot(time, shown, color=ORANGE, linewidth=1.6)
        n = lengths[level - 1]
        frames = ((np.arange(n) + 0.5) * len(angle) / n - 0.5) / motion.fps
        if level < 10:
            one.plot(frames, coarse[:, 0], ".", color=ORANGE, markersize=5)
        one.set_title(
            f"level {level}: {lengths[level - 1]} frames", loc="left", fontsize=9, color=INK
        )
        one.set_ylabel("elbow, °", fontsize=8)
        before = shown
    axes[-1].set_xlabel("seconds; grey: detail added since the level above", fontsize=8)
    figure.savefig(file, format="png", dpi=110)


def alternation(file: Path) -> None:
    """Draw the steps of an iteration and the data of each."""
    figure, (axes,) = _axes(8, 2.6)
    axes.set_axis_off()
    axes.set(xlim=(0, 100), ylim=(0, 34))
    steps = (
        (1, 38, GREY, "discriminator step", "recorded motion is real,\ngenerated motion is not"),
        (
            41,
            27,
            BLUE,
            "random step",
            "speech alone, random noise\nloss: discriminator, contacts, …",
        ),
        (
            70,
            29,
            ORANGE,
            "reconstruction step",
            "speech with its motion, fixed noise z*\nloss: recording",
        ),
    )
    for left, width, color, name, text in steps:
        style = "round,pad=0.4,rounding_size=1.5"
        axes.add_patch(FancyBboxPatch((left, 8), width - 2, 18, boxstyle=style, color=color))
        ink = INK if color == GREY else "white"
        axes.text(
            left + width / 2 - 1, 21, name, ha="center", fontsize=10, color=ink, weight="bold"
        )
        axes.text(left + width / 2 - 1, 12.5, text, ha="center", va="center", fontsize=8, color=ink)
    axes.annotate("", (99, 3), (1, 3), arrowprops={"arrowstyle": "->", "color": INK})
    axes.text(50, -0.5, "one iteration of a stage (two levels), repeated", ha="center", fontsize=8)
    axes.text(1, 30, "in the paper: five times", fontsize=8, color=INK)
    figure.savefig(file, format="png", dpi=110)


def state(file: Path) -> None:
    """Draw arm speed of the demo with two seeds over the energy of the speech."""
    wave = af.Wave.load(bundled_speech())
    figure, (axes,) = _axes(8, 2.6)
    for seed, color in enumerate((BLUE, ORANGE)):
        motion = _demo(seed)
        time = np.arange(motion.n_frames) / motion.fps
        axes.plot(time, arm_speed(motion), color=color, linewidth=1.4, label=f"seed {seed}")
    energy = speech_envelope(wave, motion.fps, motion.n_frames)
    top = axes.get_ylim()[1]
    energy = (energy - energy.min()) / np.ptp(energy) * top
    axes.fill_between(
        time, 0, energy, color=GREY, linewidth=0, zorder=0, label="energy of the speech"
    )
    axes.set(xlim=(0, time[-1]), ylim=(0, top))
    axes.set_xlabel("seconds", fontsize=8)
    axes.set_ylabel("arm speed, rad/s", fontsize=8)
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="lower left", bbox_to_anchor=(0, 1))
    figure.savefig(file, format="png", dpi=110)


def guidance(file: Path) -> None:
    """Draw two Gaussian experts, and their weighted product for four strengths.

    Densities p0^(1-γ) p1^γ, whose scores are the weighted sums of the experts' scores.
    """
    x = np.linspace(-4, 7, 800)
    means, deviations = (0.0, 2.0), (1.2, 0.9)
    figure, (axes,) = _axes(8, 2.6)
    logs = [-0.5 * ((x - m) / s) ** 2 for m, s in zip(means, deviations)]
    for gamma, alpha in ((0.0, 0.35), (0.5, 0.55), (1.0, 0.8), (1.5, 1.0)):
        density = np.exp((1 - gamma) * logs[0] + gamma * logs[1])
        density /= np.trapezoid(density, x)
        axes.plot(x, density, color=ORANGE, alpha=alpha, linewidth=1.8)
        at = int(density.argmax())
        axes.text(x[at], density[at] + 0.02, f"γ = {gamma:g}", ha="center", fontsize=8, color=INK)
    axes.set_yticks([])
    axes.set_ylim(0, 0.75)
    axes.set_xticks(means, ["without the style", "with the style"], fontsize=8)
    figure.savefig(file, format="png", dpi=110)


def experts(file: Path) -> None:
    """Draw the weights of two experts over time."""
    other = weight_track("0.2@0-10,0.8@10-20", 600, 30.0)
    figure, (axes,) = _axes(8, 2.2)
    time = np.arange(600) / 30.0
    axes.plot(time, other, color=ORANGE, linewidth=1.8, label="OTHER")
    axes.plot(time, 1 - other, color=BLUE, linewidth=1.8, label="the model itself")
    axes.set(xlim=(0, 20), ylim=(0, 1.05))
    axes.set_xlabel("seconds", fontsize=8)
    axes.set_ylabel("weight", fontsize=8)
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(file, format="png", dpi=110)


PICTURES: dict[str, Callable[[Path], None]] = {
    "pyramid": pyramid,
    "alternation": alternation,
    "state": state,
    "guidance": guidance,
    "experts": experts,
}


def write_pictures(folder: Path) -> None:
    """Write all pictures as PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in PICTURES.items():
        draw(folder / f"{name}.png")


if __name__ == "__main__":
    write_pictures(Path(sys.argv[1]))
