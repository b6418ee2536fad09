"""Is a motion of the style that was asked for? And which level decides what?

    python recipes/multires_labels/recognise.py runs/styles/model styles.jsonl

First table: by style, samples of which a classifier hears that style in most windows, and the share
of their windows; beside it how much of the style's recordings comes up (patches as GANimator
measures them), how much of them their own mean pose covers, and how far the samples' patches are
from the nearest recorded ones: copies would be near 0.

Second table: the coarse levels in one style, the fine ones in another, all pairs. How many have
their mean posture nearest to the coarse style's, and how strong is what moves faster than 3 Hz:
r over pairs with that of the recordings of the coarse style, and of the fine one.

The classifier is that of `recipes/diffusion_styles`: a ridge regression of means and
spreads over 1.5 s.
"""

from __future__ import annotations

import argparse
import sys
from itertools import permutations
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt

import gesturekit as gk
from gesturekit.corpus.manifest import Manifest
from gesturekit.evaluation import coverage, patch_features, patch_scores
from gesturekit.motion.heading import heading

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "diffusion_styles"))
from classifier import fit_classifier, styled_recordings, windows

HERTZ = 3.0


def places(motion: gk.Motion) -> np.ndarray:
    """(T, J, 3) joints about the root, m."""
    positions = motion.positions()
    return positions - positions[:, :1]


def mean_pose(model, motion: gk.Motion) -> gk.Motion:
    """A motion's mean pose, held for two seconds."""
    values = model.representation.encode(motion)
    frozen = np.repeat(values.mean(0)[None], round(2 * motion.fps), 0)
    return model.representation.decode(frozen, motion.fps)


def fast(motion: gk.Motion) -> float:
    """RMS of what moves faster than 3 Hz, over frames and joints, cm."""
    above = butter(4, HERTZ, "high", fs=motion.fps, output="sos")
    moved = sosfiltfilt(above, places(motion), axis=0)
    return 100 * float(np.sqrt(np.square(moved).sum(-1).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model")
    parser.add_argument("corpus", type=Path)
    parser.add_argument("--samples", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--coarse", type=int, default=4, help="levels of the coarse style")
    parser.add_argument("--foot-lock", action="store_true", help="the recordings have none")
    asked = parser.parse_args()
    model = gk.load(asked.model)
    known = styled_recordings(
        model,
        Manifest.load(asked.corpus),
        lambda motion: model.representation.encode(motion, turn=-heading(motion)),
    )
    count = len(model.styles)
    classifier, right, held = fit_classifier(known, count)
    print(f"classifier: {right:.2f} of {held} held-out windows right, chance {1 / count:.2f}\n")

    print("style | samples | windows | coverage | of the mean pose | local diversity")
    totals = []
    for number, style in enumerate(model.styles):
        own = [patch_features(r.motion) for r in known if r.style == number]
        shares, covered, near = [], [], []
        for seed in range(asked.samples):
            motion = model.generate(
                seconds=asked.seconds, style=style, seed=seed, foot_lock=asked.foot_lock
            )
            heard = classifier(windows(motion))
            shares.append((float((heard == number).mean()), np.bincount(heard).argmax() == number))
            scores = [patch_scores(patch_features(motion), reference) for reference in own]
            covered.append(np.mean([score.coverage for score in scores]))
            near.append(min(score.local_diversity for score in scores))
        still = [
            coverage(patch_features(mean_pose(model, r.motion)), patch_features(r.motion))
            for r in known
            if r.style == number
        ]
        share, told = np.mean(shares, axis=0)
        totals.append((told, share, np.mean(covered), np.mean(still), np.mean(near)))
        print(style, *(f"{value:.2f}" for value in totals[-1]), sep=" | ", flush=True)
    print("mean", *(f"{value:.2f}" for value in np.mean(totals, axis=0)), sep=" | ")

    by_style = [[r.motion for r in known if r.style == number] for number in range(count)]
    posture = np.array([np.concatenate([places(m) for m in ms]).mean(0) for ms in by_style])
    energy = np.array([np.mean([fast(m) for m in ms]) for ms in by_style])
    last = model.network_config.levels
    split = asked.coarse
    print(f"\nlevels 1-{split} (rows), {split + 1}-{last} (columns); over {HERTZ:g} Hz, cm RMS")
    print("", *model.styles, "recordings", sep=" | ")
    made = np.full((count, count), np.nan)
    nearest = []
    for coarse in range(count):
        for fine in range(count):
            told = f"1-{split}={model.styles[coarse]},{split + 1}-{last}={model.styles[fine]}"
            motions = [
                model.generate(
                    seconds=asked.seconds, level_style=told, seed=seed, foot_lock=asked.foot_lock
                )
                for seed in range(3)
            ]
            made[coarse, fine] = np.mean([fast(motion) for motion in motions])
            if fine != coarse:
                mean = np.mean([places(motion).mean(0) for motion in motions], axis=0)
                apart = np.linalg.norm(posture - mean, axis=-1).mean(-1)
                nearest.append((int(apart.argmin()) == coarse, int(apart.argmin()) == fine))
        row = [f"{value:.3f}" for value in made[coarse]]
        print(model.styles[coarse], *row, f"{energy[coarse]:.3f}", sep=" | ", flush=True)
    pairs = np.array(list(permutations(range(count), 2)))
    mixed = np.log(made[pairs[:, 0], pairs[:, 1]])
    told = [np.corrcoef(mixed, np.log(energy[side]))[0, 1] for side in pairs.T]
    posed = np.sum(nearest, axis=0)
    print(
        f"mean posture nearest to the coarse style's in {posed[0]} of {len(nearest)} pairs, to the "
        f"fine one's in {posed[1]}\n"
        f"over {HERTZ:g} Hz: r {told[0]:.2f} with the coarse style's own, {told[1]:.2f} with the "
        "fine one's"
    )


if __name__ == "__main__":
    main()
