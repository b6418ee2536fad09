"""Likeness of real motion and of half its amplitude, in disjoint halves of a speaker's recordings.

    python benchmarks/likeness_halves.py recordings/ --draws 60 --seconds 15

The recordings of one speaker are cut into pieces, each of which counts as a take. In a draw, half
of the pieces are the reference, and the other half are the model's motion. Real motion should have
as much likeness as its ceiling; an interval of half amplitude should hold the mean of all draws.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
import time
from pathlib import Path

import numpy as np

import gesturekit as gk
from gesturekit.evaluation.measuring.made_motion import halved
from gesturekit.evaluation.pairs import motion_files
from gesturekit.evaluation.results import MetricResult
from gesturekit.motion import Motion

FPS = 30.0


def pieces(folder: Path, seconds: float) -> list[Motion]:
    """Return all recordings of a folder in pieces of this length; rests are left out."""
    motions = [Motion.load(path).resample(FPS) for path in motion_files(folder).values()]
    return [
        motion.trim(number * seconds, (number + 1) * seconds)
        for motion in motions
        for number in range(int(motion.duration // seconds))
    ]


def likeness(reference: list[Motion], made: list[Motion]) -> dict[str, MetricResult]:
    """Return the likeness of other motion, and of the same at half amplitude, to a reference."""
    with tempfile.TemporaryDirectory() as folder:
        for number, (recorded, other) in enumerate(zip(reference, made, strict=True)):
            half = halved(other, other.skeleton.names)
            for name, motion in (("recorded", recorded), ("real", other), ("half", half)):
                motion.save(Path(folder) / name / f"piece{number}x.npz")
        models = {name: Path(folder) / name for name in ("real", "half")}
        found = gk.evaluate(models, Path(folder) / "recorded", cheap=True)
    return {model.label: model.metrics["likeness"] for model in found.models}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("recordings", type=Path, help="folder of motion of one speaker")
    parser.add_argument("--draws", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=15.0, help="length of a piece")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    logging.disable(logging.WARNING)
    every, start = pieces(asked.recordings, asked.seconds), time.perf_counter()
    rng, size = np.random.default_rng(asked.seed), len(every) // 2
    drawn = []
    for _ in range(asked.draws):
        order = rng.permutation(len(every))
        reference, made = ([every[k] for k in part] for part in (order[:size], order[size:][:size]))
        drawn.append(likeness(reference, made))
    real, half = (
        np.array([draw[name].interval.value for draw in drawn]) for name in ("real", "half")
    )
    ceilings = np.array([draw["real"].ceiling.value for draw in drawn if draw["real"].ceiling])
    intervals = [draw["half"].interval for draw in drawn if draw["half"].interval.low is not None]
    holds = [i.low <= half.mean() <= i.high for i in intervals]
    print(f"{len(every)} pieces, {size} against {size}, {asked.draws} draws")
    print(f"real {real.mean():.2f} ± {real.std(ddof=1):.2f}, ceiling {ceilings.mean():.2f}")
    print(f"share of the ceiling {real.mean() / ceilings.mean():.2f}")
    print(
        f"half amplitude {half.mean():.2f} ± {half.std(ddof=1):.2f}; its interval holds this ",
        end="",
    )
    print(f"in {sum(holds)} of {len(holds)} draws; {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
