"""Contents of a multires model folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from gesturekit.model import Inputs
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.recall.library import RecallLibrary
from gesturekit.multires.sampling.conditions import Conditions
from gesturekit.multires.sampling.noise import NoiseSource, ZStarPatches
from gesturekit.training.trained_model import BaseModel


@dataclass(frozen=True)
class TrainedSequence:
    """Data of a training sequence that its reconstruction needs.

    Attributes:
        frames: its length at the full rate.
        style: its style, or None.
    """

    frames: int
    style: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedNoise:
    """Noise of a trained model: scales, z*, and settings for drawing random noise.

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


@dataclass(eq=False, repr=False, kw_only=True)
class TrainedModel(BaseModel):
    """Contents of a model folder; `MultiresModel` adds generation.

    Attributes:
        normaliser: mean and scale of motion vectors.
        network_config: architecture of the pyramid.
        network: the generators.
        noise: the model's noise.
        library: recordings that are recalled; None for a model without recall.
        fastest: ground speed in the fastest second of the training motion, m/s; None if unknown.
    """

    kind: ClassVar[str] = "multires"

    representation: MultiresRepresentation
    normaliser: Normaliser
    conditions: Conditions
    network_config: NetworkConfig
    network: MultiresGenerator
    noise: TrainedNoise
    library: RecallLibrary | None = None
    fastest: float | None = None

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        speech = self.conditions.conditioner
        return Inputs(speech=speech is not None, words=speech is not None and speech.takes_words)
