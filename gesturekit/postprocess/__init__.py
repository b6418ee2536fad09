"""What a generated motion goes through before it is written: feet that stay put, less jitter."""

from gesturekit.postprocess.foot_lock import lock_feet
from gesturekit.postprocess.smoothing import smooth_motion

__all__ = ["lock_feet", "smooth_motion"]
