"""Hand movement as figures of the report."""

from __future__ import annotations

from gesturekit.evaluation.metrics.life import Motions, hand_movement

_HANDS = {
    "q10": ("hand_q10", 1.0),
    "q50": ("hand_q50", 1.0),
    "q90": ("hand_q90", 1.0),
    "q99": ("hand_q99", 1.0),
    "rest": ("rest", 100.0),
    "near_still": ("near_still", 100.0),
    "reach": ("reach", 1.0),
    "range": ("speed_range", 1.0),
}  # field of `HandMovement`: key of `definitions`, factor to its unit

HAND_KEYS = tuple(key for key, _ in _HANDS.values())
"""Keys of `definitions` of the hand movement."""


def hand_figures(motions: Motions) -> dict[str, float]:
    """Return {key of `definitions`: value} of the hand movement of motions, pooled.

    A value that is not defined is NaN.

    Raises:
        MotionError: as `hand_movement`.
    """
    found = hand_movement(motions)
    return {key: factor * getattr(found, name) for name, (key, factor) in _HANDS.items()}
