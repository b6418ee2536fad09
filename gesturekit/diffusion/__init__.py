"""System 2: denoising diffusion with Conformers, guidance and products of experts.

Alexanderson, Nagy, Beskow and Henter: Listen, Denoise, Action! Audio-Driven Motion Synthesis with
Diffusion Models, SIGGRAPH 2023.
"""

from gesturekit.lazy import attach

__getattr__ = attach(
    __name__,
    {},
    {
        "Conditions": "conditions",
        "DeltaRepresentation": "motion_vector",
        "Denoiser": "network",
        "DiffusionConfig": "config",
        "DiffusionModel": "model",
        "NetworkConfig": "config",
        "NoiseConfig": "config",
        "Normaliser": "motion_vector",
        "train": "training.trainer",
    },
)[1]
