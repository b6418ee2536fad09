"""Is motion for takes that a model was not trained on like the speaker's motion in training?

    python recipes/multires_speech/takes.py runs/a/model=a.jsonl runs/b/model=b.jsonl ...

The held-out recordings of each manifest (--split) are cut into clips of 10 s, and motion is
generated for each with many seeds. What speech leaves open should differ between seeds as it does
between the speaker's clips. Columns:

    q50 q90 q99 rest reach range   of all motions pooled, over those of the training recordings
    inside        share of clips whose recorded level (log mean hand speed) lies between the ranks
                  of the seeds' levels that cover 80 %, such as the 2nd lowest and highest of 19
    width         mean width of these intervals, over that of draws from the training clips
    seeds / clips standard deviation of the level between the seeds of a clip, over that between
                  training clips
    one seed      standard deviation of the level between clips with one seed, over the same
    fast, energy  r of fast movement (log hand speed less its Gaussian mean of 2 s) with recorded
                  movement and with the loudness of the speech
    together      r of both hands' vertical velocities (training recordings in brackets)
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict

import numpy as np
from life import FPS, hands_together
from scipy.ndimage import gaussian_filter1d

import audio_features as af
import gesturekit as gk
from gesturekit.corpus.manifest import Manifest
from gesturekit.evaluation import calibration, hand_movement, hand_speed
from gesturekit.evaluation.metrics.hands import hand_level, window_starts

POOLED = ("q50", "q90", "q99", "rest", "reach", "range")
SECONDS = 10.0


def clips_of(wave: af.Wave, motion: gk.Motion) -> list[tuple[af.Wave, gk.Motion]]:
    """Cut a recording into clips of `SECONDS`; what is left over at the end is left out."""
    samples = round(SECONDS * wave.sample_rate)
    starts = range(0, len(wave.samples) - samples + 1, samples)
    waves = [af.Wave(wave.samples[start : start + samples], wave.sample_rate) for start in starts]
    return list(zip(waves, motions_of(motion), strict=False))


def motions_of(motion: gk.Motion) -> list[gk.Motion]:
    """Cut a motion into clips of `SECONDS`."""
    frames = round(SECONDS * FPS)
    starts = window_starts(motion.n_frames, frames, frames)
    return [motion[start : start + frames] for start in starts]


def fast(curve: np.ndarray) -> np.ndarray:
    return curve - gaussian_filter1d(curve, 2.0 * FPS, mode="nearest")


def fast_movement(motion: gk.Motion) -> np.ndarray:
    return fast(gaussian_filter1d(np.log(hand_speed(motion) + 0.05), 2.5, axis=0).mean(axis=1))


def loudness(wave: af.Wave, n_frames: int) -> np.ndarray:
    """Return the fast part of the loudness, dB, at most 40 dB below the loudest frames."""
    edges = np.linspace(0, len(wave.samples), n_frames + 1).astype(int)
    parts = np.split(np.asarray(wave.samples, float), edges[1:-1])
    level = 10 * np.log10([np.mean(np.square(part)) + 1e-12 for part in parts])
    return fast(gaussian_filter1d(np.maximum(level, np.quantile(level, 0.95) - 40), 2.5))


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    n = min(len(a), len(b))
    return float(np.corrcoef(a[:n], b[:n])[0, 1])


def row(model: str, manifest: str, split: str, seeds: int) -> dict[str, float]:
    loaded, items = gk.load(model), Manifest.load(manifest)
    training = [item.load_motion().resample(FPS) for item in items.paired("train")]
    usual = [clip for motion in training for clip in motions_of(motion)]
    clips, names = [], []
    for item in items.paired(split):
        own = clips_of(item.load_wave(), item.load_motion().resample(FPS))
        clips += own
        names += [f"{item.id}_{k}" for k in range(len(own))]
    made = [
        [loaded.generate(wave, seed=seed, item=name, fps=FPS) for seed in range(seeds)]
        for name, (wave, _) in zip(names, clips, strict=True)
    ]
    speaker, pooled = (
        asdict(hand_movement(motions)) for motions in (training, [m for own in made for m in own])
    )
    levels = np.array([[hand_level(motion) for motion in own] for own in made])
    of_speaker = np.array([hand_level(motion) for motion in usual])
    found = calibration(levels, [hand_level(recorded) for _, recorded in clips], of_speaker)
    pairs = [(m, *clip) for own, clip in zip(made, clips, strict=True) for m in own]
    return {
        **{name: pooled[name] / speaker[name] for name in POOLED},
        "inside": found.coverage / 100,
        "width": found.sharpness,
        "seeds / clips": levels.std(axis=1, ddof=1).mean() / of_speaker.std(ddof=1),
        "one seed": levels.std(axis=0, ddof=1).mean() / of_speaker.std(ddof=1),
        "fast": np.mean(
            [correlation(fast_movement(m), fast_movement(recorded)) for m, _, recorded in pairs]
        ),
        "energy": np.mean(
            [correlation(fast_movement(m), loudness(wave, m.n_frames)) for m, wave, _ in pairs]
        ),
        "together": np.mean([hands_together(motion) for motion, _, _ in pairs]),
        "(training)": np.mean([hands_together(motion) for motion in usual]),
        "clips": len(clips),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="+", help="MODEL=MANIFEST of each set of held-out takes")
    parser.add_argument("--split", default="test")
    parser.add_argument("--seeds", type=int, default=19)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    pairs = [pair.split("=", 1) for pair in options.models]
    with ProcessPoolExecutor(options.workers) as pool:
        jobs = [pool.submit(row, *pair, options.split, options.seeds) for pair in pairs]
        rows = [job.result() for job in jobs]
    for name in rows[0]:
        print(f"{name:14s}" + "".join(f"{one[name]:8.2f}" for one in rows))


if __name__ == "__main__":
    main()
