"""Foot skate and floor penetration.

A foot point touches the ground when it is near its standing height. That height is estimated from
the frames in which the point is at rest, so that neither the floor of a file nor the position of
the ankle joint in the foot has to be known; a generated motion uses the heights of its recording.
"""

from __future__ import annotations

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion import Motion
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.contacts import contact_labels, foot_positions
from gesturekit.motion.parts import is_upper_body

NEAR = 0.025
"""H of Zhang et al. 2018: height above standing from which a foot point is in the air, metres on
the reference body."""


def standing_heights(motion: Motion) -> np.ndarray:
    """Return the standing height of each foot point: the median over frames in contact.

    For a point without contact, the 10 % quantile of its heights.

    Returns:
        (F,) metres, in the order of `gesturekit.motion.contacts.foot_points`.

    Raises:
        MotionError: no legs, or none that can be identified.
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
    """Return the mean horizontal speed of the foot points near the ground, m/s.

    v·(2 - 2^(h/H)), h the height above standing clipped to 0 ... H = 2.5 cm on the reference
    body, averaged over frames and foot points: the foot skate of Zhang et al. 2018 (MANN), as a
    speed instead of a length per frame, so that it does not depend on the frame rate.

    Args:
        motion: at least 2 frames.
        heights: (F,) standing heights, metres; None takes the motion's own.

    Raises:
        MotionError: fewer than 2 frames, or no legs, or none that can be identified.
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
    """Return the mean depth of the foot points below their standing heights, metres.

    Args:
        motion: any number of frames.
        heights: (F,) standing heights, metres; None takes the motion's own, which cannot
            detect that the whole body is too low.

    Raises:
        MotionError: no legs, or none that can be identified.
    """
    depth = _standing(motion, heights) - _feet(motion)[..., 1]
    return float(np.maximum(depth, 0.0).mean())


def _feet(motion: Motion) -> np.ndarray:
    """Return the (T, F, 3) foot points; raise MotionError if there are none."""
    feet = foot_positions(motion)
    if not feet.shape[1]:
        legs = "legs" if is_upper_body(motion.skeleton) else "two legs that can be identified"
        raise MotionError(f"the rig has no {legs}")
    return feet


def _standing(motion: Motion, heights: np.ndarray | None) -> np.ndarray:
    return standing_heights(motion) if heights is None else heights
