"""Measure whether moves happen at the times of their events, alone and within a dance.

    python recipes/diffusion_events/measure.py runs/fights/model [--dance runs/dances/model]

The events are drawn by `fighter.py` with another seed. A punch counts if the right fist is
farthest ahead of the chest within 0.15 s of the event, and more than halfway from guard to hit; a
duck likewise by the height of the hips. The same events moved by 0.5 s give the chance level.

With a dance model, the tracks are those of `../diffusion_dance`, with a punch on every fourth beat.
For the product of both models, at several expert weights of the fighter, the output is the beat
alignment of the dance and the share of punches that happen.
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
    """Print the share of events whose move happens, with the fighting model alone."""
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
        on, off = np.mean(shares, axis=0)
        print(f"{name}: {100 * on:.0f} % met, {100 * off:.0f} % of moments 0.5 s later")


def danced(model, dance) -> None:
    """Print beat alignment and punches on every fourth beat, with the product of both models."""
    print("weight   BAS z   punches met   of the beats between them")
    for weight in WEIGHTS:
        rows = []
        for number in range(TRACKS):
            rng = np.random.default_rng([100, number])
            track = play(SECONDS, rng.uniform(80, 150), number % 2 == 1, rng)
            wave = Wave(track.samples.astype(np.float32), RATE)
            beats, others = track.beats[::BEATS_PER_BAR], track.beats[2::BEATS_PER_BAR]
            text = ",".join(f"punch@{time:.3f}" for time in beats)
            motion = dance.generate(
                wave, events=text, experts=[(model, weight)], seed=number, fps=dance.fps
            )
            found = beat_alignment(motion, track.beats)
            rows.append((found.z, met(motion, "punch", beats), met(motion, "punch", others)))
        z, on, off = np.mean(rows, axis=0)
        print(f"{weight:6.1f} {z:7.1f} {100 * on:11.0f} % {100 * off:11.0f} %", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument(
        "--dance", type=Path, metavar="MODEL", help="the other expert of the product"
    )
    options = parser.parse_args(arguments)
    model = gk.load(options.model)
    alone(model)
    if options.dance is not None:
        danced(model, gk.load(options.dance))


if __name__ == "__main__":
    main()
