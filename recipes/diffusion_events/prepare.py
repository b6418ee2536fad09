"""Make a synthetic corpus of moves with event flags, instead of recorded fighting.

    python recipes/diffusion_events/prepare.py --out fights [--clips 20] [--seconds 30] [--seed 0]

Writes these files, with the same bytes for the same seed:

    fights/fight_NN.bvh           a fighter on guard, 60 frames per second
    fights/fight_NN.events.csv    his punches and ducks: time, name
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from fighter import draw_events, fight

from audio_features.atomic import atomic_write


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Make a corpus of moves with event flags.")
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
        stem = options.out / f"fight_{number:02d}"
        events = draw_events(options.seconds, rng)
        fight(events, options.seconds, rng).save(stem.with_suffix(".bvh"))
        rows = "".join(f"{event.time:.3f},{event.name}\n" for event in events)
        with atomic_write(stem.with_suffix(".events.csv")) as temporary:
            temporary.write_text(f"time,name\n{rows}", encoding="utf-8")
        print(f"{stem}.bvh: {options.seconds:g} s, {len(events)} moves")
    print(
        f"Next:\n  gesturekit prepare --unpaired-motion {options.out} "
        f"--out {options.out}/corpus.jsonl"
    )


if __name__ == "__main__":
    main()
