"""Measure the strength of styles under guided interpolation and classifier-free guidance.

    python recipes/diffusion_styles/strength.py runs/styles/model styles.jsonl out/ \
        --still normal --lively active --steps 20

Interpolation (eq. 7 of Alexanderson et al. 2023, their Fig. 9): weights 1 - gamma of a still style
and gamma of a lively one, gamma from -0.25 to 1.25; the metric is median wrist speed. Guidance
(eq. 6): one style at a time, gamma from 0 to 2; the metric is the accuracy of a style classifier.

The medians of the styles' recordings are printed first. If the still style has some movement, it
can decrease at gamma = -0.25; if it has none, it cannot.

Motions go to out/interpolation/ and out/guidance/, a folder for each gamma, under the name of a
recording of the lively style, so that the report of

    cd out/interpolation
    gesturekit evaluate gamma_-0.25 recordings/ --compare gamma_+0.00 ... --out report.html

has the violins; the plot of guidance is out/guidance.svg.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from classifier import fit_classifier, styled_recordings, windows

import gesturekit as gk
from gesturekit.corpus.manifest import Manifest
from gesturekit.evaluation import wrist_speed

INTERPOLATION = np.arange(-0.25, 1.26, 0.25)
GUIDANCE = np.arange(0.0, 2.01, 0.5)

Make = Callable[..., list[gk.Motion]]
"""make(folder, style=..., ...): generate motions and save them in that folder."""


def medians(manifest: Manifest) -> dict[str, float]:
    """Return the median wrist speed of each style's recordings in m/s, slowest first."""
    speeds: dict[str, list[np.ndarray]] = {}
    for item in manifest:
        if item.motion is not None and item.style is not None:
            speeds.setdefault(item.style, []).append(wrist_speed(item.load_motion()))
    found = {style: float(np.median(np.concatenate(parts))) for style, parts in speeds.items()}
    return dict(sorted(found.items(), key=lambda pair: pair[1]))


def interpolation(make: Make, still: str, lively: str, out: Path) -> None:
    """Print median and mean wrist speed of interpolations between two styles."""
    print(f"\nfrom {still} to {lively}\ngamma | median wrist speed, m/s | mean")
    for gamma in INTERPOLATION:
        style = f"{still}:{1 - gamma:g},{lively}:{gamma:g}"
        motions = make(out / f"gamma_{gamma:+.2f}", style=style)
        speeds = np.concatenate([wrist_speed(motion) for motion in motions])
        print(f"{gamma:+.2f} | {np.median(speeds):.4f} | {speeds.mean():.3f}", flush=True)


def guidance(make: Make, model, manifest: Manifest, out: Path) -> None:
    """Print and plot the share of windows recognised as their style at each guidance."""
    known = styled_recordings(model, manifest, model.representation.encode)
    classifier, right, _ = fit_classifier(known, len(model.styles))
    chance = 1 / len(model.styles)
    print(f"\nclassifier: {right:.2f} of held-out windows right, chance {chance:.2f}")
    print("gamma | share of windows recognised as their style")
    recognised = np.zeros((len(GUIDANCE), len(model.styles)))
    for row, gamma in zip(recognised, GUIDANCE, strict=True):
        for number, style in enumerate(model.styles):
            folder = out / f"gamma_{gamma:.2f}" / style
            motions = make(folder, style=style, guidance=float(gamma))
            styles = np.concatenate([classifier(windows(motion)) for motion in motions])
            row[number] = (styles == number).mean()
        print(f"{gamma:.2f} | {row.mean():.2f}", flush=True)
    plot(recognised, model.styles, right, out.with_suffix(".svg"))


def plot(recognised: np.ndarray, styles: Sequence[str], right: float, file: Path) -> None:
    """Plot the shares (guidance, styles) of recognised windows, and that of the recordings."""
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    place = -1.0
    for number in np.argsort(recognised[-1], kind="stable"):
        colour = plt.get_cmap("tab20")(number)
        axes.plot(GUIDANCE, recognised[:, number], color=colour, lw=1)
        place = max(recognised[-1, number], place + 0.045)  # names do not lie on one another
        axes.text(GUIDANCE[-1] + 0.03, place, styles[number], color=colour, fontsize=8, va="center")
    axes.plot(
        GUIDANCE, recognised.mean(axis=1), "o-", color="0.15", lw=2.5, label="mean of the styles"
    )
    axes.axhline(right, color="0.4", ls="--", label="held-out windows of the recordings")
    axes.axhline(1 / len(styles), color="0.7", ls=":", label="chance")
    axes.set_xlabel("guidance, gamma")
    axes.set_ylabel("share of windows recognised as their style")
    axes.set_ylim(0, 1.04)
    axes.set_xticks(GUIDANCE)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    figure.savefig(file)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model")
    parser.add_argument("corpus", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--still", required=True, help="style at gamma = 0")
    parser.add_argument("--lively", required=True, help="style at gamma = 1")
    parser.add_argument("--only", choices=["interpolation", "guidance"])
    parser.add_argument("--samples", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--steps", type=int, help="denoising steps; all by default")
    asked = parser.parse_args(arguments)
    model = gk.load(asked.model)
    manifest = Manifest.load(asked.corpus)
    speeds = ", ".join(f"{style} {speed:.3f}" for style, speed in medians(manifest).items())
    print(f"recordings, median wrist speed, m/s: {speeds}")
    stem = next(item.motion.stem for item in manifest if item.motion and item.style == asked.lively)

    def make(folder: Path, **controls) -> list[gk.Motion]:
        motions = model.generate(
            seconds=asked.seconds,
            samples=asked.samples,
            batch=5,
            steps=asked.steps,
            fps=model.fps,
            **controls,
        )
        motions = motions if isinstance(motions, list) else [motions]
        folder.mkdir(parents=True, exist_ok=True)
        for number, motion in enumerate(motions, start=1):
            motion.save(folder / f"{stem}_s{number}.npz")
        return motions

    if asked.only != "guidance":
        interpolation(make, asked.still, asked.lively, asked.out / "interpolation")
    if asked.only != "interpolation":
        guidance(make, model, manifest, asked.out / "guidance")


if __name__ == "__main__":
    main()
