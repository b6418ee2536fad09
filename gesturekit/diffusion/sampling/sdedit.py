"""SDEdit (Meng et al. 2022): start sampling from a noised motion instead of from pure noise.

The motion is noised up to some step of the schedule and denoised from there. Structure coarser than
the noise is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.composition.experts import MAX_DEVIATION
from gesturekit.diffusion.sampling.solvers import last_step_with_signal
from gesturekit.diffusion.trained_model import TrainedModel
from gesturekit.errors import ModelError
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.training.data.own_rig import on_rig


@dataclass(frozen=True, eq=False)
class SDEditStart:
    """A motion from which sampling starts.

    Attributes:
        model: the model that continues from it.
        motion: on the model's rig, at its frame rate.
        lift: metres that the motion must be raised to stand on the model's floor.
        step: of the noise schedule, up to which the motion is noised.
    """

    model: TrainedModel
    motion: Motion
    lift: float
    step: int

    @classmethod
    def build(cls, model: TrainedModel, like: str | Path | Motion, change: float) -> SDEditStart:
        """Put a motion on the model's rig and choose the noise level.

        Args:
            model: the model that continues from it.
            like: a motion of any human rig, or its file.
            change: above 0, at most 1: the noise level, from the first step of the schedule to the
                last one with any signal, evenly in log signal-to-noise ratio. It is also the
                fraction of a few-step solver's steps that remain.

        Raises:
            ModelError: a change out of range, or a motion that cannot be put on the rig.
            FormatError: a file that cannot be read.
        """
        if not 0 < change <= 1:
            raise ModelError(f"change={change:g}: give more than 0 (no change) and at most 1")
        given = like if isinstance(like, Motion) else Motion.load(like)
        motion, lift = on_rig(model.representation, given), 0.0
        if motion is not given:
            # The floor of a foreign file is unknown; that of this rig is known.
            lift = _floor_of_model(model) - floor_height(motion)
        motion = motion.resample(model.fps)
        level = model.schedule.log_snr()[: last_step_with_signal(model.schedule) + 1]
        wanted = level[0] + change * (level[-1] - level[0])
        return cls(model, motion, lift, int((level - wanted).abs().argmin()))

    @property
    def path(self) -> RootPath:
        """The path of its root over the ground."""
        return self.model.representation.path_of(self.motion)

    @property
    def place(self) -> tuple[float, float, float]:
        """x and z in metres and heading in radians of its first frame."""
        path = self.path
        return (*path.positions[0], path.headings[0])

    def clean(self, n_frames: int) -> Tensor:
        """Return the standardised motion (T, X), cut or extended with its last pose to T frames."""
        own = self.model.representation
        values = own.encode(self.motion.resample(self.model.fps, n_frames))
        values[:, own.height_column] += self.lift / own.scale
        vectors = self.model.standardiser.forward(torch.from_numpy(values).float())
        # Another rig may bend joints that hardly move in the training data.
        return vectors.clamp(-MAX_DEVIATION, MAX_DEVIATION).to(self.model.device)


def _floor_of_model(model: TrainedModel) -> float:
    """Return the height of the lowest joint in the rig's mean pose, in metres."""
    own = model.representation
    height = float(model.standardiser.mean[own.height_column]) * own.scale
    place = np.array([[0.0, height, 0.0]])
    return floor_height(own.assemble(own.fixed_pose(1), place, model.fps, None))
