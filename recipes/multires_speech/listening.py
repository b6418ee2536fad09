"""Does a model listen? Sync with held-out speech, beside the recording's own.

    python recipes/multires_speech/listening.py runs/a/model corpus.jsonl --strangers voices/

For every item of the manifest's split (test), the model speaks the item's audio with many seeds;
the table has the mean over seeds of: sync (r at the best lag), the same with the training items'
speech instead (mismatched: what a motion reaches with speech that it was not made for), chance and
z by circular shifts, r with the recording's own arm speed (smoothed by the same 0.1 s, lag 0), arm
speed and jerk as ratios to the recording's (jerk also to the recording low-passed at 6 Hz: much of
the raw one is capture noise), and the recording's own sync. What is measured is what `render`
gives by default: with feet locked, and smoothed where the model says so (`smooth` in its
config.yaml).

With `--strangers`, one more line for a folder of speech that the model has not heard: sync, and
arm speed against the mean of the training recordings.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, sosfiltfilt

import audio_features as af
import gesturekit as gk
from gesturekit.corpus.manifest import Manifest
from gesturekit.evaluation import arm_speed, arm_speed_ratio, jerk_ratio, sync
from gesturekit.formats.sources import SPEECH_SUFFIXES

SMOOTHING_SECONDS = 0.1


def low_passed(motion: gk.Motion, hertz: float = 6.0) -> gk.Motion:
    """The motion without what is faster than `hertz`: 4th-order Butterworth on quaternions."""
    rotations = motion.rotations.copy()
    # One sign a joint, or the filter would run through the origin where q flips to -q.
    flips = np.sign((rotations[1:] * rotations[:-1]).sum(-1, keepdims=True))
    rotations[1:] *= np.cumprod(np.where(flips == 0, 1, flips), axis=0)
    sos = butter(4, hertz, fs=motion.fps, output="sos")
    return replace(
        motion,
        rotations=sosfiltfilt(sos, rotations, axis=0),
        translation=sosfiltfilt(sos, motion.translation, axis=0),
    )


def smooth_arm_speed(motion: gk.Motion) -> np.ndarray:
    return gaussian_filter1d(arm_speed(motion), SMOOTHING_SECONDS * motion.fps)


def measure(model, item, others: list[af.Wave], seeds: int) -> dict[str, float]:
    """The figures of one item, means over seeds; `others` is speech that it is not."""
    wave = item.load_wave()
    recording = item.load_motion().resample(model.fps)
    own = sync(recording, wave)
    quiet = low_passed(recording)
    rows = []
    for seed in range(seeds):
        motion = model.generate(wave, seed=seed, item=item.id, fps=model.fps)
        n_frames = min(motion.n_frames, recording.n_frames)
        heard = sync(motion, wave)
        rows.append(
            {
                "sync": heard.r,
                "mismatched": np.mean([sync(motion, other).r for other in others]),
                "lag": heard.lag,
                "chance": heard.chance_mean,
                "chance sd": heard.chance_sd,
                "z": heard.z,
                "r real": np.corrcoef(
                    smooth_arm_speed(motion)[:n_frames], smooth_arm_speed(recording)[:n_frames]
                )[0, 1],
                "speed": arm_speed_ratio(motion, recording),
                "jerk": jerk_ratio(motion, recording),
                "jerk 6 Hz": jerk_ratio(motion, quiet),
            }
        )
    figures = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    figures["sync sd"] = float(np.std([row["sync"] for row in rows]))
    return figures | {"recording": own.r, "rec. chance": own.chance_mean, "rec. z": own.z}


def measure_strangers(model, folder: Path, recordings, seeds: int) -> dict[str, float]:
    """Sync and relative arm speed over the speech files of a folder, means over files and seeds."""
    usual = np.concatenate([arm_speed(motion.resample(model.fps)) for motion in recordings]).mean()
    rows = []
    for path in sorted(path for path in folder.iterdir() if path.suffix.lower() in SPEECH_SUFFIXES):
        wave = af.Wave.load(path)
        for seed in range(seeds):
            motion = model.generate(wave, seed=seed, item=path.stem, fps=model.fps)
            heard = sync(motion, wave)
            rows.append(
                {
                    "sync": heard.r,
                    "lag": heard.lag,
                    "chance": heard.chance_mean,
                    "z": heard.z,
                    "speed": arm_speed(motion).mean() / usual,
                }
            )
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", help="model folder")
    parser.add_argument("manifest", help="corpus.jsonl with paired items in the split")
    parser.add_argument("--split", default="test")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--strangers", type=Path, help="folder of speech to measure as well")
    parser.add_argument("--weights", help="WavLM weights, if the model hears by WavLM")
    parser.add_argument("--json", help="also write the figures here")
    options = parser.parse_args()
    model = gk.load(options.model, weights=options.weights)
    manifest = Manifest.load(options.manifest)
    items, training = manifest.paired(options.split), manifest.paired("train")
    if not items:
        parser.error(f"{options.manifest}: no paired item of split {options.split}")
    others = [item.load_wave() for item in training]
    table = {item.id: measure(model, item, others, options.seeds) for item in items}
    if options.strangers:
        motions = [item.load_motion() for item in training]
        table[options.strangers.name] = measure_strangers(
            model, options.strangers, motions, options.seeds
        )
    smoothed = getattr(model, "smooth", None)
    print(f"smoothed by {smoothed:g} s\n" if smoothed else "not smoothed\n")
    names = list(next(iter(table.values())))
    print("| item | " + " | ".join(names) + " |")
    print("|---" * (len(names) + 1) + "|")
    for name, figures in table.items():
        shown = [f"{figures[key]:.2f}" if key in figures else "" for key in names]
        print(f"| {name} | " + " | ".join(shown) + " |")
    if options.json:
        Path(options.json).write_text(json.dumps(table, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
