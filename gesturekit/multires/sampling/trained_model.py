"""Trained multires model: one value, which goes whole to the sampler."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from gesturekit.model import Inputs
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.recall.library import RecallLibrary
from gesturekit.multires.sampling.conditions import Conditions
from gesturekit.multires.sampling.noise import TrainedNoise
from gesturekit.training.trained_model import BaseModel


@dataclass(eq=False, repr=False, kw_only=True)
class TrainedModel(BaseModel):
    """A trained model, as its folder stores it; `MultiresModel` adds generation.

    Attributes:
        normaliser: mean and scale of motion vectors.
        network_config: architecture of the pyramid.
        network: the generators.
        noise: the model's noise.
        library: recordings that are recalled; None for a model without recall.
        fastest: ground speed in the fastest second of the training motion, m/s.
    """

    kind: ClassVar[str] = "multires"

    representation: MultiresRepresentation
    normaliser: Normaliser
    conditions: Conditions
    network_config: NetworkConfig
    network: MultiresGenerator
    noise: TrainedNoise
    library: RecallLibrary | None
    fastest: float

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        speech = self.conditions.conditioner
        return Inputs(speech=speech is not None, words=speech is not None and speech.takes_words)
