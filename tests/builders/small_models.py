"""Models that need no training."""

from collections.abc import Callable, Sequence

import numpy as np

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.diffusion import (
    Conditions,
    DeltaRepresentation,
    Denoiser,
    DiffusionModel,
    NetworkConfig,
    NoiseConfig,
    Normaliser,
)
from gesturekit.motion import Motion
from gesturekit.training.seeds import seeded


def small_diffusion(
    gesture: Callable[..., Motion],
    *,
    joints: str | Sequence[str] = "body",
    styles: tuple[str, ...] = (),
) -> DiffusionModel:
    """Return a diffusion model with speech input and random weights, for motion like `gesture`."""
    extractor = af.LogMel(n_mels=4)
    ears = SpeechConditioner(extractor, 30.0, "mean", np.zeros(4), np.full(4, 10.0))
    conditions = Conditions(ears, styles=styles)
    config = NetworkConfig(blocks=1, layers=1, channels=8, heads=1, feedforward=8, embedding=8)
    body = DeltaRepresentation.fit([gesture(2.0)], joints)
    width = body.n_features
    return DiffusionModel(
        fps=30.0,
        representation=body,
        conditions=conditions,
        normaliser=Normaliser.fit([body.encode(gesture(2.0))]),
        noise_config=NoiseConfig(predict="velocity", steps=4),
        network=seeded("network", lambda: Denoiser(width, conditions.width, config)),
        droppable=("styles",) if styles else (),
        speakers={},
        recorded_fps=30.0,
    )
