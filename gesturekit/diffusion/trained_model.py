"""A trained denoiser together with everything that gives its numbers a meaning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import torch

from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import NoiseConfig
from gesturekit.diffusion.motion_vector import DeltaRepresentation
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.sampling.noise_schedule import NoiseSchedule
from gesturekit.diffusion.standardiser import Standardiser
from gesturekit.model import Inputs
from gesturekit.motion.skeleton import Skeleton

MAX_FRAMES = 9000
"""Frames that are generated without tiling: five minutes at 30 fps. At gesture size, each thousand
frames take about 35 MB, one hour 4 GB; the time per frame does not depend on the length."""


@dataclass(eq=False, kw_only=True)
class TrainedModel:
    """Everything that a model folder holds; `DiffusionModel` adds generation.

    Attributes:
        fps: frames per second at which the network works.
        representation: the motion vector of the rig.
        conditions: the inputs of the model beside the noisy motion.
        standardiser: mean and scale of motion vectors.
        noise_config: settings of the noise schedule.
        network: the denoiser.
        speakers: a reference skeleton for each speaker that the corpus named.
        droppable: conditions dropped in training, which guidance needs: "styles" or "all".
        window: frames of the longest motion that is generated without tiling.
        smooth: default of the control `smooth`, in seconds; None for no smoothing.
        recorded_fps: the recordings' rate, which generated motion gets; by default `fps`.
        folder: folder that it was loaded from; None for one that was not loaded.
    """

    kind: ClassVar[str] = "diffusion"

    fps: float
    representation: DeltaRepresentation
    conditions: Conditions
    standardiser: Standardiser
    noise_config: NoiseConfig
    network: Denoiser
    speakers: Mapping[str, Skeleton] = field(default_factory=dict)
    droppable: tuple[str, ...] = ()
    window: int = MAX_FRAMES
    smooth: float | None = None
    recorded_fps: float = None  # type: ignore[assignment]
    folder: Path | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.schedule = NoiseSchedule.of(self.noise_config)
        self.network.eval()
        if self.recorded_fps is None:
            self.recorded_fps = self.fps

    @property
    def skeleton(self) -> Skeleton:
        """The rig, with all the joints of the training files."""
        return self.representation.skeleton

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        conditions = self.conditions
        has_speech = conditions.conditioner is not None
        return Inputs(speech=has_speech, path=conditions.path, events=conditions.events)

    @property
    def styles(self) -> tuple[str, ...]:
        """Names of the styles it knows; empty for a model without styles."""
        return self.conditions.styles

    @property
    def device(self) -> torch.device:
        """The device that holds the network."""
        return next(self.network.parameters()).device
