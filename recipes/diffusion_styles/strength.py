"""How strong is a style? Guided interpolation and guidance, as motion and as numbers.

    python recipes/diffusion_styles/strength.py runs/styles/model styles.jsonl out/ --still tired \
        --lively active

Interpolation (eq. 7 of Alexanderson et al. 2023, their Fig. 9): weights 1 - gamma of the still
style and gamma of the lively one, gamma from -0.25 to 1.25; the median of wrist speed. Guidance
(eq. 6): gamma from 0 to 2 of one style at a time; how often a classifier hears that style in it.
Motions go to out/interpolation/ and out/guidance/, a folder for each gamma, under the name of a
recording of the lively style, so that the report of

    cd out/interpolation
    gesturekit evaluate gamma_-0.25 recordings/ gamma_+0.00 ... --compare --out report.html

has the violins. The classifier is a ridge regression onto styles of means and spreads over
windows of 1.5 s of the corpus's recordings; the table begins with how it does on windows of
recordings that it was not made from.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import gesturekit as gk
from gesturekit.corpus.manifest import Manifest
from gesturekit.evaluation import wrist_speed

WINDOW_SECONDS = 1.5
RIDGE = 30.0


def windows(motion: gk.Motion) -> np.ndarray:
    """(W, F): means and spreads of places about the root, half a window apart."""
    places = motion.positions()
    places = (places - places[:, :1]).reshape(len(places), -1)
    size = round(WINDOW_SECONDS * motion.fps)
    parts = [places[i : i + size] for i in range(0, len(places) - size + 1, size // 2)]
    steps = [np.abs(np.diff(part, axis=0)) for part in parts]
    return np.array(
        [
            np.concatenate([part.mean(0), part.std(0), step.mean(0)])
            for part, step in zip(parts, steps, strict=True)
        ]
    )


class Classifier:
    """Ridge regression from standardised windows onto one-hot styles."""

    def __init__(self, features: np.ndarray, styles: np.ndarray, count: int) -> None:
        self.mean, self.scale = features.mean(0), features.std(0) + 1e-6
        x = self._prepared(features)
        target = np.eye(count)[styles]
        self.weights = np.linalg.solve(x.T @ x + RIDGE * np.eye(x.shape[1]), x.T @ target)

    def _prepared(self, features: np.ndarray) -> np.ndarray:
        x = (features - self.mean) / self.scale
        return np.concatenate([x, np.ones((len(x), 1))], axis=1)

    def __call__(self, features: np.ndarray) -> np.ndarray:
        return (self._prepared(features) @ self.weights).argmax(1)


def fit_classifier(model, manifest: Manifest) -> tuple[Classifier, float]:
    """The classifier of the model's styles, and the share of held-out windows it gets right."""
    found, labels = [], []
    for item in manifest:
        if item.motion is not None and item.style in model.styles:
            # As the model would write it: the same joints move, and it faces the same way.
            motion = item.load_motion().resample(model.fps)
            values = model.representation.encode(motion)
            motion = model.representation.decode(values, model.fps)
            found.append(windows(motion))
            labels.append(np.full(len(found[-1]), model.styles.index(item.style)))
    features, styles = np.concatenate(found), np.concatenate(labels)
    held = np.concatenate([np.arange(len(part)) >= 0.75 * len(part) for part in found])
    count = len(model.styles)
    right = Classifier(features[~held], styles[~held], count)(features[held]) == styles[held]
    return Classifier(features, styles, count), float(right.mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model")
    parser.add_argument("corpus", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--still", required=True)
    parser.add_argument("--lively", required=True)
    parser.add_argument("--samples", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--steps", type=int, help="denoising steps; all by default")
    asked = parser.parse_args()
    model = gk.load(asked.model)
    manifest = Manifest.load(asked.corpus)
    stem = next(item.motion.stem for item in manifest if item.motion and item.style == asked.lively)

    def made(folder: Path, **told) -> list[gk.Motion]:
        motions = model.generate(
            seconds=asked.seconds, samples=asked.samples, batch=asked.samples, steps=asked.steps,
            seed=0, **told,
        )  # fmt: skip
        folder.mkdir(parents=True, exist_ok=True)
        for number, motion in enumerate(motions, start=1):
            motion.save(folder / f"{stem}_s{number}.npz")
        return motions

    print("gamma | median wrist speed, m/s | mean")
    for gamma in np.arange(-0.25, 1.26, 0.25):
        style = f"{asked.still}:{1 - gamma:g},{asked.lively}:{gamma:g}"
        motions = made(asked.out / "interpolation" / f"gamma_{gamma:+.2f}", style=style)
        speeds = np.concatenate([wrist_speed(motion) for motion in motions])
        print(f"{gamma:+.2f} | {np.median(speeds):.3f} | {speeds.mean():.3f}", flush=True)

    classifier, right = fit_classifier(model, manifest)
    print(
        f"\nclassifier: {right:.2f} of held-out windows right, chance {1 / len(model.styles):.2f}"
    )
    print("gamma | share of windows heard as their style")
    for gamma in np.arange(0.0, 2.01, 0.5):
        shares = []
        for number, style in enumerate(model.styles):
            folder = asked.out / "guidance" / f"gamma_{gamma:.2f}" / style
            motions = made(folder, style=style, guidance=float(gamma))
            heard = np.concatenate([classifier(windows(motion)) for motion in motions])
            shares.append(float((heard == number).mean()))
        print(f"{gamma:.2f} | {np.mean(shares):.2f}", flush=True)


if __name__ == "__main__":
    main()
