"""Measure how well a model dances to the beats of new tracks.

    python recipes/diffusion_dance/measure.py runs/dances/model [--tracks 10] [--out folder]

The tracks are made like those of `prepare.py`, with another seed and a different tempo each. For
each track, one line gives the beat alignment (BAS) of the generated dance, its mean and standard
deviation over 200 circular shifts of the beats, the same for a rule-based dance (`dancer.py`), the
ratio of hand speed to that dance's, and foot skate.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from dancer import dance
from track import RATE, TEMPOS, play

import gesturekit as gk
from audio_features import Wave
from gesturekit.evaluation import arm_speed_ratio, beat_alignment
from gesturekit.evaluation.metrics.physical import foot_skate
from gesturekit.viewer.pictures import write_picture

SECONDS = 22.1
"""Length of a track, enough for 200 shifts in `beat_alignment`."""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--tracks", type=int, default=10, help="(10)")
    parser.add_argument("--seed", type=int, default=100, help="of the tracks (100)")
    parser.add_argument("--steps", type=int, help="denoising steps (all)")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where to write the dances")
    options = parser.parse_args(arguments)
    model = gk.load(options.model)
    tempos = np.random.default_rng(options.seed).permutation(np.linspace(*TEMPOS, options.tracks))
    print("tempo    BAS   chance   sd     z   by rule     z   hands  skate m/s")
    zs = []
    for number, tempo in enumerate(tempos):
        rng = np.random.default_rng([options.seed, number])
        track = play(SECONDS, tempo, number % 2 == 1, rng)
        wave = Wave(track.samples.astype(np.float32), RATE)
        motion = model.generate(wave, steps=options.steps, seed=number, fps=model.fps)
        found = beat_alignment(motion, track.beats)
        ruled = dance(track.beats, SECONDS, rng).resample(model.fps)
        own = beat_alignment(ruled, track.beats)
        zs.append(found.z)
        print(
            f"{track.tempo:5.0f}  {found.score:.3f}    {found.chance_mean:.3f}  "
            f"{found.chance_sd:.3f} {found.z:5.1f}     {own.score:.3f} {own.z:5.1f}"
            f"   {arm_speed_ratio(motion, ruled):.2f}   {foot_skate(motion):.4f}",
            flush=True,
        )
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
            stem = options.out / f"track_{number:02d}"
            motion.save(stem.with_suffix(".bvh"))
            write_picture(motion, stem.with_suffix(".png"), wave)
    print(f"{sum(z > 2 for z in zs)} of {len(zs)} tracks above chance + 2 sd")


if __name__ == "__main__":
    main()
