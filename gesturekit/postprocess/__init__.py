"""Postprocessing of generated motion: foot locking, smoothing and placement."""

from gesturekit.postprocess.foot_lock import lock_feet
from gesturekit.postprocess.placement import Placement
from gesturekit.postprocess.smoothing import smooth_motion

__all__ = ["Placement", "lock_feet", "smooth_motion"]
