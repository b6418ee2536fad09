"""Synthetic dance: every pose is on a beat, every movement between two beats.

Each bar has a random move and random pose sizes. Hips and head go up and down with every second
beat; the feet stand still. The dance depends on the beat times only.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gesturekit.motion.motion import Motion

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "demo"))
from rig import STANDING_HEIGHT, Arm, pose  # noqa: E402

FPS = 60.0
_HOLD = 0.06
"""Share of a beat for which a pose is held before and after it."""

# Positions of the left wrist in the chest's frame, in metres.
_WRISTS = {
    "low": (0.25, -0.30, 0.15),
    "home": (0.20, -0.16, 0.28),
    "up": (0.40, 0.42, 0.12),
    "side": (0.56, 0.10, 0.12),
    "front": (0.14, 0.06, 0.46),
    "cross": (0.02, -0.02, 0.34),
}
# What both hands do on the four beats of a bar (left, right), and the twist of the spine: radians
# to the left.
_MOVES = (
    (("up", "home", 0.2), ("home", "up", -0.2), ("up", "home", 0.2), ("home", "up", -0.2)),
    (("side", "side", 0.0), ("cross", "cross", 0.0), ("side", "side", 0.0), ("front", "front", 0)),
    (("up", "up", 0.0), ("home", "home", 0.3), ("up", "up", 0.0), ("home", "home", -0.3)),
    (
        ("front", "low", -0.35),
        ("low", "front", 0.35),
        ("front", "low", -0.35),
        ("low", "side", 0.3),
    ),
    (("side", "cross", 0.3), ("cross", "side", -0.3), ("side", "up", 0.2), ("up", "side", -0.2)),
)
_DIP, _SWAY = 0.075, 0.05  # metres, of the hips


def dance(beats: np.ndarray, seconds: float, rng: np.random.Generator) -> Motion:
    """Return a dance of `seconds` to beats at these times (B,) in seconds."""
    # Extend the beats by a bar on both sides, so that the track begins and ends within the dance.
    gaps = np.diff(beats)
    times = np.concatenate(
        [beats[0] - gaps[0] * np.arange(4, 0, -1), beats, beats[-1] + gaps[-1] * np.arange(1, 5)]
    )
    rows = np.array([row for _ in range(0, len(times), 4) for row in _bar(rng)])[: len(times)]
    time = np.arange(round(seconds * FPS)) / FPS
    values = _between(time, times, rows)
    left, right = values[:, 0:3], values[:, 3:6]
    twist, dip, sway, nod = values[:, 6:].T
    still = np.zeros_like(time)
    hips = np.stack([sway, STANDING_HEIGHT - 0.012 - dip, -0.2 * dip], axis=-1)
    pelvis = Rotation.from_euler("YXZ", np.stack([0.4 * twist, 0.9 * dip, -0.8 * sway], axis=-1))
    spine = np.stack([1.2 * dip, 0.6 * twist, -1.5 * sway], axis=-1)
    head = np.stack([nod, -0.5 * twist, 1.0 * sway], axis=-1)
    arms = [
        Arm(wrist, still - 0.1, still, 0.4 * np.maximum(wrist[:, 1], 0)) for wrist in (left, right)
    ]
    return pose(FPS, hips, pelvis, spine, head, *arms)


def _bar(rng: np.random.Generator) -> list[np.ndarray]:
    """Draw four poses (10,): both wrists (the right one mirrored), twist, dip, sway, nod."""
    move = _MOVES[rng.integers(len(_MOVES))]
    flipped = rng.random() < 0.5
    size = rng.uniform(0.85, 1.1)
    poses = []
    for number, (left, right, twist) in enumerate(move):
        sides = [np.array(_WRISTS[name]) + 0.015 * rng.standard_normal(3) for name in (left, right)]
        if flipped:
            sides, twist = sides[::-1], -twist
        low = number % 2 == 0
        dip = size * rng.uniform(0.8, 1.1) * (_DIP if low else 0.1 * _DIP)
        sway = size * _SWAY * (1 if (number % 4 < 2) != flipped else -1)
        poses.append(
            np.array([*sides[0], *sides[1], size * twist, dip, sway, 0.22 if low else -0.05])
        )
    return poses


def _between(time: np.ndarray, beats: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Interpolate poses (B, D) to (T, D) by minimum-jerk movements (Flash & Hogan 1985)."""
    k = np.clip(np.searchsorted(beats, time, side="right") - 1, 0, len(beats) - 2)
    share = (time - beats[k]) / (beats[k + 1] - beats[k])
    x = np.clip((share - _HOLD) / (1 - 2 * _HOLD), 0.0, 1.0)[:, None]
    return rows[k] + x**3 * (10 - 15 * x + 6 * x * x) * (rows[k + 1] - rows[k])
