"""Derivatives of joint paths, as frame differences or independent of the frame rate.

The GENEA challenges take frame differences. On captured motion these measure noise and grow with
the frame rate: 30 and 60 fps of one recording differ several times over. To compare frame rates,
paths are low-passed first (4th-order Butterworth, forwards and backwards); the derivative is that
of the quintic spline through them, which does not depend on the positions of the frames.
"""

from __future__ import annotations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.wording import counted

CUTOFF = 6.0
"""Hz; the -6 dB frequency of the low-pass, above the frequencies of gestures."""

_ORDER = 4
_DEGREE = 5


def derivative(paths: np.ndarray, fps: float, order: int, cutoff: float | None) -> np.ndarray:
    """Return the time derivative of paths.

    Args:
        paths: (T, ...) positions, metres.
        fps: frames per second.
        order: 1 for velocity, 2 for acceleration, 3 for jerk.
        cutoff: Hz of the low-pass; None for differences of neighbouring frames, unfiltered.

    Returns:
        (T - order, ...) differences, or (T, ...) of the smoothed paths; m/s^order.

    Raises:
        MotionError: too few frames, or a cutoff at or above half the frame rate.
    """
    least = _DEGREE + 1 if cutoff is not None else order + 1
    if len(paths) < least:
        raise MotionError(
            f"the motion has {counted(len(paths), 'frame')}; at least {least} are needed"
        )
    if cutoff is None:
        return np.diff(paths, n=order, axis=0) * fps**order
    from scipy.interpolate import make_interp_spline

    times = np.arange(len(paths)) / fps
    return make_interp_spline(times, low_passed(paths, fps, cutoff), k=_DEGREE)(times, order)


def low_passed(paths: np.ndarray, fps: float, cutoff: float = CUTOFF) -> np.ndarray:
    """Low-pass paths (T, ...) at `cutoff` Hz without delay.

    Raises:
        MotionError: the cutoff is at or above half the frame rate.
    """
    from scipy.signal import butter, sosfiltfilt

    if not 0 < cutoff < fps / 2:
        raise MotionError(
            f"cutoff {cutoff:g} Hz cannot be filtered at {fps:g} fps; it must lie between 0 and "
            f"{fps / 2:g} Hz"
        )
    sos = butter(_ORDER, cutoff, fs=fps, output="sos")
    # Half a second of reflection at either end, at any frame rate.
    pad = min(len(paths) - 1, round(0.5 * fps))
    return sosfiltfilt(sos, paths, axis=0, padlen=pad)
