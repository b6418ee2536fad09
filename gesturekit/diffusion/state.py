"""The state of movement of motion vectors."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch

from gesturekit.diffusion.kinematics import VectorPlaces
from gesturekit.diffusion.motion_vector import DeltaRepresentation
from gesturekit.state.channels import StateChannels


@torch.no_grad()
def measured(
    vectors: np.ndarray, representation: DeltaRepresentation, channels: StateChannels, fps: float
) -> np.ndarray:
    """Return the channels (C, T) of motion vectors (T, X), in their own units."""
    places = _places(representation)(torch.from_numpy(vectors).float()[None])
    return channels(places.permute(0, 2, 3, 1), fps)[0].double().numpy()


@lru_cache(maxsize=4)
def _places(representation: DeltaRepresentation) -> VectorPlaces:
    return VectorPlaces(representation)
