"""Transfer motion to another rig."""

from gesturekit.motion.retarget.transfer import Transfer, retarget

__all__ = ["Transfer", "retarget"]
