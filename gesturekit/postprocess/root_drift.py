"""What both feet slide together is the body's drift: the hips give it up, not the legs."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

_STEADY = 0.2
"""Seconds over which the speed of a foot is averaged before two feet are compared."""
_SWAY = 1.0
"""Seconds; what is faster than this is sway, which the legs take up, and no drift."""


def drift(left: np.ndarray, right: np.ndarray, stands: np.ndarray, fps: float) -> np.ndarray:
    """(T, 3) how far the standing feet have slid until each frame, sway left out.

    Two feet that stand slide together by what their speeds have in common; one that stands alone,
    by its own. Horizontal, and zero in frame 0.

    Args:
        left: (T, 3) of the left foot, metres.
        right: (T, 3) of the right one.
        stands: (T, 2) bool, which of them stand.
        fps: frames per second.
    """
    both = np.stack([left, right], axis=1)
    held = np.zeros(stands.shape)
    held[1:] = stands[1:] & stands[:-1]
    steps = np.diff(both, axis=0, prepend=both[:1]) * [1, 0, 1] * held[..., None]
    around = gaussian_filter1d(held, _STEADY * fps, axis=0, mode="constant")[..., None]
    steady = gaussian_filter1d(steps, _STEADY * fps, axis=0, mode="constant")
    steady /= np.maximum(around, 1e-6)
    path = _smooth(np.cumsum(_common(steady, held), axis=0), _SWAY * fps)
    return path - path[0]


def rise(heights: np.ndarray, stands: np.ndarray, fps: float) -> np.ndarray:
    """(T,) metres by which the standing feet are too high together, or too low, wobble left out.

    Args:
        heights: (T, 2) of the feet above where they stand, metres.
        stands: (T, 2) bool, which of them stand.
        fps: frames per second.
    """
    held = stands.astype(float)
    common = _common(heights[..., None] * held[..., None], held)
    sure = _smooth(held.max(axis=1), _SWAY * fps)
    return _smooth(common[:, 0], _SWAY * fps) / np.maximum(sure, 0.5)


def _common(both: np.ndarray, held: np.ndarray) -> np.ndarray:
    """(T, D) what two feet (T, 2, D) share: of one that stands alone all, of two along their mean
    as much as the one that goes less far."""
    alone = (both * held[..., None]).sum(axis=1)
    mean = both.mean(axis=1)
    way = mean / np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-12)
    least = (both * way[:, None]).sum(axis=-1).min(axis=1)
    together = way * np.maximum(least, 0)[:, None]
    return np.where(held.all(axis=1)[:, None], together, alone)


def _smooth(path: np.ndarray, frames: float) -> np.ndarray:
    """Mirrored about its ends, so that a steady drift stays one to the last frame."""
    margin = min(round(4 * frames), len(path) - 1)
    around = ((margin, margin),) + ((0, 0),) * (path.ndim - 1)
    padded = np.pad(path, around, mode="reflect", reflect_type="odd")
    return gaussian_filter1d(padded, frames, axis=0)[margin : margin + len(path)]
