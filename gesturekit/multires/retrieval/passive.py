"""Fingers, other joints and the face that move in the recordings but are not modelled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import quaternion_from_sixd, sixd_from_quaternion

_FRAMES_AT_ONCE = 1024
"""Frames decoded in one call, which bounds the memory of long motions."""
_STILL = 0.01
"""Standard deviation of a rotation's six numbers below which a joint does not move."""


@dataclass(frozen=True)
class PassiveChannels:
    """Fingers and other joints that move in the recordings but are not modelled, and the face.

    Attributes:
        joints: names of the F joints.
        expressions: number E of SMPL-X face coefficients.
    """

    joints: tuple[str, ...] = ()
    expressions: int = 0

    @property
    def is_empty(self) -> bool:
        """True without such joints and without a face."""
        return not self.joints and not self.expressions

    @classmethod
    def find(cls, motions: Sequence[Motion], modelled: Sequence[str]) -> PassiveChannels:
        """Find the channels that move in the motions of one rig but are not modelled."""
        moving = []
        for j, name in enumerate(motions[0].skeleton.names):
            if name not in modelled:
                sixd = [sixd_from_quaternion(motion.rotations[:, j]) for motion in motions]
                if np.concatenate(sixd).std(axis=0).max() > _STILL:
                    moving.append(name)
        faces = [motion.expressions for motion in motions]
        widths = {0 if face is None else face.shape[1] for face in faces}
        return cls(tuple(moving), widths.pop() if len(widths) == 1 else 0)

    def encode(self, motion: Motion) -> Tensor:
        """Return (6 F + E, T) float32 rotations and face coefficients."""
        index = [motion.skeleton.index(name) for name in self.joints]
        rows = sixd_from_quaternion(motion.rotations[:, index]).reshape(motion.n_frames, -1)
        if self.expressions:
            rows = np.concatenate([rows, motion.expressions], axis=1)
        return torch.from_numpy(np.ascontiguousarray(rows.T)).float()

    def applied(self, motion: Motion, values: Callable[[slice], Tensor]) -> Motion:
        """Return the motion (T frames) with these channels.

        Args:
            motion: on the rig.
            values: returns the channels (6 F + E, N) of a range of its frames.
        """
        rotations = motion.rotations.copy()
        index = [motion.skeleton.index(name) for name in self.joints]
        face = np.empty((motion.n_frames, self.expressions))
        for start in range(0, motion.n_frames, _FRAMES_AT_ONCE):
            part = slice(start, min(start + _FRAMES_AT_ONCE, motion.n_frames))
            rows = values(part).T.double().numpy()
            if index:
                sixd = rows[:, : 6 * len(index)].reshape(len(rows), len(index), 6)
                rotations[part, index] = quaternion_from_sixd(sixd)
            face[part] = rows[:, 6 * len(index) :]
        expressions = face if self.expressions else motion.expressions
        return replace(motion, rotations=rotations, expressions=expressions)
