"""Plausibility of a motion that was read without error: frame rate, unit, size, axes, fingers."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.formats.axes import standing_axis
from gesturekit.motion.kinematics import forward_kinematics
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs
from gesturekit.motion.parts.body_size import body_height, first_fork, stature
from gesturekit.motion.resampling import COMMON_RATES
from gesturekit.motion.skeleton import Skeleton
from gesturekit.wording import listed

SLOWEST, FASTEST = 1.0, 1000.0
"""Range of plausible frame rates, frames per second."""
SMALLEST, TALLEST = 0.3, 5.0
"""Range of plausible body heights, metres."""


def plausibility_warnings(motion: Motion, reading: Mapping[str, Any]) -> list[str]:
    """Return a line for each implausible property, with the option that corrects it.

    Args:
        motion: the motion as read.
        reading: options it was read with, see `gesturekit.formats.conversion.load`.
    """
    lines = []
    if "fps" not in reading and not SLOWEST <= motion.fps <= FASTEST:
        lines.append(_rate(motion))
    if keys := motion.info.get("unread_hands"):
        lines.append(
            f"fingers are still: {listed(keys, 4)} are not read; write them into 'poses' of SMPL-X "
            "as rotation vectors: PCA coefficients (T, N) of the left hand are poses[:, 75:120] = "
            "pca @ hands_componentsl[:N] + hands_meanl, with arrays of the SMPL-X model file; the "
            "right hand is poses[:, 120:165]"
        )
    bones = motion.skeleton.offsets[1:]
    if len(bones) and not bones.any():
        return [*lines, "all bones have length 0: there is no body to see or to measure"]
    named = [name for name in ("unit", "height") if name in reading]
    with suppress(MotionError):  # a rig without height
        if named and not SMALLEST <= (height := body_height(motion.skeleton)) <= TALLEST:
            option = {"unit": "--in-unit", "height": "--height"}[named[-1]]
            lines.append(f"{option} {reading[named[-1]]} makes the body {height:.2f} m tall")
    if "up" in reading and standing_axis(motion) not in (None, "y"):
        lines.append(
            f"--in-up {reading['up']} lays the body down; without it the file's own axis is found"
        )
    if _toes_point_backwards(motion):
        lines.append(
            "the toes point backwards, as left and right are named: did the export mirror the body "
            "(left-handed axes), or swap the names? Export it again"
        )
    return lines


def _toes_point_backwards(motion: Motion) -> bool:
    """Return whether both feet point backwards in the mean, seen from hips and joint names."""
    legs = find_legs(motion.skeleton)
    if legs is None or any(leg.toe is None for leg in legs.values()):
        return False
    positions = motion.positions()
    place = {
        side: [positions[:, motion.skeleton.index(j)] for j in (leg.hip, leg.ankle, leg.toe) if j]
        for side, leg in legs.items()
    }
    across = place["left"][0] - place["right"][0]
    forward = np.stack([-across[:, 2], across[:, 0]], axis=-1)[:, None]
    feet = np.stack([toe - ankle for _, ankle, toe in place.values()], axis=1)[..., ::2]
    along = (feet * forward).sum(axis=-1)
    lengths = np.linalg.norm(feet, axis=-1) * np.linalg.norm(forward, axis=-1)
    return bool((along.mean(axis=0) < -0.5 * lengths.mean(axis=0)).all())


def _rate(motion: Motion) -> str:
    """Return a question about an implausible frame rate, with a likely one."""
    period = 1 / motion.fps
    if motion.fps > FASTEST:
        question, likely = "is Frame Time 1000 times too small", motion.fps / 1000
    elif np.isclose(period, COMMON_RATES, rtol=1e-3).any():
        question, likely = "does Frame Time hold the rate", period
    else:
        question, likely = "is Frame Time in milliseconds", 1000 * motion.fps
    if "frame_time" not in motion.info:
        question = "is its rate right"
    nearest = min(COMMON_RATES, key=lambda rate: abs(rate - likely))
    likely = nearest if abs(nearest - likely) < 0.01 * likely else likely
    rate = f"{likely:.4g}" if likely >= SLOWEST else "RATE"
    here = f"{motion.fps:.2g}" if motion.fps < SLOWEST else f"{motion.fps:.0f}"
    return f"{here} fps: {question}? --in-fps {rate} sets the rate"


METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "cmu": 0.0254 / 0.45}
"""Metres in a unit of length; "cmu" is that of the CMU motion capture database, 5.64 cm."""

# Metres from ankle to head joint along the bones, 1.3 to 1.5 on adults. The ratio is small enough
# that "cm" and "inch" (2.54), or "inch" and "cmu" (2.22), do not overlap.
_SHORTEST, _TALLEST = 0.9, 2.1


def guess_unit(skeleton: Skeleton, rotations: np.ndarray) -> tuple[str, bool]:
    """Return the unit that gives the body the size of a person, and whether that is certain.

    Args:
        skeleton: rig in the file's unit, J joints.
        rotations: (J, 4) local quaternions of one pose; used only if the body parts cannot be
            identified.
    """
    try:
        height = stature(skeleton)
    except MotionError:
        # Joints above the first fork may lie anywhere between the origin and the body.
        positions = forward_kinematics(rotations, np.zeros(3), skeleton)
        fork = first_fork(skeleton)
        reach = np.ptp(positions[[fork, *skeleton.descendants(fork)]], axis=0).max()
        return "m" if reach < 8 else "cm" if reach < 500 else "mm", False
    for unit in ("m", "cm", "mm", "inch", "cmu"):
        if _SHORTEST <= height * METRES[unit] <= _TALLEST:
            return unit, True
    middle = np.log((_SHORTEST * _TALLEST) ** 0.5)
    usual = ("m", "cm", "mm")
    off = [abs(np.log(max(height, 1e-12) * METRES[unit]) - middle) for unit in usual]
    return usual[int(np.argmin(off))], False
