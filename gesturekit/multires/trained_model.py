"""Everything that a multires model folder holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from torch import Tensor

from gesturekit.model import Inputs
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.sampling.conditions import Conditions
from gesturekit.multires.sampling.noise import NoiseSource, ZStarPatches
from gesturekit.multires.training.data import Normaliser


@dataclass(frozen=True)
class TrainedSequence:
    """A training sequence, as its reconstruction needs it.

    Attributes:
        frames: its length at the full rate.
        style: its style, or None.
    """

    frames: int
    style: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedNoise:
    """Noise of a trained model: scales, z*, and how random noise is drawn.

    Attributes:
        sigma: (N, L) noise scale of each training sequence and level.
        z_star: noise from which each training sequence is reconstructed, by the sequence's name.
        sequences: length and style of each training sequence, by its name.
        z_star_shuffle: longest patch, in frames, when noise is made of z* patches; 0 for Gaussian
            noise.
        noise_levels: number of the coarsest levels that get noise.
    """

    sigma: Tensor
    z_star: Mapping[str, Tensor]
    sequences: Mapping[str, TrainedSequence]
    z_star_shuffle: int = 0
    noise_levels: int = 1

    def source(self, styles: tuple[str, ...]) -> NoiseSource:
        """Return the source of noise of a model with these styles."""
        patches = None
        if self.z_star_shuffle:
            names = sorted(self.z_star)
            owners = [styles.index(self.sequences[name].style) if styles else 0 for name in names]
            z_stars = [self.z_star[name] for name in names]
            patches = ZStarPatches(z_stars, owners, self.z_star_shuffle)
        return NoiseSource(self.sigma.mean(dim=0), self.noise_levels, patches)


@dataclass(eq=False, kw_only=True)
class TrainedModel:
    """Everything that a model folder holds; `MultiresModel` adds generation.

    Attributes:
        fps: frames per second at which the finest level works.
        representation: the motion vector of the rig.
        normaliser: mean and scale of motion vectors.
        conditions: inputs of the model beside noise.
        network_config: architecture of the pyramid.
        network: the generators.
        noise: the model's noise.
        speakers: a reference skeleton for each speaker that the corpus named.
        fastest: m/s over the ground in the fastest second of the training; None if unknown.
        smooth: default of the control `smooth`, in seconds; None for no smoothing.
        recorded_fps: the recordings' rate, which generated motion gets; by default `fps`.
        folder: folder that it was loaded from; None for one that was not loaded.
    """

    kind: ClassVar[str] = "multires"

    fps: float
    representation: MultiresRepresentation
    normaliser: Normaliser
    conditions: Conditions
    network_config: NetworkConfig
    network: MultiresGenerator
    noise: TrainedNoise
    speakers: Mapping[str, Skeleton] = field(default_factory=dict)
    fastest: float | None = None
    smooth: float | None = None
    recorded_fps: float = None  # type: ignore[assignment]
    folder: Path | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if self.recorded_fps is None:
            self.recorded_fps = self.fps

    @property
    def skeleton(self) -> Skeleton:
        """The rig, with all the joints of the training files."""
        return self.representation.skeleton

    @property
    def styles(self) -> tuple[str, ...]:
        """Names of the styles it knows; empty for a model without styles."""
        return self.conditions.styles

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        return Inputs(speech=self.conditions.conditioner is not None)
