"""A motion to begin from in place of noise: SDEdit of Meng et al. (2022), for motion.

The motion is noised up to some step of the diffusion, and denoised from there by what the model
knows and is told. What is coarser than the noise stays as it was given.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.composition.experts import FARTHEST
from gesturekit.diffusion.sampling.solvers import last_audible
from gesturekit.errors import ModelError
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.training.data.own_rig import on_rig

if TYPE_CHECKING:
    from gesturekit.diffusion.model import DiffusionModel

CHANGE = 0.5
"""How much of a motion changes unless something else is asked for."""


@dataclass(frozen=True, eq=False)
class Start:
    """What a motion begins from.

    Attributes:
        model: that is to go on from it.
        motion: on the model's rig, at its frame rate.
        lift: metres that its floor lies below the model's.
        step: of the schedule, up to which it is noised.
    """

    model: DiffusionModel
    motion: Motion
    lift: float
    step: int

    @classmethod
    def of(cls, model: DiffusionModel, like: str | Path | Motion, change: float) -> Start:
        """A start for a model.

        Args:
            model: whose rig and schedule count.
            like: a motion of any rig of a person, or the file it is in.
            change: above 0, at most 1: how far up it is noised, from the first step of the schedule
                to the last that has any motion in it, evenly in log signal-to-noise. That is the
                share of a quick solver's steps that are left to take.

        Raises:
            ModelError: a change out of range, or a motion that cannot be put on the rig.
            FormatError: a file that cannot be read.
        """
        if not 0 < change <= 1:
            raise ModelError(f"change={change:g}: give more than 0 (all stays) and at most 1")
        given = like if isinstance(like, Motion) else Motion.load(like)
        motion, lift = on_rig(model.representation, given), 0.0
        if motion is not given:
            # Where the floor of a foreign file lies nobody knows; where this rig's does, we do.
            lift = _floor_of_model(model) - floor_height(motion)
        motion = motion.resample(model.fps)
        level = model.schedule.log_snr()[: last_audible(model.schedule) + 1]
        wanted = level[0] + change * (level[-1] - level[0])
        return cls(model, motion, lift, int((level - wanted).abs().argmin()))

    @property
    def path(self) -> RootPath:
        """The way of its root over the ground."""
        return self.model.representation.path_of(self.motion)

    @property
    def place(self) -> tuple[float, float, float]:
        """x, z in metres and heading in radians where it begins."""
        path = self.path
        return (*path.positions[0], path.headings[0])

    def clean(self, n_frames: int) -> Tensor:
        """(T, X) standardised, T = n_frames: cut off there, or standing still at its end."""
        values = self.model.representation.encode(self.motion.resample(self.model.fps, n_frames))
        own = self.model.representation
        values[:, own.height_column] += self.lift / own.scale
        vectors = self.model.standardiser.forward(torch.from_numpy(values).float())
        # Another rig may bend where this one hardly can.
        return vectors.clamp(-FARTHEST, FARTHEST).to(self.model.device)


def _floor_of_model(model: DiffusionModel) -> float:
    """Height of the lowest joint when the rig stands as it does on average."""
    own = model.representation
    height = float(model.standardiser.mean[own.height_column]) * own.scale
    place = np.array([[0.0, height, 0.0]])
    return floor_height(own.assemble(own.fixed_pose(1), place, model.fps, None))
