"""Does a model move like the speaker? Measures of life over several held-out blocks, pooled.

    python recipes/multires_speech/life.py runs/a0/model=c0.jsonl runs/a1/model=c1.jsonl ...

Each model is measured on the paired items of its manifest's split (test), which it must not have
been trained on. Blocks of one recording are pooled: the motion generated for all of them, one
after another, is compared with all recorded blocks. Values but sync, r, 1-NN and copying are ratios
to the recording's. With a single model there is one block.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

import audio_features as af
import gesturekit as gk
from gesturekit.corpus.manifest import Manifest
from gesturekit.evaluation import (
    arm_speed,
    calm_and_lively,
    copying,
    foot_skate,
    hand_movement,
    motion_windows,
    sync,
    two_sample_accuracy,
)
from gesturekit.evaluation.metrics.hands import hand_paths
from gesturekit.motion.parts import find_parts

FPS = 25.0
POOLED = ("q10", "q50", "q90", "q99", "rest", "reach", "range")
BY_BLOCK = ("q50", "q90", "reach", "rest")


@dataclass
class Block:
    """A held-out recording, the training recordings beside it, and what a model made of it."""

    recording: gk.Motion
    wave: af.Wave
    training: list[gk.Motion]
    others: list[af.Wave]
    made: list[gk.Motion]


def blocks_of(
    model: str, manifest: str, split: str, seeds: int, weights: str | None
) -> list[Block]:
    """Generate motion for every held-out item of a manifest, with several seeds."""
    loaded, items = gk.load(model, weights=weights), Manifest.load(manifest)
    train = items.paired("train")
    training = [item.load_motion().resample(FPS) for item in train]
    others = [item.load_wave() for item in train]
    found = []
    for item in items.paired(split):
        wave = item.load_wave()
        made = [loaded.generate(wave, seed=s, item=item.id, fps=FPS) for s in range(seeds)]
        found.append(Block(item.load_motion().resample(FPS), wave, training, others, made))
    return found


def jerks(motion: gk.Motion) -> np.ndarray:
    """Return the mean jerk of hands, elbows and head, m/s^3."""
    parts, skeleton = find_parts(motion.skeleton), motion.skeleton
    arms = parts.arms.values()
    groups = [[arm.wrist for arm in arms], [arm.elbow for arm in arms], [parts.head]]
    positions = motion.positions()
    return (
        np.array(
            [
                np.linalg.norm(
                    np.diff(positions[:, [skeleton.index(j) for j in g]], 3, axis=0), axis=-1
                ).mean()
                for g in groups
            ]
        )
        * FPS**3
    )


def smooth_arm_speed(motion: gk.Motion) -> np.ndarray:
    return gaussian_filter1d(arm_speed(motion), 0.1 * FPS)


def stretches(block: Block) -> list[af.Wave]:
    """Return the speech of the training recordings in stretches as long as the held-out one."""
    n = len(block.wave.samples)
    waves = [wave.resample(block.wave.sample_rate) for wave in block.others]
    starts = [range(0, max(1, len(wave.samples) - n + 1), max(1, n // 2)) for wave in waves]
    return [
        af.Wave(wave.samples[start : start + n], wave.sample_rate)
        for wave, own in zip(waves, starts, strict=True)
        for start in own
    ]


def listening(block: Block) -> dict[str, float]:
    """Return sync, mismatched sync and r with the recording's arm speed, means over seeds."""
    real, rows = smooth_arm_speed(block.recording), []
    for motion in block.made:
        own = smooth_arm_speed(motion)
        n = min(len(own), len(real))
        rows.append(
            (
                sync(motion, block.wave).r,
                np.mean([sync(motion, wave).r for wave in stretches(block)]),
                np.corrcoef(own[:n], real[:n])[0, 1],
            )
        )
    return dict(zip(("sync", "mismatched", "r real"), np.mean(rows, axis=0), strict=True))


def likeness(block: Block, everything: list[gk.Motion]) -> dict[str, float]:
    """Return 1-NN (beside the recording's own), the mean over seeds, and copying of all seeds."""
    recorded = motion_windows(everything)
    own = two_sample_accuracy(motion_windows(block.recording), motion_windows(block.training))
    copies = copying(block.made, block.recording, block.training)
    return {
        "1-NN": np.mean([two_sample_accuracy(motion_windows(m), recorded) for m in block.made]),
        "own 1-NN": own,
        "copy median": copies.median_ratio,
        "copy 5 %": copies.low_ratio,
    }


def seeds_apart(block: Block) -> float:
    """Return the mean distance between the hands of neighbouring seeds, metres."""
    paths = [hand_paths(motion) for motion in block.made]
    pairs = zip(paths, paths[1:], strict=False)
    return float(np.mean([np.linalg.norm(a - b, axis=-1).mean() for a, b in pairs]))


def hands_together(motion: gk.Motion) -> float:
    """Return the correlation of the vertical velocities of both hands."""
    heights = gaussian_filter1d(hand_paths(motion)[..., 1], 0.08 * FPS, axis=0)
    return float(np.corrcoef(np.gradient(heights, axis=0).T)[0, 1])


def print_rows(rows: dict[str, list[float]]) -> None:
    for name, values in rows.items():
        mean = f" | mean {np.mean(values):.2f}" if len(values) > 1 else ""
        print(f"{name:12s} " + " ".join(f"{value:6.2f}" for value in values) + mean)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="+", help="MODEL=MANIFEST for each held-out block")
    parser.add_argument("--split", default="test")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--weights", help="encoder weights, if the models have such features")
    parser.add_argument("--strangers", type=Path, help="folder of other people's speech")
    options = parser.parse_args()
    blocks = []
    for pair in options.models:
        model, _, manifest = pair.partition("=")
        blocks += blocks_of(model, manifest, options.split, options.seeds, options.weights)
    recordings = [block.recording for block in blocks]
    whole = asdict(hand_movement(recordings))
    pooled = [
        asdict(hand_movement([block.made[s] for block in blocks])) for s in range(options.seeds)
    ]
    print("pooled, ratios to the recording:")
    for name in POOLED:
        print(f"{name:12s} {np.mean([p[name] for p in pooled]) / whole[name]:6.2f}")
    calm = calm_and_lively(recordings, [block.made for block in blocks])
    print(f"calm and lively: r {calm.r:.2f}, slope {calm.slope:.2f}")
    made = np.mean([[jerks(m) for m in block.made] for block in blocks], axis=(0, 1))
    for name, ratio in zip(
        ("hands", "elbows", "head"), made / np.mean([jerks(r) for r in recordings], 0), strict=True
    ):
        print(f"jerk, {name:6s} {ratio:6.2f}")
    still = np.mean([p["near_still"] for p in pooled]), whole["near_still"]
    print(f"near still   {still[0]:6.3f} (recording {still[1]:.3f})")
    print("by block:")
    print_rows(
        {
            name: [listening(block)[name] for block in blocks]
            for name in ("sync", "mismatched", "r real")
        }
    )
    own = [asdict(hand_movement(block.recording)) for block in blocks]
    made_by = [[asdict(hand_movement(m)) for m in block.made] for block in blocks]
    print_rows(
        {
            name: [
                np.mean([m[name] for m in ms]) / o[name] for ms, o in zip(made_by, own, strict=True)
            ]
            for name in BY_BLOCK
        }
    )
    alike = [likeness(block, recordings) for block in blocks]
    print_rows({name: [row[name] for row in alike] for name in alike[0]})
    print_rows({"seeds apart": [seeds_apart(block) for block in blocks]})
    print_rows({"together": [np.mean([hands_together(m) for m in b.made]) for b in blocks]})
    print_rows({"recorded": [hands_together(b.recording) for b in blocks]})
    skates = [[foot_skate(m) for m in (block.recording, *block.made)] for block in blocks]
    print_rows({"foot skate": [np.mean(s[1:]) / max(s[0], 1e-9) for s in skates]})
    if options.strangers:
        rows = []
        for pair in options.models:
            model = gk.load(pair.partition("=")[0], weights=options.weights)
            synced = []
            for path in sorted(options.strangers.iterdir()):
                wave = af.Wave.load(path)
                synced.append(sync(model.generate(wave, seed=0, item=path.stem, fps=FPS), wave).r)
            rows.append(np.mean(synced))
        print_rows({"strangers": rows})


if __name__ == "__main__":
    main()
