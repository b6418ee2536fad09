"""Synthetic fighting: a fighter on guard who punches and ducks at given times only.

The body sways at random. A punch of the right fist is farthest out at the time of its event; a duck
is lowest at its time. The feet stand still.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gesturekit.formats.tables import Event
from gesturekit.motion.motion import Motion

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "demo"))
from rig import STANDING_HEIGHT, Arm, pose  # noqa: E402

FPS = 60.0
MOVES = ("punch", "duck")
OUT, BACK = 0.22, 0.34
"""Duration of the movement before and after its event, in seconds."""
_GUARD = np.array([0.11, 0.04, 0.27])  # of a left wrist, in the chest's frame
_HIT = np.array([0.03, 0.10, 0.50])
_TWIST, _DUCK = 0.45, 0.10  # radians of the spine in a punch, metres of the hips in a duck


def draw_events(seconds: float, rng: np.random.Generator) -> tuple[Event, ...]:
    """Draw random moves, 0.5 to 2 s apart."""
    events, time = [], rng.uniform(0.3, 1.5)
    while time < seconds - BACK:
        events.append(Event(round(time, 3), MOVES[rng.integers(len(MOVES))], 0.0))
        time += rng.uniform(0.5, 2.0)
    return tuple(events)


def fight(events: tuple[Event, ...], seconds: float, rng: np.random.Generator) -> Motion:
    """Return a motion with these moves."""
    time = np.arange(round(seconds * FPS)) / FPS
    punch, duck = (_moves(time, [e.time for e in events if e.name == name]) for name in MOVES)
    sway, bob = (_wander(time, rng) for _ in range(2))
    wrists = [
        _GUARD + share[:, None] * (_HIT - _GUARD) + 0.012 * _wander(time, rng)[:, None]
        for share in (0 * punch, punch)
    ]
    arms = [Arm(wrist, 0 * time - 0.1, 0 * time, 0 * time) for wrist in wrists]
    twist = _TWIST * punch + 0.06 * sway
    hips = np.stack(
        [0.02 * sway, STANDING_HEIGHT - 0.05 - 0.012 * bob - _DUCK * duck, 0.03 * punch], axis=-1
    )
    pelvis = Rotation.from_euler("YXZ", np.stack([0.3 * twist, 0.3 * duck, 0 * time], axis=-1))
    spine = np.stack([0.1 + 0.35 * duck, 0.7 * twist, -0.03 * sway], axis=-1)
    head = np.stack([-0.1 - 0.2 * duck, -twist, 0 * time], axis=-1)
    return pose(FPS, hips, pelvis, spine, head, *arms)


def _moves(time: np.ndarray, moments: list[float]) -> np.ndarray:
    """Return weights (T,): 1 at each moment, falling to 0 at `OUT` before and `BACK` after it."""
    share = np.zeros_like(time)
    for moment in moments:
        since = time - moment
        x = np.clip(1 - np.where(since < 0, -since / OUT, since / BACK), 0, 1)
        share = np.maximum(share, x**3 * (10 - 15 * x + 6 * x * x))
    return share


def _wander(time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a slow random oscillation (T,) within ±1."""
    rates, phases = rng.uniform(0.4, 1.3, 3), rng.uniform(0, 2 * np.pi, 3)
    return np.sin(2 * np.pi * rates * time[:, None] + phases).mean(axis=1)
