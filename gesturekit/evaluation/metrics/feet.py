"""Feet and floor: how much standing feet slide, and how far they sink.

A foot point stands where it is near its own height above the ground. That height is taken from
the frames in which the point is at rest, so that neither a file's floor nor the place of an ankle
joint in a foot has to be known; a generated motion is measured against its recording's.
"""

from __future__ import annotations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion import Motion
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.contacts import contact_labels, foot_positions

NEAR = 0.025
"""Metres on the reference body above its standing height where a foot point is in the air: H of
Zhang et al. 2018."""


def standing_heights(motion: Motion) -> np.ndarray:
    """Height of each foot point while it stands: the median over frames in contact.

    A point that never stands gives the lowest tenth of its heights.

    Returns:
        (F,) metres, in the order of `gesturekit.motion.contacts.foot_points`.

    Raises:
        MotionError: legs that cannot be told.
    """
    heights = _feet(motion)[..., 1]
    resting = contact_labels(motion) > 0
    return np.array(
        [
            np.median(point[rests]) if rests.any() else np.quantile(point, 0.1)
            for point, rests in zip(heights.T, resting.T, strict=True)
        ]
    )


def foot_skate(motion: Motion, heights: np.ndarray | None = None) -> float:
    """Mean horizontal speed of the foot points while they are near the ground, m/s.

    v·(2 - 2^(h/H)), h the height above standing clipped to 0 ... H = 2.5 cm on the reference
    body, averaged over frames and foot points: the foot skate of Zhang et al. 2018 (MANN), as a
    speed instead of a length per frame, so that the frame rate is no matter.

    Args:
        motion: at least 2 frames.
        heights: (F,) standing heights, metres; None takes the motion's own.

    Raises:
        MotionError: fewer than 2 frames, or legs that cannot be told.
    """
    if motion.n_frames < 2:
        raise MotionError(f"the motion has {motion.n_frames} frame; at least 2 are needed")
    feet = _feet(motion)
    steps = np.diff(feet[..., [0, 2]], axis=0) * motion.fps
    above = 0.5 * (feet[1:, :, 1] + feet[:-1, :, 1]) - _standing(motion, heights)
    above = above / (NEAR * body_scale(motion.skeleton))
    weight = 2.0 - 2.0 ** np.clip(above, 0.0, 1.0)
    return float((np.linalg.norm(steps, axis=-1) * weight).mean())


def floor_penetration(motion: Motion, heights: np.ndarray | None = None) -> float:
    """Mean depth of the foot points below where they stand, metres; 0 above it.

    Args:
        motion: any number of frames.
        heights: (F,) standing heights, metres; None takes the motion's own, which cannot show
            that a whole body is sunk.

    Raises:
        MotionError: legs that cannot be told.
    """
    depth = _standing(motion, heights) - _feet(motion)[..., 1]
    return float(np.maximum(depth, 0.0).mean())


def _feet(motion: Motion) -> np.ndarray:
    """Return the (T, F, 3) foot points, of which there must be some."""
    feet = foot_positions(motion)
    if not feet.shape[1]:
        raise MotionError("the rig has no two legs that can be identified")
    return feet


def _standing(motion: Motion, heights: np.ndarray | None) -> np.ndarray:
    return standing_heights(motion) if heights is None else heights
