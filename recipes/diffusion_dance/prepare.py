"""Make a synthetic corpus of dances to clicks and chords, instead of recorded dance.

    python recipes/diffusion_dance/prepare.py --out dances [--clips 20] [--seconds 30] [--seed 0]

Writes these files, with the same bytes for the same seed:

    dances/dance_NN.wav     a track of 80 to 150 beats per minute, some with offbeats
    dances/dance_NN.bvh     a dance to it, 60 frames per second
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import soundfile
from dancer import dance
from track import RATE, TEMPOS, Track, play

from audio_features.atomic import atomic_write


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Make a corpus of dances to clicks and chords.")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--clips", type=int, default=20, help="(20)")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each clip (30)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if not (1 <= options.clips <= 10_000 and 4 <= options.seconds <= 3600):
        parser.error("--clips: from 1 to 10000; --seconds: from 4 to 3600")
    options.out.mkdir(parents=True, exist_ok=True)
    for number in range(options.clips):
        rng = np.random.default_rng([options.seed, number])
        stem = options.out / f"dance_{number:02d}"
        track = make_clip(stem, options.seconds, rng)
        offbeats = ", offbeats" if track.has_offbeat else ""
        print(f"{stem}.wav: {options.seconds:g} s, {track.tempo:.0f} beats per minute{offbeats}")
    print(f"Next:\n  gesturekit prepare {options.out} --out {options.out}/corpus.jsonl")


def make_clip(stem: Path, seconds: float, rng: np.random.Generator) -> Track:
    """Write one track and the dance to it."""
    track = play(seconds, rng.uniform(*TEMPOS), bool(rng.random() < 0.4), rng)
    with atomic_write(stem.with_suffix(".wav")) as temporary:
        soundfile.write(temporary, track.samples, RATE, subtype="PCM_16")
    dance(track.beats, seconds, rng).save(stem.with_suffix(".bvh"))
    return track


if __name__ == "__main__":
    main()
