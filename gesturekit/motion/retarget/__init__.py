"""Transfer motion to another rig."""

from gesturekit.motion.retarget.transfer import retarget

__all__ = ["retarget"]
