"""Do moves happen when they are told to, alone and in a dance?

    python recipes/diffusion_events/measure.py runs/fights/model [--dance runs/dances/model]

Tells the model moves that `fighter.py` draws with another seed. A punch is there where the right
fist is farthest ahead of the chest within 0.15 s of its moment, and by more than halfway from
guard to hit; so for a duck and the hips' height. The same moments 0.5 s later show what is chance.

With a dance model, tracks as in `../diffusion_dance`, and a punch on every fourth beat: the product
of both, by the weight of the fighter. Beat alignment of the dance, and how often punches are met.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from fighter import MOVES, draw_events
from moves import met

import gesturekit as gk
from audio_features import Wave
from gesturekit.evaluation import beat_alignment

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "diffusion_dance"))
from track import BEATS_PER_BAR, RATE, play  # noqa: E402

SECONDS = 22.1
TRACKS = 5
WEIGHTS = (0.0, 0.3, 0.5, 0.7, 1.0)


def alone(model, clips: int = 5) -> None:
    """Moves at any time, with the model of moves."""
    rows = {name: [] for name in MOVES}
    for number in range(clips):
        rng = np.random.default_rng([200, number])
        events = draw_events(SECONDS, rng)
        text = ",".join(f"{event.name}@{event.time}" for event in events)
        motion = model.generate(seconds=SECONDS, events=text, seed=number, fps=model.fps)
        for name in MOVES:
            moments = np.array([event.time for event in events if event.name == name])
            rows[name].append((met(motion, name, moments), met(motion, name, moments + 0.5)))
    for name, shares in rows.items():
        told, off = np.mean(shares, axis=0)
        print(f"{name}: {100 * told:.0f} % met, {100 * off:.0f} % of moments 0.5 s later")


def danced(model, dance) -> None:
    """Punches on every fourth beat of tracks, in a dance to them."""
    print("weight   BAS z   punches met   of the beats between them")
    for weight in WEIGHTS:
        rows = []
        for number in range(TRACKS):
            rng = np.random.default_rng([100, number])
            track = play(SECONDS, rng.uniform(80, 150), number % 2 == 1, rng)
            wave = Wave(track.samples.astype(np.float32), RATE)
            told, others = track.beats[::BEATS_PER_BAR], track.beats[2::BEATS_PER_BAR]
            text = ",".join(f"punch@{time:.3f}" for time in told)
            motion = dance.generate(
                wave, events=text, experts=[(model, weight)], seed=number, fps=dance.fps
            )
            found = beat_alignment(motion, track.beats)
            rows.append((found.z, met(motion, "punch", told), met(motion, "punch", others)))
        z, on, off = np.mean(rows, axis=0)
        print(f"{weight:6.1f} {z:7.1f} {100 * on:11.0f} % {100 * off:11.0f} %", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--dance", type=Path, metavar="MODEL", help="to multiply it with")
    options = parser.parse_args(arguments)
    model = gk.load(options.model)
    alone(model)
    if options.dance is not None:
        danced(model, gk.load(options.dance))


if __name__ == "__main__":
    main()
