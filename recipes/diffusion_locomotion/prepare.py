"""Make a synthetic corpus of walks along paths, instead of recorded locomotion.

    python recipes/diffusion_locomotion/prepare.py --out walks [--clips 20] [--seconds 30]

Writes these files, with the same bytes for the same seed:

    walks/walk_NN.bvh          a walk of varying speed and turning, 60 frames per second
    walks/walk_NN.path.csv     the path it follows: time, x, z, heading
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from walker import MARGIN, Gait, walk

from audio_features.atomic import atomic_write
from gesturekit.motion.root_path import RootPath

FPS = 60.0
SPEEDS = (0.35, 1.8)
"""Range of speeds in m/s."""
TURN, SIDEWAYS = 0.9, 1.0
"""Largest turn in rad/s and largest lateral acceleration in m/s²."""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Make a corpus of walks along paths.")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--clips", type=int, default=20, help="(20)")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each clip (30)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if not (1 <= options.clips <= 10_000 and 1 <= options.seconds <= 3600):
        parser.error("--clips: from 1 to 10000; --seconds: from 1 to 3600")
    options.out.mkdir(parents=True, exist_ok=True)
    for number in range(options.clips):
        rng = np.random.default_rng([options.seed, number])
        stem = options.out / f"walk_{number:02d}"
        make_clip(stem, options.seconds, rng)
        print(f"{stem}.bvh: {options.seconds:g} s")
    print(
        f"Next:\n  gesturekit prepare --unpaired-motion {options.out} "
        f"--out {options.out}/corpus.jsonl"
    )


def make_clip(stem: Path, seconds: float, rng: np.random.Generator) -> None:
    """Write one walk and its path."""
    path = draw_path(seconds + 2 * MARGIN, rng)
    gait = Gait(*rng.uniform([0.96, 0.85, 0.9], [1.04, 1.15, 1.1]))
    walk(path, gait).save(stem.with_suffix(".bvh"))
    margin = round(MARGIN * FPS)
    inner = slice(margin, -margin)
    path = RootPath(path.positions[inner], path.headings[inner], FPS)
    write_path(path, stem.with_suffix(".path.csv"))


def draw_path(seconds: float, rng: np.random.Generator) -> RootPath:
    """Draw a path that faces its direction and passes the origin after `MARGIN` seconds."""
    n_frames = round(seconds * FPS)
    speed = wander(n_frames, *SPEEDS, rng)
    turn = wander(n_frames, -TURN, TURN, rng)
    turn = np.clip(turn, -SIDEWAYS / speed, SIDEWAYS / speed)
    headings = np.cumsum(turn) / FPS
    headings -= headings[round(MARGIN * FPS)]
    steps = speed[:, None] * np.stack([np.sin(headings), np.cos(headings)], axis=-1) / FPS
    places = np.cumsum(steps, axis=0)
    return RootPath(places - places[round(MARGIN * FPS)], headings, FPS)


def wander(n_frames: int, low: float, high: float, rng: np.random.Generator) -> np.ndarray:
    """Draw a signal (T,) that changes smoothly between random levels every few seconds."""
    values, level = [], rng.uniform(low, high)
    while len(values) < n_frames:
        hold, change = rng.uniform(0.5, 3.0), rng.uniform(1.0, 2.5)
        new = rng.uniform(low, high)
        x = np.linspace(0, 1, round(change * FPS))
        values += [level] * round(hold * FPS)
        values += (level + (new - level) * x**3 * (10 - 15 * x + 6 * x * x)).tolist()
        level = new
    return np.array(values[:n_frames])


def write_path(path: RootPath, file: Path) -> None:
    """Write a path in the format of `gesturekit.formats.tables.load_root_path`."""
    table = np.column_stack(
        [np.arange(path.n_frames) / path.fps, path.positions, np.degrees(path.headings)]
    )
    with atomic_write(file) as temporary:
        np.savetxt(temporary, table, "%.5f", ",", header="time,x,z,heading", comments="")


if __name__ == "__main__":
    main()
