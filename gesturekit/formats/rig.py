"""Target rigs of retargeting: that of a file, or one of the SMPL family by name."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.gltf.animation import NoAnimationWarning
from gesturekit.formats.smpl.skeleton import RIGS, as_smpl, is_smpl, smpl_skeleton
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton


@dataclass(frozen=True, eq=False)
class Rig:
    """Target rig.

    Attributes:
        name: a file, or smpl, smplh or smplx.
        skeleton: its J joints.
        pose: (J, 4) local rotations in which it stands; None for a rig of the SMPL family.
    """

    name: str
    skeleton: Skeleton
    pose: np.ndarray | None = None

    @classmethod
    def load(cls, name: str | os.PathLike[str], parts: Mapping[str, str] | None = None) -> Rig:
        """Load the rig of a motion file, or one of the SMPL family by name.

        Args:
            name: the file, or smpl, smplh or smplx.
            parts: joints of the file specified by hand, see `Skeleton.parts`.

        Raises:
            FormatError: there is no such file, or it cannot be read.
            MotionError: the file's parts cannot be identified, it never stands, or `parts` are
                given for an SMPL rig, whose parts are known.
        """
        name, parts = os.fspath(name), parts or {}
        if name in RIGS:
            if parts:
                raise MotionError(f"the parts of {name} are fixed; leave out {', '.join(parts)}")
            return cls(name, smpl_skeleton(RIGS[name]))
        if not Path(name).exists():
            raise FormatError(
                f"rig {name!r}: no such file; give a motion file that has the rig, or one of "
                f"{', '.join(RIGS)}"
            )
        from gesturekit.motion.retarget.standing_pose import standing_pose

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NoAnimationWarning)  # a rest pose is enough
            motion = Motion.load(name)
        try:
            motion = motion.with_parts(parts)
            return cls(Path(name).name, motion.skeleton, standing_pose(motion))
        except MotionError as error:
            raise MotionError(f"{name}: {error}") from None

    @property
    def options(self) -> dict[str, dict[str, str]]:
        """Options of writers by suffix: an npz file has the pose vectors of the chosen SMPL rig."""
        return {".npz": {"rig": self.name}} if self.pose is None else {}

    def put(self, motion: Motion) -> Motion:
        """Retarget a motion to this rig; within the SMPL family, copy joints by name.

        Raises:
            MotionError: parts of the motion's rig cannot be identified, or it never stands.
        """
        if self.pose is None and is_smpl(motion.skeleton):
            return as_smpl(motion, self.skeleton.n_joints)
        from gesturekit.motion.retarget import retarget

        return retarget(motion, self.skeleton, pose=self.pose)
