"""Mouth: agreement of its opening with the recorded one, over time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gesturekit.evaluation.metrics.inputs import refuse
from gesturekit.evaluation.metrics.sync import MIN_SHIFT, against_chance
from gesturekit.motion import Motion
from gesturekit.motion.face import FaceTrack
from gesturekit.motion.root_path import side_axis
from gesturekit.motion.rotations import (
    invert_quaternions,
    mean_quaternion,
    multiply_quaternions,
    rotation_vector_from_quaternion,
)

OPENING = "mouth opening"
"""The one face channel of a motion from `with_mouth_alone`."""
MAX_LAG = 0.3
"""Largest lag tried, seconds."""
_STILL = 1e-4  # standard deviation of an opening that does not move


def mouth_opening(motion: Motion) -> np.ndarray | None:
    """Return the opening of the mouth (T,), or None for a motion without one that moves.

    It is the face channel jawOpen or, without it, the angle in radians by which the first joint
    with "jaw" in its name turns from its mean about the body's left-right axis, positive downwards.

    Examples:
        >>> rig = gk.Skeleton(("hips", "jaw"), (-1, 0), [[0, 1, 0], [0, 0.6, 0.1]])
        >>> turns = np.array([[[0, 0, 0, 1], [np.sin(a), 0, 0, np.cos(a)]] for a in (-0.1, 0.1)])
        >>> mouth_opening(gk.Motion(rig, turns, np.zeros((2, 3)), 30)).round(3)
        array([-0.2,  0.2])
    """
    opening, face = None, motion.face
    channels = () if face is None else {OPENING, "jawOpen"} & {*face.names}
    jaws = (j for j, name in enumerate(motion.skeleton.names) if "jaw" in name.lower())
    if face is not None and channels:
        opening = face.channel(min(channels))
    elif (jaw := next(jaws, None)) is not None:
        turns = motion.rotations[:, jaw]
        turns = multiply_quaternions(invert_quaternions(mean_quaternion(turns)), turns)
        opening = rotation_vector_from_quaternion(turns) @ side_axis([motion], jaw)
    return None if opening is None or opening.std() < _STILL else opening


def with_mouth_alone(motion: Motion) -> Motion:
    """Return the motion with the opening of its mouth as the only channel of its face."""
    opening = mouth_opening(motion)
    face = None if opening is None else FaceTrack((OPENING,), opening[:, None])
    return replace(motion, face=face)


def mouth_agreement(mouth: np.ndarray, recorded_mouth: np.ndarray, fps: float) -> dict[str, float]:
    """Return how well the opening of a mouth agrees with the recorded one.

    Pearson's r of both over their common frames, of which one is shifted circularly: `mouth`, r
    without a shift; `mouth_lag`, the shift in seconds within ±0.3 s at which r is largest, positive
    for a mouth that is late; `mouth_chance`, the mean of r over all shifts by more than 1 s, which
    is about 0; and `mouth_z`, r above that in standard deviations over these shifts.

    Args:
        mouth: (T,) opening, in any unit.
        recorded_mouth: (T',) recorded opening, in any unit.
        fps: frames per second of both.

    Raises:
        EvaluationError: less than 3 s in common, or a mouth that does not move within them.

    Examples:
        >>> mouth = np.random.default_rng(0).random(300)
        >>> mouth_agreement(mouth[:-3], mouth[3:], 30)["mouth_lag"]
        0.1
    """
    n = min(len(mouth), len(recorded_mouth))
    ours, theirs = mouth[:n], recorded_mouth[:n]
    refuse(
        (n < 3 * fps, f"{n / fps:.1f} s of mouths in common; expected at least 3 s"),
        (min(ours.std(), theirs.std()) < _STILL, "a mouth does not move"),
    )
    ours, theirs = ((side - side.mean()) / side.std() for side in (ours, theirs))
    # r at every circular shift: by the convolution theorem.
    r = np.fft.irfft(np.fft.rfft(ours) * np.conj(np.fft.rfft(theirs)), n) / n
    shift = np.arange(n)
    shift[shift > n // 2] -= n
    best = np.where(np.abs(shift) <= MAX_LAG * fps + 1e-9, r, -np.inf).argmax()
    mean, _, z, _ = against_chance(float(r[0]), r[np.abs(shift) > MIN_SHIFT * fps], n / fps)
    lag = float(shift[best] / fps)
    return {"mouth": float(r[0]), "mouth_lag": lag, "mouth_chance": mean, "mouth_z": z}
