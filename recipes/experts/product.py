"""Interpolate between two models, and change from one to the other, in products of experts.

    python recipes/experts/product.py runs/calm/model runs/lively/model demo-corpus/demo.wav out/ \
        --recordings calm.jsonl lively.jsonl

Weights 1 - gamma of the first model and gamma of the second (eq. 8 of Alexanderson et al. 2023),
and a transition: the first model until the middle of the speech, then the second. Prints wrist
speeds, and writes OUT/product.png and the motions, with pages that play them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import gaussian_filter1d

import gesturekit as gk
from audio_features import Wave
from gesturekit.corpus import Manifest
from gesturekit.evaluation import wrist_speed

GAMMAS = (0.0, 0.25, 0.5, 0.75, 1.0)
ORANGE, BLUE = "#c65d2e", "#3b7dae"
SMOOTHING = 0.3
"""Standard deviation of the Gaussian that the plotted speed is smoothed with, seconds."""


def mean_curve(motions: Sequence[gk.Motion]) -> np.ndarray:
    """Return the mean wrist speed (T - 1,) of several motions, smoothed."""
    mean = np.mean([wrist_speed(motion) for motion in motions], axis=0)
    return gaussian_filter1d(mean, SMOOTHING * motions[0].fps)


def quantiles(speeds: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the median and the 90 % quantile of wrist speeds, m/s."""
    middle, fast = np.quantile(np.concatenate(speeds), (0.5, 0.9))
    return float(middle), float(fast)


def recorded(manifest: Path) -> tuple[float, float]:
    """Return the `quantiles` of a corpus."""
    items = [item for item in Manifest.load(manifest) if item.motion is not None]
    return quantiles([wrist_speed(item.load_motion()) for item in items])


def plot(
    found: dict[float, tuple[float, float]],
    known: Sequence[tuple[float, float]],
    curves: dict[str, np.ndarray],
    fps: float,
    file: Path,
) -> None:
    """Plot speed by gamma beside that of the recordings, and mean speeds (T,) over time."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained", sharey=True)
    for k, (name, colour) in enumerate((("median", BLUE), ("90 % quantile", ORANGE))):
        left.plot(list(found), [both[k] for both in found.values()], "o-", color=colour, label=name)
        for gamma, both in zip((0.0, 1.0), known):
            left.plot(gamma, both[k], "_", color=colour, ms=20, mew=2)
    left.set_xlabel("weight of the second model (bars: each model's recordings)")
    left.set_ylabel("wrist speed, m/s")
    left.legend(frameon=False, fontsize=8)
    for (name, speed), colour in zip(curves.items(), ("#9db8cc", "#e0b29b", "0.15")):
        time = np.arange(len(speed)) / fps
        right.plot(time, speed, color=colour, label=name)
    right.axvline(time[-1] / 2, color="0.6", ls="--", lw=1)
    right.set_xlabel("seconds (mean of the samples, smoothed)")
    right.set_ylim(bottom=0)
    right.legend(frameon=False, fontsize=8, loc="upper left")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(file, dpi=110)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("first", help="model")
    parser.add_argument("second", help="model with the motion vectors of the first (moves_like)")
    parser.add_argument("speech", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--recordings", type=Path, nargs=2, default=(), help="the two corpora")
    parser.add_argument("--samples", type=int, default=8)
    parser.add_argument("--steps", type=int, default=12)
    given = parser.parse_args(arguments)

    first, second = gk.load(given.first), gk.load(given.second)
    seconds = Wave.load(given.speech).duration
    given.out.mkdir(parents=True, exist_ok=True)

    def make(name: str, weight: float | str) -> list[gk.Motion]:
        how = {"seed": 0, "samples": given.samples, "steps": given.steps}
        motions = first.generate(given.speech, experts=[(second, weight)], **how)
        motions = motions if isinstance(motions, list) else [motions]
        motions[0].save(given.out / f"{name}.bvh")
        motions[0].save(given.out / f"{name}.html", audio=given.speech)
        return motions

    known = [recorded(manifest) for manifest in given.recordings]
    for manifest, (middle, fast) in zip(given.recordings, known):
        print(f"recordings of {manifest.stem}: median {middle:.2f} m/s, 90 % quantile {fast:.2f}")
    found, curves = {}, {}
    for gamma in GAMMAS:
        motions = make(f"gamma_{gamma:.2f}", gamma)
        found[gamma] = quantiles([wrist_speed(motion) for motion in motions])
        middle, fast = found[gamma]
        print(f"gamma {gamma:.2f}: median {middle:.2f} m/s, 90 % quantile {fast:.2f}", flush=True)
        if gamma in (0.0, 1.0):
            curves["second model" if gamma else "first model"] = mean_curve(motions)
    motions = make("transition", f"0@0-{seconds / 2:.2f},1@{seconds / 2:.2f}-{seconds + 1:.2f}")
    curves["transition"] = mean_curve(motions)
    half = len(curves["transition"]) // 2
    for name, span in (("before", slice(0, half)), ("after", slice(half, None))):
        middle, fast = quantiles([wrist_speed(motion)[span] for motion in motions])
        print(f"transition, {name}: median {middle:.2f} m/s, 90 % quantile {fast:.2f}")
    plot(found, known, curves, motions[0].fps, given.out / "product.png")


if __name__ == "__main__":
    main()
