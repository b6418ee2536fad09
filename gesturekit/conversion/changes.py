"""Changes that a conversion makes to a motion, besides its format."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import dataclass

from gesturekit.errors import ConfigError, MotionError
from gesturekit.formats.rig import Rig
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import body_joints
from gesturekit.motion.skeleton import Skeleton
from gesturekit.wording import counted


@dataclass(frozen=True)
class Changes:
    """Changes to a motion, made in this order; by default none.

    Attributes:
        trim: (start, end) seconds to keep, rounded to frames; the end may be infinite.
        mirror: exchange left and right.
        rig: rig to retarget to.
        joints: "all", "body" (no fingers, face and end joints), or names to keep.
        fps: frames per second of the result.
        antialias: filter out frequencies above half of a lower frame rate.
    """

    trim: tuple[float, float] | None = None
    mirror: bool = False
    rig: Rig | None = None
    joints: str | tuple[str, ...] = "all"
    fps: float | None = None
    antialias: bool = False

    def __call__(self, motion: Motion) -> tuple[Motion, list[str]]:
        """Return the changed motion, and a phrase for each change.

        Warns:
            UserWarning: a kept joint has to move, because a rotating joint above was removed.

        Raises:
            MotionError: an unknown joint, body parts that cannot be identified, or nothing left
                after trimming.
        """
        done = []
        if self.trim is not None:
            # Some clips of a folder may be shorter than the range.
            start, end = self.trim
            if start >= motion.duration:
                raise MotionError(
                    f"trim leaves nothing: it begins at {start:g} s, the motion lasts "
                    f"{motion.duration:g} s"
                )
            motion = motion.trim(start, min(end, motion.duration))
            done.append(f"cut to {motion.duration:.2f} s")
        if self.mirror:
            motion = motion.mirror()
            done.append("mirrored")
        if self.rig is not None:
            motion = self.rig.put(motion)
            done.append(f"on {self.rig.name}, {counted(motion.skeleton.n_joints, 'joint')}")
        if self.joints != "all":
            before = motion
            motion = motion.keep(self._joints(motion.skeleton))
            if motion is not before:
                done.append(f"{motion.skeleton.n_joints} of {before.skeleton.n_joints} joints")
            if now_moving := sorted(
                set(motion.joint_translations) - set(before.joint_translations)
            ):
                warnings.warn(
                    f"{', '.join(now_moving)}: a parent joint that rotates was removed, so these "
                    "joints get position channels, which some programs ignore",
                    stacklevel=2,
                )
        if self.fps is not None and self.fps != motion.fps:
            done.append(f"{motion.fps:.6g} to {self.fps:.6g} fps")
            motion = motion.resample(self.fps, antialias=self.antialias)
        return motion, done

    def _joints(self, skeleton: Skeleton) -> tuple[str, ...]:
        return body_joints(skeleton) if self.joints == "body" else tuple(self.joints)


def parse_trim(text: str) -> tuple[float, float]:
    """Parse ``"2:10.5"`` as (start, end) seconds; start and end may be left out.

    Raises:
        ConfigError: not an interval, or one that ends before it begins.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)?\s*:\s*(\d+(?:\.\d*)?|\.\d+)?\s*", text)
    if not match or not (match[1] or match[2]):
        raise ConfigError(f"trim {text!r}; write START:END in seconds, as 2:10.5, 2: or :10.5")
    start, end = float(match[1] or 0), float(match[2]) if match[2] else math.inf
    if end <= start:
        raise ConfigError(f"trim {text!r} ends before it begins")
    return start, end
