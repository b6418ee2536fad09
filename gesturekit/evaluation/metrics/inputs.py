"""Inputs of metrics: motion at a common frame rate, and checks that all of them share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sized

import numpy as np

from gesturekit.errors import EvaluationError, MotionError
from gesturekit.motion import Motion
from gesturekit.wording import counted, listed

RULE = "Lanczos low-pass at half the lower frame rate, then resampled; higher rates interpolated"
"""Description of `at_rate`, part of every evaluation's settings."""

_SAME = 1e-3  # relative difference below which rates differ only by rounding


def at_rate(motion: Motion, fps: float) -> Motion:
    """Resample a motion to `fps` without aliasing.

    The motion is low-passed first if the rate falls: dropping frames alone would alias fast
    movement and capture noise, and a recording at 120 fps would look rougher than one at 30. A
    motion that has this rate (to a thousandth) is returned as it is.
    """
    if abs(motion.fps - fps) <= _SAME * fps:
        return motion
    return motion.resample(fps, antialias=True)


def refuse(*problems: tuple[bool | np.bool, str]) -> None:
    """Raise an error with the message of the first (condition, message) that holds.

    Raises:
        EvaluationError: a condition holds.
    """
    if text := next((text for holds, text in problems if holds), ""):
        raise EvaluationError(text)


def check_choice(what: str, value: str, choices: Iterable[str]) -> None:
    """Raise an EvaluationError unless a value is one of the choices."""
    names = list(choices)
    if value not in names:
        raise EvaluationError(f"{what} {value!r}; expected {' or '.join(names)}")


def check_frames(frames: Sized, least: int, fps: float) -> None:
    """Raise a MotionError for fewer than `least` frames."""
    if (n := len(frames)) < least:
        raise MotionError(
            f"the motion has {counted(n, 'frame')} at {fps:g} fps; at least {least} are needed"
        )


def check_joints(motion: Motion, joints: Iterable[str]) -> None:
    """Raise an EvaluationError unless a motion has all of the joints."""
    if missing := sorted(set(joints) - set(motion.skeleton.names)):
        raise EvaluationError(
            f"{motion_name(motion)} has no joint {listed(missing, 5)}, which the other motions "
            "have; give motions of one rig, or retarget them to it"
        )


def motion_name(motion: Motion) -> str:
    """Return the name of a motion for errors: its file, or its description."""
    return str(motion.info.get("source") or motion)


def checked_rows(
    sets: Mapping[str, np.ndarray], row: str = "frame", least: int = 1
) -> list[np.ndarray]:
    """Return arrays (n, D) of one dimension D as float64.

    Args:
        sets: {name for errors: array}.
        row: name of a row for errors.
        least: number of rows of each array, at least.

    Raises:
        EvaluationError: other shapes, too few rows, or numbers that are not finite.
    """
    arrays: list[np.ndarray] = []
    for name, values in sets.items():
        array = np.ascontiguousarray(values, dtype=np.float64)
        if array.ndim != 2 or not array.shape[1]:
            raise EvaluationError(f"{name} has shape {array.shape}; expected ({row}s, numbers)")
        arrays.append(array)
        (n, width), first = array.shape, arrays[0].shape[1]
        bad = np.flatnonzero(~np.isfinite(array).all(axis=1)).tolist()
        refuse(
            (n < least, f"{name} has {counted(n, row)}; at least {least} needed"),
            (bad != [], f"{name} holds NaN or infinity in {row} {listed(list(map(str, bad)), 3)}"),
            (
                width != first,
                f"{next(iter(sets))} has {first} numbers a {row}, {name} {width}: they must be "
                "features of one kind and rig",
            ),
        )
    return arrays
