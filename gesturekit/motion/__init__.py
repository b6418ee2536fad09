"""Motion: skeletons, rotations, kinematics, body parts, contacts, mirroring."""

from gesturekit.motion.face import FaceTrack
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton

__all__ = ["FaceTrack", "Motion", "Skeleton"]
