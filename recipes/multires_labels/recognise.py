"""Is a motion of the style that was asked for? And which level decides what?

    python recipes/multires_labels/recognise.py runs/styles/model styles.jsonl

First table: by style, samples of which a classifier hears that style in most windows, and the share
of their windows; beside it how much of the style's recordings comes up (patches as GANimator
measures them), how much of them their own mean pose covers, how far the samples' patches are
from the nearest recorded ones (copies would be near 0), and jerk, as a ratio to the recordings'.

Second table: the coarse levels in one style, the fine ones in another, all pairs: how strong is
what is too fast for the coarse levels (over half their frame rate). Below it how many have their
mean posture nearest to the coarse style's, how far poses are from the nearest recorded one (broken
ones are far), and r over pairs of the logarithm of what is fast with that of the recordings of the
coarse style, and of the fine one, for this frequency and for some above it.

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
from scipy.spatial import cKDTree

import gesturekit as gk
from gesturekit.corpus.manifest import Manifest
from gesturekit.evaluation import coverage, jerk, patch_features, patch_scores
from gesturekit.motion.root_path import heading

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "diffusion_styles"))
from classifier import fit_classifier, styled_recordings, windows

STEPS = (1.0, 1.25, 1.5)
"""Times half the frame rate of the coarse levels: over which frequencies r is given."""


def places(motion: gk.Motion) -> np.ndarray:
    """(T, J, 3) joints about the root, m."""
    positions = motion.positions()
    return positions - positions[:, :1]


def mean_pose(model, motion: gk.Motion) -> gk.Motion:
    """A motion's mean pose, held for two seconds."""
    values = model.representation.encode(motion)
    frozen = np.repeat(values.mean(0)[None], round(2 * motion.fps), 0)
    return model.representation.decode(frozen, motion.fps)


def poses(motion: gk.Motion) -> np.ndarray:
    """(T, 3 J) such that a distance is the RMS over joints, cm."""
    seen = places(motion)
    return 100 * seen.reshape(len(seen), -1) / seen.shape[1] ** 0.5


def fast(motion: gk.Motion, hertz: list[float]) -> np.ndarray:
    """RMS of what moves faster than each of these frequencies, over frames and joints, cm."""
    strengths = []
    for limit in hertz:
        above = butter(4, limit, "high", fs=motion.fps, output="sos")
        moved = sosfiltfilt(above, places(motion), axis=0)
        strengths.append(100 * np.sqrt(np.square(moved).sum(-1).mean()))
    return np.array(strengths)


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

    print("style | samples | windows | coverage | of the mean pose | local diversity | jerk")
    totals = []
    for number, style in enumerate(model.styles):
        own = [patch_features(r.motion) for r in known if r.style == number]
        shares, covered, near, jerks = [], [], [], []
        for seed in range(asked.samples):
            motion = model.generate(
                seconds=asked.seconds,
                style=style,
                seed=seed,
                foot_lock=asked.foot_lock,
                fps=model.fps,
            )
            heard = classifier(windows(motion))
            shares.append((float((heard == number).mean()), np.bincount(heard).argmax() == number))
            scores = [patch_scores(patch_features(motion), reference) for reference in own]
            covered.append(np.mean([score.coverage for score in scores]))
            near.append(min(score.local_diversity for score in scores))
            jerks.append(jerk(motion))
        recorded = np.mean([jerk(r.motion) for r in known if r.style == number])
        still = [
            coverage(patch_features(mean_pose(model, r.motion)), patch_features(r.motion))
            for r in known
            if r.style == number
        ]
        share, told = np.mean(shares, axis=0)
        rest = (np.mean(values) for values in (covered, still, near))
        totals.append((told, share, *rest, np.mean(jerks) / recorded))
        print(style, *(f"{value:.2f}" for value in totals[-1]), sep=" | ", flush=True)
    print("mean", *(f"{value:.2f}" for value in np.mean(totals, axis=0)), sep=" | ")

    by_style = [[r.motion for r in known if r.style == number] for number in range(count)]
    posture = np.array([np.concatenate([places(m) for m in ms]).mean(0) for ms in by_style])
    last = model.network_config.levels
    split = asked.coarse
    hertz = [step * model.fps * 0.75 ** (last - split) / 2 for step in STEPS]
    energy = np.array([np.mean([fast(m, hertz) for m in ms], axis=0) for ms in by_style])
    print(
        f"\nlevels 1-{split} (rows), {split + 1}-{last} (columns); over {hertz[0]:.1f} Hz, cm RMS"
    )
    print("", *model.styles, "recordings", sep=" | ")
    made = np.full((count, count, len(hertz)), np.nan)
    recorded_poses = cKDTree(np.concatenate([poses(r.motion) for r in known]))
    far = np.full((count, count), np.nan)
    nearest = []
    for coarse in range(count):
        for fine in range(count):
            told = f"1-{split}={model.styles[coarse]},{split + 1}-{last}={model.styles[fine]}"
            motions = [
                model.generate(
                    seconds=asked.seconds,
                    level_style=told,
                    seed=seed,
                    foot_lock=asked.foot_lock,
                    fps=model.fps,
                )
                for seed in range(3)
            ]
            made[coarse, fine] = np.mean([fast(motion, hertz) for motion in motions], axis=0)
            far[coarse, fine] = np.mean([recorded_poses.query(poses(m))[0].mean() for m in motions])
            if fine != coarse:
                mean = np.mean([places(motion).mean(0) for motion in motions], axis=0)
                apart = np.linalg.norm(posture - mean, axis=-1).mean(-1)
                nearest.append((int(apart.argmin()) == coarse, int(apart.argmin()) == fine))
        row = [f"{value:.3f}" for value in made[coarse, :, 0]]
        print(model.styles[coarse], *row, f"{energy[coarse, 0]:.3f}", sep=" | ", flush=True)
    posed = np.sum(nearest, axis=0)
    print(
        f"mean posture nearest to the coarse style's in {posed[0]} of {len(nearest)} pairs, to the "
        f"fine one's in {posed[1]}"
    )
    mixed = ~np.eye(count, dtype=bool)
    print(
        f"from the nearest recorded pose: {np.diag(far).mean():.1f} cm in one style, in two "
        f"{far[mixed].mean():.1f} cm, at most {far[mixed].max():.1f} cm"
    )
    pairs = np.array(list(permutations(range(count), 2)))
    for i, limit in enumerate(hertz):
        mixed = np.log(made[pairs[:, 0], pairs[:, 1], i])
        told = [np.corrcoef(mixed, np.log(energy[side, i]))[0, 1] for side in pairs.T]
        print(
            f"over {limit:.1f} Hz: r {told[0]:.2f} with the coarse style's own, {told[1]:.2f} with "
            "the fine one's"
        )


if __name__ == "__main__":
    main()
