"""Few denoising steps beside all of them, and the seams of in-betweening, over many seeds.

    python benchmarks/few_steps.py runs/mine/model speech.wav [--seeds 40] [--seconds 10]

For each seed the same sound is sampled with all steps as published and with few steps of `dpm`. A
row is the mean over seeds, with its 95 % interval, of the ratio to the mean of all steps. The last
rows keep the first 3 s of one seed's motion and the last 3 s of the next one's: jerk at the joins
(the three third differences that touch a join) over that of all other frames.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from harness import common_options

import audio_features as af
import gesturekit as gk
from gesturekit.evaluation import hand_speed, jerk, sync

FEW = (4, 6, 8, 12)
KEPT = 3.0
"""Seconds that are kept at either end."""


def main() -> None:
    parser = common_options(__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("wav", type=Path)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--clip-denoised", action="store_true", help="as generate, raw otherwise")
    asked = parser.parse_args()
    count = 4 if asked.quick else asked.seeds
    model, wave = gk.load(asked.model), af.Wave.load(asked.wav).slice(0.0, asked.seconds)

    def motions(**controls: object) -> list[gk.Motion]:
        controls["clip_denoised"] = asked.clip_denoised
        return [model.generate(wave, seed=seed, raw=True, **controls) for seed in range(count)]

    measures: dict[str, Callable[[gk.Motion], float]] = {
        "hand speed": lambda motion: float(np.mean(hand_speed(motion))),
        "jerk": jerk,
        "sync": lambda motion: sync(motion, wave).r,
    }
    every = motions()
    whole = {name: np.array([of(m) for m in every]) for name, of in measures.items()}
    print(f"{count} seeds, {asked.seconds:g} s; mean of all steps, then few / all [95 %]")
    for name, values in whole.items():
        print(f"all steps: {name} {values.mean():.3g}")
    print(f"all steps: distance of two seeds {apart(every, every[1:] + every[:1]):.3f} m")
    for steps in FEW:
        few = motions(steps=steps)
        for name, of in measures.items():
            values = np.array([of(motion) for motion in few])
            change = (values - whole[name]) / whole[name].mean()  # seed by seed
            print(f"{steps} steps: {name} {interval(1 + change)}")
        print(f"{steps} steps: distance of two seeds {apart(few, few[1:] + few[:1]):.3f} m")
    clips = [model.generate(wave, seed=seed) for seed in range(count)]
    for steps in (None, 8):
        ratios = joins(model, wave, clips, steps)
        print(f"keep, {steps or 'all'} steps: {interval(np.array(ratios))}")


def joins(model: gk.Model, wave: af.Wave, clips: list[gk.Motion], steps: int | None) -> list[float]:
    """Return the jerk at the joins over that elsewhere, for each seed."""
    ratios, n, kept = [], clips[0].n_frames, round(KEPT * model.fps)
    for seed, (first, last) in enumerate(zip(clips, clips[1:] + clips[:1], strict=True)):
        keep = {0.0: first[:kept], (n - kept) / model.fps: last[n - kept :]}
        made = model.generate(wave, seed=seed + 1000, keep=keep, steps=steps)
        size = np.linalg.norm(np.diff(made.positions(), 3, axis=0), axis=-1).mean(axis=1)
        at = np.zeros(len(size), bool)
        for join in (kept, n - kept):
            at[join - 3 : join] = True
        ratios.append(size[at].mean() / size[~at].mean())
    return ratios


def apart(some: list[gk.Motion], others: list[gk.Motion]) -> float:
    """Return the mean distance of joints, metres."""
    pairs = zip(some, others, strict=True)
    return float(
        np.mean([np.linalg.norm(a.positions() - b.positions(), axis=-1).mean() for a, b in pairs])
    )


def interval(values: np.ndarray) -> str:
    """Return the mean and its 95 % interval."""
    half = 1.96 * values.std(ddof=1) / len(values) ** 0.5
    return f"{values.mean():.2f} [{values.mean() - half:.2f}, {values.mean() + half:.2f}]"


if __name__ == "__main__":
    main()
