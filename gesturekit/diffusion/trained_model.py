"""A trained denoiser, with the conversions between its tensors and motion and conditions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch

from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import NoiseConfig
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule
from gesturekit.model import BaseModel, Inputs
from gesturekit.state.process import StateProcess

MAX_FRAMES = 9000
"""Frames that are generated without tiling: five minutes at 30 fps. At gesture size, each thousand
frames take about 35 MB, one hour 4 GB; the time per frame does not depend on the length."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class TrainedModel(BaseModel):
    """Contents of a model folder; `DiffusionModel` adds generation.

    Attributes:
        normaliser: mean and scale of motion vectors.
        noise_config: settings of the noise schedule.
        network: the denoiser.
        state_process: from which the state of movement is drawn; None for a model without it.
        droppable: conditions dropped in training, which guidance needs: "styles", "state", or "all"
            but the state.
        window: frames of the longest motion that is generated without tiling.
        clip_denoised: whether generation clips the predicted clean motion, see `DiffusionConfig`.
    """

    kind: ClassVar[str] = "diffusion"

    representation: DeltaRepresentation
    conditions: Conditions
    normaliser: Normaliser
    noise_config: NoiseConfig
    network: Denoiser
    state_process: StateProcess | None = None
    droppable: tuple[str, ...] = ()
    window: int = MAX_FRAMES
    clip_denoised: bool = True

    def __post_init__(self) -> None:
        self.network.eval()

    @cached_property
    def schedule(self) -> NoiseSchedule:
        """Variances of the steps of diffusion."""
        return NoiseSchedule.of(self.noise_config)

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        conditions = self.conditions
        speech = conditions.conditioner
        return Inputs(
            speech=speech is not None,
            words=speech is not None and speech.takes_words,
            files=() if speech is None else speech.files,
            path=conditions.path,
            events=conditions.events,
        )

    @property
    def device(self) -> torch.device:
        """The device that holds the network."""
        return next(self.network.parameters()).device
