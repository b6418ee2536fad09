"""System 2: denoising diffusion with Conformers, guidance and products of experts.

Alexanderson, Nagy, Beskow and Henter: Listen, Denoise, Action! Audio-Driven Motion Synthesis with
Diffusion Models, SIGGRAPH 2023.
"""

from gesturekit.lazy import attach

__getattr__ = attach(
    __name__,
    {},
    {
        "Batches": "training.batches",
        "Conditions": "conditions",
        "DeltaRepresentation": "motion_vector",
        "Denoiser": "network",
        "DiffusionConfig": "config",
        "DiffusionModel": "model",
        "DilatedConv": "network",
        "FootVelocity": "losses",
        "NetworkConfig": "config",
        "NoiseConfig": "config",
        "NoiseSchedule": "noise_schedule",
        "Normaliser": "motion_vector",
        "TrainingConfig": "config",
        "StateDistance": "losses",
        "asked_events": "conditions",
        "change_error": "losses",
        "continuous_maps": "motion_vector",
        "denoising_error": "losses",
        "foot_sliding": "losses",
        "learning_rate": "training.trainer",
        "load_training_data": "training.loading",
        "sample": "noise_schedule",
        "smooth_path": "conditions",
        "train": "training.trainer",
        "wants_beats": "conditions",
    },
)[1]
