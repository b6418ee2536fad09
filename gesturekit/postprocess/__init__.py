"""Postprocessing of generated motion: foot locking and smoothing."""

from gesturekit.postprocess.foot_lock import lock_feet
from gesturekit.postprocess.smoothing import smooth_motion

__all__ = ["lock_feet", "smooth_motion"]
