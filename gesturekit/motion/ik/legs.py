"""Legs that reach given feet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gesturekit.motion.ik.two_bone import two_bone_ik
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import require_legs
from gesturekit.motion.rotations import invert_quaternions, multiply_quaternions


def reach_feet(motion: Motion, ankles: np.ndarray, turns: np.ndarray) -> Motion:
    """Bend the legs so that the ankles are at given places, and turn the feet.

    A foot that is out of reach moves by as much as its leg is short.

    Args:
        motion: T frames of a rig with two legs.
        ankles: (T, 2, 3) world positions of the left and the right ankle, metres.
        turns: (T, 2, 4) world rotations of the ankle joints.
    """
    rig, rotations = motion.skeleton, motion.rotations.copy()
    legs = require_legs(rig).values()
    positions, world = motion.positions(), motion.global_rotations()
    for k, leg in enumerate(legs):
        hip, knee, ankle = (rig.index(name) for name in (leg.hip, leg.knee, leg.ankle))
        rotations[:, [hip, knee]] = two_bone_ik(
            positions[:, [hip, knee, ankle]],
            ankles[:, k],
            rotations[:, [hip, knee]],
            world[:, [rig.parents[hip], rig.parents[knee]]],
        )
    reached = replace(motion, rotations=rotations).global_rotations()
    for k, leg in enumerate(legs):
        ankle = rig.index(leg.ankle)
        back = invert_quaternions(reached[:, rig.parents[ankle]])
        rotations[:, ankle] = multiply_quaternions(back, turns[:, k])
    return replace(motion, rotations=rotations)
